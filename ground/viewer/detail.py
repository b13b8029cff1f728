"""Level of detail: which level of which tile one camera needs, within a budget of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.arrays import F64, I64, Bool
from ground.viewer.levels import MAX_LEVEL

CELL_ON_SCREEN_PX = 1.5
OUT_OF_VIEW_LEVELS = 2
HYSTERESIS = 0.25


@dataclass(frozen=True, eq=False)
class View:
    """A camera of a browser: position (3,) m and `R_scene_cam` (3, 3) in the scene, vertical field of view in rad."""

    p_scene: F64
    R_scene_cam: F64
    fov: float
    aspect: float
    height_px: int


def choose_levels(
    view: View, centre: F64, radius: F64, cell: F64, points: F64, budget: int, previous: I64 | None = None
) -> I64:
    """Level (M,) per tile, 0 (all cells) to MAX_LEVEL, so that together at most `budget` points are drawn.

    Tiles are spheres at `centre` (M, 3) m in the scene with `radius` (M,) m, of `cell` (M,) m and `points` (M,). The
    wanted level puts a cell on about 1.5 px of the screen; what is out of view is coarser. When that takes too many
    points, all get coarser together. A tile keeps its `previous` level (-1: none) while that is nearly as good.
    """
    if not len(centre):
        return np.zeros(0, np.int64)
    distance = np.maximum(np.linalg.norm(centre - view.p_scene, axis=1) - radius, 1.0)
    pixel_m = distance * 2 * np.tan(view.fov / 2) / max(view.height_px, 1)
    wanted = np.maximum(np.log2(pixel_m * CELL_ON_SCREEN_PX / cell), 0.0)
    wanted += np.where(in_view(view, centre, radius), 0.0, OUT_OF_VIEW_LEVELS)
    levels = np.full(len(centre), MAX_LEVEL, np.int64)
    for coarser in np.arange(0.0, MAX_LEVEL + 0.5, 0.25):
        levels = _rounded(wanted + coarser, previous)
        if (points / 4.0**levels).sum() <= budget:
            break
    return levels


def in_view(view: View, centre: F64, radius: F64) -> Bool:
    """Whether spheres (M,) reach into the camera's view cone."""
    p_cam = (centre - view.p_scene) @ view.R_scene_cam
    half_angle = np.arctan(np.tan(view.fov / 2) * np.hypot(1.0, view.aspect))
    off_axis = np.arctan2(np.hypot(p_cam[:, 0], p_cam[:, 1]), p_cam[:, 2])
    distance = np.maximum(np.linalg.norm(p_cam, axis=1), 1e-6)
    return np.asarray(off_axis <= half_angle + np.arcsin(np.minimum(radius / distance, 1.0)))


def _rounded(wanted: F64, previous: I64 | None) -> I64:
    levels = np.clip(np.floor(wanted + 0.5), 0, MAX_LEVEL).astype(np.int64)
    if previous is None:
        return levels
    near = (previous >= 0) & (np.abs(np.clip(wanted, 0, MAX_LEVEL) - previous) <= 0.5 + HYSTERESIS)
    return np.where(near, previous, levels)
