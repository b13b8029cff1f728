"""Where each aircraft is and was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.arrays import F64, I64
from common.messages import Pose
from ground.cloud import FlightId

HISTORY_NS = 100_000_000


@dataclass(frozen=True, eq=False)
class HeldPose:
    """A pose of the history and the bytes it came in."""

    flight: FlightId
    pose: Pose
    payload: bytes


class _History:
    """Times and positions in order; the arrays grow by doubling."""

    def __init__(self) -> None:
        self.length = 0
        self._t_ns: I64 = np.zeros(64, np.int64)
        self._p_world: F64 = np.zeros((64, 3))

    def append(self, t_ns: int, p_world: F64) -> None:
        if self.length == len(self._t_ns):
            self._t_ns = np.concatenate([self._t_ns, np.zeros_like(self._t_ns)])
            self._p_world = np.concatenate([self._p_world, np.zeros_like(self._p_world)])
        self._t_ns[self.length], self._p_world[self.length] = t_ns, p_world
        self.length += 1

    @property
    def last_ns(self) -> int:
        return int(self._t_ns[self.length - 1])

    def after(self, t_ns: int) -> F64:
        first = int(np.searchsorted(self._t_ns[: self.length], t_ns, side="right"))
        return self._p_world[first : self.length].copy()


class Tracks:
    """The newest pose of every flight, and its positions decimated to 10 Hz."""

    def __init__(self) -> None:
        self._latest: dict[FlightId, Pose] = {}
        self._history: dict[FlightId, _History] = {}

    def add(self, vehicle: str, pose: Pose, payload: bytes) -> HeldPose | None:
        """The record to keep of a pose, or None when it comes too soon after the last one kept or out of order."""
        flight = FlightId(vehicle, pose.flight)
        latest = self._latest.get(flight)
        if latest is not None and (pose.t_ns, pose.revision) <= (latest.t_ns, latest.revision):
            return None
        self._latest[flight] = pose
        history = self._history.setdefault(flight, _History())
        if history.length and pose.t_ns - history.last_ns < HISTORY_NS:
            return None
        history.append(pose.t_ns, pose.T_world_body.t)
        return HeldPose(flight, pose, payload)

    def latest(self, flight: FlightId) -> Pose | None:
        """The newest pose of a flight, or None."""
        return self._latest.get(flight)

    def newest_flights(self) -> list[FlightId]:
        """Of each vehicle the flight that started last."""
        return sorted({flight.vehicle: flight for flight in sorted(self._latest)}.values())

    def positions(self, flight: FlightId, after_ns: int = -1) -> F64:
        """Positions (N, 3) m in the world of the flight, in order of time, of poses later than `after_ns`."""
        return self._history[flight].after(after_ns) if flight in self._history else np.zeros((0, 3))
