"""A flight mapped photo by photo: alignment and mapper together, and what follows from each photo for the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.alignment.alignment import Alignment
from air.alignment.prepare import PreparedPhoto
from air.alignment.status import State
from air.config import AirConfig
from air.jump import Jump
from air.mapping.mapper import Mapper
from air.report import counts, problems_of
from air.sources.source import Problem
from common.messages import Datum, Keyframe, Level, MapTile, Mode, Pose
from common.se3 import SE3

T_CAM_BODY = SE3(np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), np.zeros(3))
"""Where the body is in a camera that looks down from it, the top of its image ahead: photos tell of no other body."""
MOVES_PER_STEP = 4
"""Surfaces that follow their moved poses in one step: a photo that comes meanwhile waits for its end."""
SETTLED = 5
"""Photos from which on the block no longer turns or stretches as a whole by metres."""


@dataclass(frozen=True, eq=False)
class Growth:
    """What a step changed: keyframes and tiles, new or at a higher revision, and the poses of newly placed photos.

    Photos that the odometry placed tell no poses: it does.
    """

    keyframes: list[Keyframe]
    tiles: list[MapTile]
    poses: list[Pose]


@dataclass(frozen=True)
class Condition:
    """How the flight is going: where its world is, how well, in one line, and in numbers."""

    datum: Datum | None
    level: Level
    text: str
    counts: dict[str, int]


class LiveMap:
    """The map of a flight while it grows (core: no clock, no stream)."""

    def __init__(self, flight: str, config: AirConfig, datum: Datum | None = None) -> None:
        """Without a `datum` the world begins at the first photo that matches another."""
        self._flight = flight
        self._alignment = Alignment(flight, config.alignment)
        self._alignment.datum = datum
        self._mapper = Mapper(config.mapping)
        self._photos = 0
        self._navigated: set[int] = set()

    def align(self, photo: PreparedPhoto) -> list[Keyframe]:
        """The keyframes that one more photo adds or moves."""
        keyframes = self._alignment.add(photo)
        if photo.image is not None:
            self._mapper.add_image(self._photos, photo.image)
        if photo.photo.revision is not None:
            self._navigated.add(self._photos)
        self._photos += 1
        return keyframes

    def move(self, jump: Jump) -> list[Keyframe]:
        """The keyframes that move along with the odometry's world."""
        return self._alignment.move(jump)

    def grow(self, keyframes: list[Keyframe]) -> Growth:
        """What these keyframes add to the map, and the poses of the new ones; what they move is left for later."""
        tiles = self._mapper.update(self._flight, keyframes, self._alignment.ground_height(), moves=0)
        new = [k for k in keyframes if k.revision == 1 and k.index not in self._navigated]
        return Growth(keyframes, tiles, [self._pose(k) for k in new])

    def correct(self, in_flight: bool) -> list[MapTile]:
        """Tiles of some of the surfaces that moved and were left for later, in flight few; empty once none is left."""
        return self._mapper.update(self._flight, [], moves=MOVES_PER_STEP if in_flight else None)

    def finish(self) -> list[Keyframe]:
        """All keyframes after the final adjustment."""
        return self._alignment.finish()

    def condition(self, problems: list[Problem]) -> Condition:
        """How the flight is going, with the last of its problems; `problems` are those of the source."""
        statuses = self._alignment.statuses()
        said, number = problems_of(statuses, problems), counts(statuses)
        lost = bool(statuses) and statuses[-1].state is not State.PLACED
        text = ", ".join(f"{n} {state}" for state, n in number.items() if n or state == "read")
        # A folder knows the faults of its photos before their turn has come.
        read = {status.name for status in statuses}
        for last in [problem for problem in said if problem["photo"] in read][-1:]:
            text += f"; {last['photo']}: {last['reason']}"
        level = Level.DEGRADED if lost and self._photos > 1 else Level.OK
        return Condition(self._alignment.datum, level, text, number | {"problems": len(said)})

    def _pose(self, keyframe: Keyframe) -> Pose:
        return Pose(
            flight=self._flight,
            t_ns=keyframe.t_ns,
            revision=keyframe.revision,
            T_world_body=keyframe.T_world_cam @ T_CAM_BODY,
            v_world=None,
            sigma=keyframe.sigma,
            mode=Mode.PHOTOGRAMMETRIC if self._alignment.placed >= SETTLED else Mode.INITIALIZING,
        )
