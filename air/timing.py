"""Time without wires: the clocks of host and devices, mapped to GNSS time from nothing but arrivals.

An arrival is late by an unknown delay and never early. Plotted over the device's own time, arrivals minus device time
lie on or above a straight line (offset and drift of the two clocks), and the lower hull of the points finds it: each
device → host, and the receiver's time tags → host. The constant part of a delay cannot be seen: it is a setting.

Source: S. B. Moon, P. Skelly, D. Towsley, Estimation and Removal of Clock Skew from Network Delay Measurements (1999);
L. Zhang, Z. Liu, C. H. Xia, Clock Synchronization Algorithms for Network Measurements (2002), on convex hulls.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

from air.sensors.driver import TimeScale
from common.measurements import ClockPhase, ClockState, FixKind, GnssEpoch, Measurement, ReceiverSolution

M = TypeVar("M", bound=Measurement)

WINDOW_S = 100.0
"""Arrivals older than this are forgotten: clocks wander."""
BUCKET_S = 0.5
"""Of each bucket of time, only the earliest arrival is kept."""
MAX_DRIFT = 100e-6
SETTLED_S = 30.0
"""From this span on a window tells its drift better than what was known before it."""
KNOWN_DRIFT = 2e-6
"""A drift that was learnt once stays within this, through steps and gaps."""
LOCKED_S, LOCKED_SAMPLES = 2.0, 10
HOLDOVER_S = 3.0

_EARLY_S = 0.3e-3
"""An arrival that is earlier than a locked clock allows, by at least this, is suspected."""
_IMPOSSIBLE_S = 1.0
_OUTLIER_S = 0.05
_SUSPECTS, _SUSPECTS_S = 3, 5.0
"""So many suspects within so short a time are a clock that stepped."""
_STEPPED_BUCKETS, _USUAL_BUCKETS = 6, 20
_LEAST_SIGMA_S = 1e-6
_WANDER_PER_S = 1e-8
"""How fast a drift changes, at worst, with the temperature."""
_SUPPORTED = 0.6
"""Where in the window the line is supported: its newest half counts a little more."""
_RANK, _EXCESS = 6, 5.0
"""One sigma of the line at its newest end is so many mean distances between the lowest arrivals, taken over as many
as the rank; both from simulations."""


class ClockFilter:
    """Maps the clock of one device to that of the host; all times ns, from any start.

    `delay_s` is the least time from sampling to arrival: what is not known of it is an error of all stamps.
    `drift` is by how much the host's clock runs faster than the device's.
    """

    def __init__(self, delay_s: float = 0.0) -> None:
        self._delay_ns = round(delay_s * 1e9)
        self.samples = self.outliers = self.resets = 0
        self.drift = 0.0
        self._known_drift: float | None = None
        self._begin(0, 0)

    def _begin(self, device_ns: int, host_ns: int) -> None:
        """Forget all arrivals; times are seconds since these from now on, offsets seconds against them."""
        self._origin_ns = (device_ns, host_ns)
        self._buckets: deque[tuple[float, float]] = deque()
        self._suspects: deque[tuple[int, int]] = deque(maxlen=_SUSPECTS)
        self._offset = 0.0
        self._spread = 0.0
        self._arrived = 0
        self._newest: float | None = None

    @property
    def locked(self) -> bool:
        """Whether there were enough arrivals since the last step."""
        return self._arrived >= LOCKED_SAMPLES and self._span >= LOCKED_S

    @property
    def newest_ns(self) -> int | None:
        """The device's newest time that was observed."""
        return None if self._newest is None else self._origin_ns[0] + round(self._newest * 1e9)

    @property
    def _span(self) -> float:
        return self._buckets[-1][0] - self._buckets[0][0] if self._buckets else 0.0

    def host_ns(self, device_ns: int) -> int:
        """The host's time at a time of the device."""
        t = (device_ns - self._origin_ns[0]) * 1e-9
        return device_ns - self._origin_ns[0] + self._origin_ns[1] + round((self._offset + self.drift * t) * 1e9)

    def device_ns(self, host_ns: int) -> int:
        """The device's time at a time of the host."""
        guess = host_ns - self._origin_ns[1] + self._origin_ns[0]
        for _ in range(3):  # drifts are small: each round gains four digits
            guess += host_ns - self.host_ns(guess)
        return guess

    def sigma_s(self, device_ns: int) -> float:
        """One sigma of the mapping at a time of the device, s; inf while nothing is known."""
        if self._newest is None:
            return math.inf
        age = abs((device_ns - self._origin_ns[0]) * 1e-9 - self._newest)
        drift_sigma = min(2 * self._spread / max(self._span, LOCKED_S), MAX_DRIFT)
        return math.hypot(self._spread, drift_sigma * age, 0.5 * _WANDER_PER_S * age**2)

    def observe(self, device_ns: int, arrival_ns: int) -> bool:
        """Note that what the device sampled at its time `device_ns` arrived at the host's time `arrival_ns`.

        Returns whether this can be, as far as the clock is known; else the sample's time is not to be trusted.
        """
        host_ns = arrival_ns - self._delay_ns
        self.samples += 1
        if self._newest is None:
            self._begin(device_ns, host_ns)
        delay = (host_ns - self.host_ns(device_ns)) * 1e-9
        if self.locked and self._suspected(device_ns, host_ns, delay):
            return False
        self._add(device_ns, host_ns, delay)
        self.outliers += delay > _OUTLIER_S
        if self._stepped():
            self._restart(device_ns, host_ns)
        return True

    def _suspected(self, device_ns: int, host_ns: int, delay: float) -> bool:
        """Whether an arrival cannot be: it is refused, unless more of its kind show that the clock stepped."""
        since = (device_ns - self._origin_ns[0]) * 1e-9 - (self._newest or 0.0)
        early = max(_EARLY_S, 4 * self._spread) + KNOWN_DRIFT * abs(since)
        if -early <= delay <= _IMPOSSIBLE_S:
            return False
        self.outliers += 1
        self._suspects.append((device_ns, host_ns))
        first_ns = self._suspects[0][1]
        if len(self._suspects) == _SUSPECTS and host_ns - first_ns <= _SUSPECTS_S * 1e9:
            self._restart(device_ns, host_ns)
        return True

    def _restart(self, device_ns: int, host_ns: int) -> None:
        """Learn the offset anew; the drift stays as it was."""
        self.resets += 1
        self._begin(device_ns, host_ns)
        self._add(device_ns, host_ns, 0.0)

    def _add(self, device_ns: int, host_ns: int, delay: float) -> None:
        t = (device_ns - self._origin_ns[0]) * 1e-9
        point = (t, (host_ns - self._origin_ns[1]) * 1e-9 - t)
        self._arrived += 1
        self._newest = t if self._newest is None else max(t, self._newest)
        bucket = self._buckets[-1][0] // BUCKET_S if self._buckets else -math.inf
        if t // BUCKET_S < bucket:
            if not self.locked:  # a device that was set up began to count anew
                self._restart(device_ns, host_ns)
            return
        if t // BUCKET_S == bucket:
            if self._height(point) < self._height(self._buckets[-1]):
                self._buckets[-1] = point
            if delay < 0:
                self._fit()
            return
        self._buckets.append(point)
        while t - self._buckets[0][0] > WINDOW_S:
            self._buckets.popleft()
        self._fit()

    def _height(self, point: tuple[float, float]) -> float:
        return point[1] - self._offset - self.drift * point[0]

    def _fit(self) -> None:
        """The line below all points that has the least sum of distances to them: an edge of their lower hull."""
        slope = _supporting_slope(list(self._buckets))
        settled = self._span >= SETTLED_S
        centre, reach = (0.0, MAX_DRIFT) if settled or self._known_drift is None else (self._known_drift, KNOWN_DRIFT)
        self.drift = min(max(slope, centre - reach, -MAX_DRIFT), centre + reach, MAX_DRIFT)
        if settled:
            self._known_drift = self.drift
        self._offset = min(y - self.drift * t for t, y in self._buckets)
        heights = sorted(map(self._height, self._buckets))
        rank = min(_RANK, len(heights) - 1)
        self._spread = max(_LEAST_SIGMA_S, _EXCESS * heights[rank] / rank) if rank else _IMPOSSIBLE_S

    def _stepped(self) -> bool:
        """Whether the earliest arrivals of the latest buckets all came later than nine of ten did before them."""
        if len(self._buckets) < _USUAL_BUCKETS + _STEPPED_BUCKETS + 1:
            return False
        heights = [self._height(point) for point in self._buckets]
        usual, latest = sorted(heights[: -_STEPPED_BUCKETS - 1]), heights[-_STEPPED_BUCKETS - 1 : -1]
        return min(latest) > usual[len(usual) * 9 // 10] + _EARLY_S


def _supporting_slope(points: list[tuple[float, float]]) -> float:
    """Slope of the edge of the lower hull in the middle of points in order of time; 0 for a single point."""
    hull: list[tuple[float, float]] = []
    for t, y in points:
        while len(hull) > 1 and (hull[-1][0] - hull[-2][0]) * (y - hull[-2][1]) <= (hull[-1][1] - hull[-2][1]) * (
            t - hull[-2][0]
        ):
            hull.pop()
        hull.append((t, y))
    middle = points[0][0] + _SUPPORTED * (points[-1][0] - points[0][0])
    for (t0, y0), (t1, y1) in pairwise(hull):
        if t1 >= middle and t1 > t0:
            return (y1 - y0) / (t1 - t0)
    return 0.0


class Timebase:
    """All clocks of one aircraft: stamps measurements in GNSS time (GPST).

    `delays_s` gives the least time from sampling to arrival by name of the device. The host's clock must never be
    set, only run: a monotonic one.
    """

    def __init__(self, delays_s: Mapping[str, float] | None = None) -> None:
        self._delays_s = dict(delays_s or {})
        self._devices: dict[str, ClockFilter] = {}
        self._receivers: dict[type[Measurement], tuple[str, ClockFilter]] = {}
        self._told_ns: int | None = None

    def restamp(self, measurement: M, device: str, scale: TimeScale, arrival_ns: int) -> M | None:
        """The measurement at its GNSS time, or None as long as that is not known.

        `scale` says what its stamp is; `arrival_ns` when it arrived, or was sent at the latest, on the host's clock.
        """
        if scale is TimeScale.GNSS:
            self._observe_receiver(measurement, device, arrival_ns)
            return measurement
        if scale is TimeScale.DEVICE:
            clock = self._devices.setdefault(device, self._new_filter(device))
            possible = clock.observe(measurement.t_ns, arrival_ns)
            host_ns = clock.host_ns(measurement.t_ns) if possible and clock.locked else None
        else:
            host_ns = arrival_ns - round(self._delays_s.get(device, 0.0) * 1e9)
        t_ns = None if host_ns is None else self.gnss_ns(host_ns)
        return None if t_ns is None else replace(measurement, t_ns=t_ns)

    def gnss_ns(self, host_ns: int) -> int | None:
        """GNSS time at a time of the host, or None as long as it is not known."""
        receiver = self._receiver()
        return None if receiver is None or not receiver[1].locked else receiver[1].device_ns(host_ns)

    def states(self, host_ns: int) -> list[ClockState]:
        """How well every clock is known, once a second; an empty list in between and before the first GNSS time.

        For the receiver's name it is the host's clock, which the receiver tells.
        """
        if self._told_ns is not None and 0 <= host_ns - self._told_ns < 1_000_000_000:
            return []
        receiver = self._receiver()
        t_ns = self.gnss_ns(host_ns)
        if receiver is None or t_ns is None:
            return []
        self._told_ns = host_ns
        name, host = receiver
        sigma_s = host.sigma_s(t_ns)
        states = [self._state(name, host, t_ns, t_ns - host_ns, -host.drift, sigma_s, t_ns)]
        for device, clock in self._devices.items():
            device_ns = clock.device_ns(host_ns)
            drift = clock.drift - host.drift
            sigma = math.hypot(clock.sigma_s(device_ns), sigma_s)
            states.append(self._state(device, clock, t_ns, t_ns - device_ns, drift, sigma, device_ns))
        return states

    def _state(
        self, device: str, clock: ClockFilter, t_ns: int, offset_ns: int, drift: float, sigma_s: float, now_ns: int
    ) -> ClockState:
        newest_ns = clock.newest_ns
        if newest_ns is None:
            phase = ClockPhase.UNSET
        elif not clock.locked:
            phase = ClockPhase.CONVERGING
        else:
            phase = ClockPhase.HOLDOVER if now_ns - newest_ns > HOLDOVER_S * 1e9 else ClockPhase.LOCKED
        counts = clock.samples, clock.outliers, clock.resets
        return ClockState(t_ns, device, phase, offset_ns, 1e6 * drift, sigma_s, *counts)

    def _observe_receiver(self, measurement: Measurement, device: str, arrival_ns: int) -> None:
        """Learn from a receiver's epoch; each kind of message has a delay, and so a filter, of its own."""
        if isinstance(measurement, GnssEpoch) or (
            isinstance(measurement, ReceiverSolution) and measurement.kind is not FixKind.NONE
        ):
            kind = type(measurement)
            if kind not in self._receivers:
                self._receivers[kind] = (device, self._new_filter(device))
            self._receivers[kind][1].observe(measurement.t_ns, arrival_ns)

    def _receiver(self) -> tuple[str, ClockFilter] | None:
        """The receiver's solutions where there are any: raw epochs are off by the receiver's own clock error."""
        solutions, epochs = self._receivers.get(ReceiverSolution), self._receivers.get(GnssEpoch)
        if solutions is not None and (solutions[1].locked or epochs is None):
            return solutions
        return epochs

    def _new_filter(self, device: str) -> ClockFilter:
        return ClockFilter(self._delays_s.get(device, 0.0))
