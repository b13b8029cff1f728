"""Trees, bushes and hedges as a raster: how high plants stand above the ground, and the colour of their leaves."""

from __future__ import annotations

import numpy as np

from air.sources.simulated.sites.layout import Bounds, Tree
from air.sources.simulated.sites.noise import periodic_detail
from air.sources.simulated.sites.surface import CELL
from common.arrays import F32, F64, U8

_LUMPS = 256
_LUMPY = 0.11
"""Height of the lumps of a crown, of its radius."""
BROADLEAF = [(74, 94, 48), (62, 84, 46), (82, 98, 52), (86, 94, 56), (56, 78, 48), (92, 100, 60)]
CONIFER = [(42, 62, 42), (50, 70, 46), (36, 54, 40)]


class Plants:
    """A raster of plants that grows tree by tree: `height` (h, w) m above the ground, `leaves` (h, w, 3) RGB."""

    def __init__(self, rng: np.random.Generator, bounds: Bounds):
        self._rng, self._bounds = rng, bounds
        self.height: F32 = np.zeros(bounds.grid(CELL), np.float32)
        self.leaves: U8 = np.zeros((*self.height.shape, 3), np.uint8)
        self.leaves[:] = BROADLEAF[0]
        self._lumps = periodic_detail(rng, _LUMPS, 4.5, 16.0)

    def grow(self, tree: Tree, conifer: bool = False) -> None:
        """Add a tree or bush: a lumpy dome, or a cone."""
        colours = CONIFER if conifer else BROADLEAF
        colour = np.array(colours[int(self._rng.integers(len(colours)))]) * self._rng.normal(1.0, 0.08)
        lobes, phases = self._rng.uniform(0.03, 0.14, 4), self._rng.uniform(0, 2 * np.pi, 4)
        shift = self._rng.integers(0, _LUMPS, 2)
        column, row = np.floor(self._bounds.pixels(np.array([tree.x, tree.y]), CELL)).astype(int)
        reach = int(np.ceil(1.35 * tree.radius / CELL))
        rows = slice(max(row - reach, 0), max(row + reach + 1, 0))
        columns = slice(max(column - reach, 0), max(column + reach + 1, 0))
        part = self.height[rows, columns]
        y, x = np.mgrid[rows.start : rows.start + part.shape[0], columns.start : columns.start + part.shape[1]]
        lump = self._lumps[(y + shift[0]) % _LUMPS, (x + shift[1]) % _LUMPS]
        dx, dy = self._bounds.west + x * CELL - tree.x, self._bounds.south + y * CELL - tree.y
        bearing = np.arctan2(dy, dx)
        waves = sum(size * np.sin((n + 2) * bearing + phases[n]) for n, size in enumerate(lobes))
        q = np.hypot(dx, dy) / (tree.radius * (1 + waves)) * (1 + 0.06 * lump)
        profile = np.maximum(1 - 0.88 * q, 0.1) if conifer else 0.42 + 0.58 * np.sqrt(np.clip(1 - q * q, 0, 1))
        top = np.where(q < 1, tree.height * profile + _LUMPY * tree.radius * lump, 0)
        higher = top > part
        shade = np.clip(1 + 0.16 * lump, 0.4, 1.5)[..., None]
        self.leaves[rows, columns][higher] = np.clip(colour * shade, 8, 245)[higher]
        part[higher] = top[higher]

    def clear(self, xy: F64, radius: float) -> None:
        """Leave nothing within a radius m of points (N, 2) m."""
        y, x = np.mgrid[-1 : 1 : 1j * (2 * round(radius / CELL) + 1), -1 : 1 : 1j * (2 * round(radius / CELL) + 1)]
        disc, half = x * x + y * y <= 1, round(radius / CELL)
        for column, row in np.round(self._bounds.pixels(xy, CELL)).astype(int):
            if half <= row < self.height.shape[0] - half and half <= column < self.height.shape[1] - half:
                self.height[row - half : row + half + 1, column - half : column + half + 1][disc] = 0


def scatter_trees(
    rng: np.random.Generator, bounds: Bounds, spacing: float, radius: tuple[float, float], slender: float
) -> list[Tree]:
    """Trees about `spacing` m apart, of a range of radii m, `slender` times as high as their crown is wide."""
    across, along = int((bounds.east - bounds.west) / spacing), int((bounds.north - bounds.south) / spacing)
    place = (np.mgrid[0:along, 0:across].reshape(2, -1).T + rng.uniform(0.0, 1.0, (along * across, 2))) * spacing
    sizes, high = rng.uniform(*radius, len(place)), rng.uniform(0.85, 1.25, len(place))
    return [
        Tree(bounds.west + float(x), bounds.south + float(y), float(r), float(2 * slender * r * h))
        for (y, x), r, h in zip(place, sizes, high, strict=True)
    ]
