"""A tile as coloured points around its own centre."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np

from common.arrays import F32, F64, I64, U8
from common.messages import MapTile

SUN = np.array([-0.45, 0.35, 0.82])
SIGMA_RANGE = (0.01, 1.0)
VIEWS_RANGE = (0, 10)
MAX_WALL_CELLS = 300


class Colouring(StrEnum):
    """What the colour of a point tells."""

    PHOTO = "Photo"
    HEIGHT = "Height"
    ACCURACY = "Accuracy"
    VIEWS = "Views"


@dataclass(frozen=True)
class Style:
    """How points are chosen and coloured; `z_range` in m, world of the flight, spans the colours of the heights."""

    colouring: Colouring
    min_views: int
    show_uncertain: bool
    z_range: tuple[float, float]


def tile_points(tile: MapTile, centre: F64, style: Style) -> tuple[F32, U8]:
    """Points (M, 3) m, in axes of world around `centre`, and their colours (M, 3) RGB.

    Around the centre of its tile a half-precision float resolves better than 1 cm.
    """
    shown = np.isfinite(tile.height)
    if not style.show_uncertain:
        shown &= ~tile.disputed & (tile.views >= style.min_views)
    row, col = np.nonzero(shown)
    height = np.where(shown, tile.height, np.nan)
    wall_row, wall_col, wall_height = _walls(height, tile.cell)
    row, col, z = np.r_[row, wall_row], np.r_[col, wall_col], np.r_[height[shown], wall_height]
    n = tile.height.shape[0]
    east = (tile.id.x * n + col + 0.5) * tile.cell - centre[0]
    north = (tile.id.y * n + row + 0.5) * tile.cell - centre[1]
    points = np.stack([east, north, z - centre[2]], axis=1).astype(np.float32)
    return points, _colours(tile, style)[row, col]


def _walls(height: F32, cell: float) -> tuple[I64, I64, F32]:
    """Rows, columns and heights (W,) of points that fill the steps of more than two cells between neighbours.

    A grid of heights has no points on walls; without these one would look through houses. They hang below the higher
    cell, and are only drawn, never exported.
    """
    lowest = height.copy()
    for here, there in ((np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:])):
        lowest[here] = np.fmin(lowest[here], height[there])
        lowest[:, here] = np.fmin(lowest[:, here], height[:, there])
    steps = np.nan_to_num((height - lowest) / cell - 1.0).astype(np.int64)
    steps = np.where(steps >= 1, np.minimum(steps, MAX_WALL_CELLS), 0)
    row, col = np.nonzero(steps)
    count = steps[row, col]
    below = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + 1
    row, col = np.repeat(row, count), np.repeat(col, count)
    return row, col, (height[row, col] - below * cell).astype(np.float32)


def _colours(tile: MapTile, style: Style) -> U8:
    match style.colouring:
        case Colouring.PHOTO:
            return tile.colour
        case Colouring.HEIGHT:
            low, high = style.z_range
            share, ramp = (tile.height - low) / max(high - low, 0.1), cv2.COLORMAP_TURBO
        case Colouring.ACCURACY:
            low, high = np.log(SIGMA_RANGE)
            share, ramp = (np.log(np.maximum(tile.sigma, 1e-4)) - low) / (high - low), cv2.COLORMAP_PLASMA
        case Colouring.VIEWS:
            low, high = VIEWS_RANGE
            share, ramp = (tile.views - np.float32(low)) / (high - low), cv2.COLORMAP_VIRIDIS
    index = np.nan_to_num(np.clip(share, 0, 1) * 255).astype(np.uint8)
    colour = cv2.cvtColor(cv2.applyColorMap(index, ramp), cv2.COLOR_BGR2RGB)
    return np.asarray((colour * _shade(tile)[..., None]).astype(np.uint8))


def _shade(tile: MapTile) -> F32:
    """Brightness (N, N) in 0.45 … 1 of the surface under a slanting sun, so that relief shows in any colouring."""
    north, east = np.gradient(tile.height, tile.cell)
    cosine = (SUN[2] - SUN[0] * east - SUN[1] * north) / np.sqrt(1 + east**2 + north**2) / np.linalg.norm(SUN)
    return np.asarray(np.nan_to_num(0.45 + 0.55 * np.clip(cosine, 0, 1), nan=0.8), np.float32)
