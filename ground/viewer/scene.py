"""What there is to show at one moment, in the frame of the scene: the world of the first datum that was seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from common.arrays import F64
from common.geo import T_world_other
from common.measurements import VehicleState
from common.messages import Datum, Level, Pose
from common.se3 import SE3
from ground.cloud import FlightId, HeldKeyframe, HeldTile


@dataclass(frozen=True, eq=False)
class Aircraft:
    """One flight's aircraft: its newest pose, the path (N, 3) m it came, in world, and whether its token is alive."""

    flight: FlightId
    pose: Pose
    path: F64
    alive: bool
    pose_age_s: float


@dataclass(frozen=True)
class StreamRow:
    """One line of the panel's table of streams."""

    vehicle: str
    stream: str
    messages: int
    rate_hz: float
    bytes_per_s: float
    age_s: float | None
    stale: bool
    faults: int
    fault: str


@dataclass(frozen=True)
class HealthRow:
    """What a process said last about itself."""

    vehicle: str
    role: str
    level: Level
    text: str
    age_s: float


@dataclass(frozen=True, eq=False)
class VehicleRow:
    """What a drone's autopilot said last."""

    vehicle: str
    state: VehicleState
    age_s: float


@dataclass(frozen=True, eq=False)
class PlacedTile:
    """A tile that can be drawn, and where its world lies in the scene."""

    held: HeldTile
    T_scene_world: SE3


@dataclass(frozen=True, eq=False)
class Scene:
    """A snapshot: everything in it is immutable, so threads may keep it."""

    datums: dict[FlightId, Datum] = field(default_factory=dict)
    origin: Datum | None = None
    tiles: Sequence[HeldTile] = ()
    keyframes: Sequence[HeldKeyframe] = ()
    aircraft: Sequence[Aircraft] = ()
    alive: dict[str, bool] = field(default_factory=dict)
    streams: Sequence[StreamRow] = ()
    health: Sequence[HealthRow] = ()
    vehicles: Sequence[VehicleRow] = ()
    faults: int = 0
    station: str = "ground"

    def T_scene_world(self, flight: FlightId) -> SE3 | None:
        """Where the world of a flight lies in the scene; None while its datum is unknown."""
        datum = self.datums.get(flight)
        if datum is None or self.origin is None:
            return None
        if _same_place(datum, self.origin):
            return SE3.identity()
        return T_world_other(self.origin, datum)

    @cached_property
    def placed(self) -> list[PlacedTile]:
        """The tiles that have cells and a datum."""
        transforms = {flight: self.T_scene_world(flight) for flight in {held.flight for held in self.tiles}}
        return [
            PlacedTile(held, T_scene_world)
            for held in self.tiles
            if held.known and (T_scene_world := transforms[held.flight]) is not None
        ]

    @cached_property
    def centres(self) -> F64:
        """Centre (M, 3) m in the scene of each placed tile."""
        return np.array([p.T_scene_world.apply(p.held.centre) for p in self.placed]).reshape(-1, 3)

    @property
    def area(self) -> float:
        """Area with a confident height, m²."""
        return sum(held.confident * held.cell**2 for held in self.tiles)

    @property
    def points(self) -> int:
        """Cells with a height."""
        return sum(held.known for held in self.tiles)


def node_name(flight: FlightId) -> str:
    """A flight as one part of the name of a node in the browser."""
    return f"{flight.vehicle}_{flight.flight}".replace("/", "_")


SceneSource = Callable[[], Scene]


def _same_place(a: Datum, b: Datum) -> bool:
    return np.allclose(
        (a.latitude_deg, a.longitude_deg, a.height), (b.latitude_deg, b.longitude_deg, b.height), rtol=0, atol=1e-12
    )
