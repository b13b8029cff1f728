"""What is true of a simulated survey, and how it is written as files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from air.sources.simulated.sites.scene import (
    DOME_SIDE,
    DOME_TOP,
    EAST_WALL,
    GROUND,
    HOUSE,
    NORTH_ROOF,
    NORTH_WALL,
    SOUTH_ROOF,
    SOUTH_WALL,
    WEST_WALL,
)
from air.sources.simulated.sites.world import World
from common.arrays import F64, I32, U8, Bool
from common.camera import CameraModel
from common.export.datum import write_datum
from common.export.laz import write_points
from common.export.trajectory import write_tum
from common.messages import Datum
from common.se3 import SE3

Seen = Callable[[F64], Bool]
"""Which points (N, 2) m in world belong to the mapped footprint."""
SPACING = 0.05
"""Between points of the true surface, m; on walls too."""
FOOTPRINT_CELL = 0.5
SEEN_BY = 3
"""Ground that at least so many photos see belongs to the mapped footprint."""


@dataclass(frozen=True, eq=False)
class SurveyTruth:
    """Where the world frame is, what the camera is, where it was (`t_ns`, `T_world_cam`) and what it saw."""

    datum: Datum
    camera: CameraModel
    t_ns: list[int]
    T_world_cam: list[SE3]
    world: World

    def write(self, folder: Path) -> None:
        """Write trajectory.tum, datum.json, camera.json and surface.laz into a folder, creating it."""
        folder.mkdir(parents=True, exist_ok=True)
        write_tum(folder / "trajectory.tum", self.t_ns, self.T_world_cam)
        write_datum(folder / "datum.json", self.datum)
        (folder / "camera.json").write_text(json.dumps(asdict(self.camera), indent=2) + "\n", encoding="utf-8")
        p_world, colour = self.surface()
        write_points(folder / "surface.laz", p_world, colour, self.datum)

    def surface(self) -> tuple[F64, U8]:
        """Points (N, 3) m in world, 5 cm apart, of ground, roofs, crowns and walls in the mapped footprint; colours."""
        west, south, mask = self.footprint()

        def seen(xy: F64) -> Bool:
            column, row = np.floor((xy - [west, south]) / FOOTPRINT_CELL).astype(int).T
            inside = (row >= 0) & (column >= 0) & (row < mask.shape[0]) & (column < mask.shape[1])
            return np.asarray(inside & mask[np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)])

        p_top, solid_top, face_top = _tops(self.world, seen)
        p_wall, solid_wall, face_wall = _walls(self.world, seen)
        p = np.concatenate([p_top, p_wall])
        solid, face = np.concatenate([solid_top, solid_wall]), np.concatenate([face_top, face_wall])
        return p, self.world.colour(p, solid, face)

    def footprint(self) -> tuple[float, float, Bool]:
        """West and south edge, m, and which cells (H, W) of FOOTPRINT_CELL at least SEEN_BY photos see."""
        bounds = self.world.bounds
        count = np.zeros(bounds.grid(FOOTPRINT_CELL), np.uint16)
        for pose in self.T_world_cam:
            outline = bounds.pixels(self._ground_outline(pose), FOOTPRINT_CELL)
            once = np.zeros(count.shape, np.uint8)
            cv2.fillPoly(once, [np.round(outline - 0.5).astype(np.int32)], 1)
            count += once
        return bounds.west, bounds.south, count >= min(SEEN_BY, len(self.T_world_cam))

    def _ground_outline(self, pose: SE3) -> F64:
        """Where the edge of an image meets the surface: (M, 2) m in world."""
        right, bottom = self.camera.width - 0.5, self.camera.height - 0.5
        s = np.linspace(0, 1, 9)[:-1]
        corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
        edge = np.concatenate([a + s[:, None] * (b - a) for a, b in pairwise(corners)])
        return self.world.intersect(pose.t, self.camera.rays(edge) @ pose.R.T)[0][:, :2]


def _tops(world: World, seen: Seen) -> tuple[F64, I32, I32]:
    """Points on everything that is seen from straight above, with solid and face."""
    x = np.arange(world.bounds.west, world.bounds.east, SPACING) + SPACING / 2
    y = np.arange(world.bounds.south, world.bounds.north, SPACING) + SPACING / 2
    rows = []
    for north in y:
        xy = np.stack([x, np.full_like(x, north)], axis=1)
        rows.append(xy[seen(xy)])
    xy = np.concatenate(rows)
    z, solid = world.top(xy)
    return np.column_stack([xy, z]), solid, _top_faces(world, xy, solid)


def _top_faces(world: World, xy: F64, solid: I32) -> I32:
    solids = world.scene.solids[np.maximum(solid, 0)]
    north = solids["cos"] * (xy[:, 1] - solids["y"]) - solids["sin"] * (xy[:, 0] - solids["x"]) > 0
    roof = np.where(north, NORTH_ROOF, SOUTH_ROOF)
    face = np.where(solid < 0, GROUND, np.where(solids["kind"] == HOUSE, roof, DOME_TOP))
    return np.asarray(face, np.int32)


def _walls(world: World, seen: Seen) -> tuple[F64, I32, I32]:
    """Points on the walls of houses and the sides of crowns that stand free, with solid and face."""
    parts = [_wall_points(world, k) for k in range(len(world.scene.solids))]
    p, out, solid, face = (np.concatenate([part[n] for part in parts]) for n in range(4))
    # A step away from the wall the surface must be lower, or another solid covers this point.
    free = seen(p[:, :2]) & (world.height(p[:, :2] + 0.002 * out) < p[:, 2])
    return p[free], solid[free], face[free]


def _wall_points(world: World, k: int) -> tuple[F64, F64, I32, I32]:
    """Points (N, 3) on the upright faces of solid k, outward directions (N, 2), solids and faces (N,)."""
    s = world.scene.solids[k]
    if s["kind"] == HOUSE:
        u, v, out, face = _box_outline(float(s["a"]), float(s["b"]))
        upper = s["top"] - s["slope"] * np.abs(v)
    else:
        angle = np.arange(0, 2 * np.pi, SPACING / s["a"])
        u, v = s["a"] * np.cos(angle), s["a"] * np.sin(angle)
        out, face = np.stack([u, v], axis=1) / s["a"], np.full(len(u), DOME_SIDE, np.int32)
        upper = np.full(len(u), s["top"] - s["b"])
    R = np.array([[s["cos"], -s["sin"]], [s["sin"], s["cos"]]])
    xy, out = np.stack([u, v], axis=1) @ R.T + [s["x"], s["y"]], out @ R.T
    lower = world.terrain(xy)
    levels = np.maximum(np.ceil((upper - lower) / SPACING).astype(int), 0)
    column = np.repeat(np.arange(len(u)), levels)
    level = np.arange(levels.sum()) - np.repeat(np.cumsum(levels) - levels, levels)
    p = np.column_stack([xy[column], upper[column] - SPACING * (level + 0.5)])
    return p, out[column], np.full(len(p), k, np.int32), face[column]


def _box_outline(a: float, b: float) -> tuple[F64, F64, F64, I32]:
    """Points along the walls of a box of half sizes a, b: own coordinates u, v, outward directions and faces."""
    along = np.arange(-a, a, SPACING) + SPACING / 2
    across = np.arange(-b, b, SPACING) + SPACING / 2
    sides = [
        (np.full_like(across, a), across, (1.0, 0.0), EAST_WALL),
        (np.full_like(across, -a), across, (-1.0, 0.0), WEST_WALL),
        (along, np.full_like(along, b), (0.0, 1.0), NORTH_WALL),
        (along, np.full_like(along, -b), (0.0, -1.0), SOUTH_WALL),
    ]
    return (
        np.clip(np.concatenate([side[0] for side in sides]), -a, a),
        np.clip(np.concatenate([side[1] for side in sides]), -b, b),
        np.concatenate([np.tile(side[2], (len(side[0]), 1)) for side in sides]),
        np.concatenate([np.full(len(side[0]), side[3], np.int32) for side in sides]),
    )
