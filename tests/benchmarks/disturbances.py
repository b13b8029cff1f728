"""What may happen to a flight: measurements that are missing or wrong."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from flown_flights import FlownFlight, sensed_anew

from air.odometry.tracker import TrackedFrame
from common.measurements import GnssEpoch, ImuSample

AT_S = 120.0
IN_THE_AIR_S = 60.0
FAULT_S = 30.0
ANOTHER = 1 << 40
"""Added to a point's number: after the camera was blind nothing is known again."""


def without(flight, kinds, begin_s, end_s):
    """The flight without measurements of some kinds from `begin_s` to `end_s`."""

    def is_left(message):
        t_ns = getattr(message, "t_ns", None)
        return t_ns is None or not (isinstance(message, kinds) and begin_s <= flight.seconds(t_ns) < end_s)

    return replace(flight, messages=[message for message in flight.messages if is_left(message)])


def without_gnss(flight, begin_s, end_s):
    """The flight without epochs for some time."""
    return without(flight, GnssEpoch, begin_s, end_s)


def blind(flight):
    """The camera sees nothing for 5 s."""

    def seen(frame):
        t_s = flight.seconds(frame.t_ns)
        if t_s < AT_S:
            return frame
        if t_s >= AT_S + 5.0:
            return replace(frame, ids=frame.ids + ANOTHER)
        nothing = {name: getattr(frame, name)[:0] for name in ("ids", "uv", "rays", "row_dt_s", "new")}
        return replace(frame, **nothing, blind=True)

    return replace(flight, messages=[seen(m) if isinstance(m, TrackedFrame) else m for m in flight.messages])


def dropped(flight):
    """Every fifth frame, at random, does not come, though the tracker saw it."""
    rng = np.random.default_rng(0)
    kept = [m for m in flight.messages if not isinstance(m, TrackedFrame) or rng.random() >= 0.2]
    return replace(flight, messages=kept)


@dataclass(frozen=True)
class Disturbance:
    """What happens, when it counts as over, and whether the world has been found before, so that it is the same."""

    name: str
    of: Callable[[FlownFlight], FlownFlight]
    over_s: float
    same_world: bool


DISTURBANCES = (
    Disturbance("camera blind for 5 s", blind, AT_S + 5.0, True),
    Disturbance("20 % of the frames dropped", dropped, IN_THE_AIR_S, False),
    Disturbance("no IMU for 0.2 s", lambda f: without(f, ImuSample, AT_S, AT_S + 0.2), AT_S + 0.2, True),
    Disturbance("two satellites wrong by 50 m", lambda f: sensed_anew(f, "&gnss.fault=2"), FAULT_S, False),
    Disturbance(
        "start in mid-air",
        lambda f: without(f, TrackedFrame | ImuSample | GnssEpoch, -np.inf, IN_THE_AIR_S),
        IN_THE_AIR_S,
        False,
    ),
)
