"""The surface of one flight as a single mosaic of its tiles, without the cells that nobody should trust."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import F32, F64, U8, Bool
from common.errors import ExportError
from common.messages import MapTile

MAX_CELLS = 250_000_000
MIN_VIEWS = 3
"""Photos that must agree on a cell: a single pair gives two, and at edges and in trees a pair errs unchecked."""
_BAND_ROWS = 1024


@dataclass(frozen=True, eq=False)
class Surface:
    """A mosaic of R × C cells, row 0 at the south edge, column 0 at the west edge.

    Cell (row, col) has its centre at east `x0 + (col + 0.5)·cell`, north `y0 + (row + 0.5)·cell`, m in world.
    `height` (R, C) float32 m in world, NaN where there is no surface; `sigma` (R, C) float32 m;
    `colour` (R, C, 3) uint8 RGB; `views` (R, C) uint8; `disputed` (R, C) bool.
    """

    cell: float
    x0: float
    y0: float
    height: F32
    sigma: F32
    colour: U8
    views: U8
    disputed: Bool

    @property
    def valid(self) -> Bool:
        """Where the mosaic has a height (R, C)."""
        return np.isfinite(self.height)

    def points(self) -> tuple[F64, U8, F32, U8]:
        """Cell centres with a height: p_world (N, 3) m, colour (N, 3) RGB, sigma (N,) m, views (N,)."""
        row, col = np.nonzero(self.valid)
        east, north = self.x0 + (col + 0.5) * self.cell, self.y0 + (row + 0.5) * self.cell
        p_world = np.stack([east, north, self.height[row, col].astype(float)], axis=1)
        return p_world, self.colour[row, col], self.sigma[row, col], self.views[row, col]


def mosaic(
    tiles: Iterable[MapTile],
    min_views: int = MIN_VIEWS,
    keep_disputed: bool = False,
    min_patch_cells: int = 4,
    patch_step: float = 1.0,
) -> Surface:
    """The surface of the finest tiles of one flight; of a tile that comes twice the newest revision counts.

    A cell is NaN when fewer than `min_views` photos agree on it, when photos disagree (unless `keep_disputed`),
    or when it belongs to a speck: fewer than `min_patch_cells` cells that touch by their sides with height steps
    of at most `patch_step` m, so that a lone spike over solid ground goes too.
    Raises ExportError when there are no tiles, when flights or cell sizes mix, and when the box around the
    tiles is too large to hold.
    """
    newest = _newest_of_finest_level(tiles)
    surface = _paste(newest)
    trusted = surface.valid & (surface.views >= min_views)
    if not keep_disputed:
        trusted &= ~surface.disputed
    surface.height[~trusted] = np.nan
    surface.height[_specks(surface.height, min_patch_cells, patch_step)] = np.nan
    surface.colour[~surface.valid] = 0
    return surface


def _newest_of_finest_level(tiles: Iterable[MapTile]) -> list[MapTile]:
    newest: dict[tuple[int, int, int], MapTile] = {}
    for tile in tiles:
        key = (tile.id.level, tile.id.x, tile.id.y)
        if key not in newest or tile.revision > newest[key].revision:
            newest[key] = tile
    if not newest:
        raise ExportError("the map holds no tiles: nothing was mapped, so there is no surface to export")
    finest = min(level for level, _, _ in newest)
    chosen = [newest[key] for key in sorted(newest) if key[0] == finest]
    kinds = {(tile.flight, tile.cell, tile.height.shape) for tile in chosen}
    if len(kinds) > 1:
        found = "; ".join(f"flight {flight!r}, cells of {cell} m, {shape}" for flight, cell, shape in sorted(kinds))
        raise ExportError(f"tiles of different kinds cannot share one surface ({found}): export each flight by itself")
    return chosen


def _paste(tiles: Sequence[MapTile]) -> Surface:
    n, cell = tiles[0].height.shape[0], tiles[0].cell
    x, y = np.array([t.id.x for t in tiles]), np.array([t.id.y for t in tiles])
    rows, cols = (int(np.ptp(y)) + 1) * n, (int(np.ptp(x)) + 1) * n
    if rows * cols > MAX_CELLS:
        raise ExportError(
            f"the tiles of flight {tiles[0].flight!r} lie {rows * cell:.0f} × {cols * cell:.0f} m apart, "
            f"{rows * cols / 1e6:.0f} M cells of at most {MAX_CELLS / 1e6:.0f} M: leave out the tiles that stray"
        )
    surface = Surface(
        cell=cell,
        x0=float(x.min()) * n * cell,
        y0=float(y.min()) * n * cell,
        height=np.full((rows, cols), np.nan, np.float32),
        sigma=np.full((rows, cols), np.nan, np.float32),
        colour=np.zeros((rows, cols, 3), np.uint8),
        views=np.zeros((rows, cols), np.uint8),
        disputed=np.zeros((rows, cols), np.bool_),
    )
    for tile in tiles:
        row, col = (tile.id.y - int(y.min())) * n, (tile.id.x - int(x.min())) * n
        place = np.s_[row : row + n, col : col + n]
        surface.height[place], surface.sigma[place] = tile.height, tile.sigma
        surface.colour[place], surface.views[place] = tile.colour, tile.views
        surface.disputed[place] = tile.disputed
    return surface


def _specks(height: F32, min_cells: int, step: float) -> Bool:
    """Cells (R, C) that belong to a connected patch of fewer than `min_cells` cells.

    Worked in bands of rows to bound the memory; a margin of `min_cells` rows keeps the answer exact, for a patch
    that reaches from inside a band to the end of its margin has enough cells.
    """
    specks = np.zeros(height.shape, np.bool_)
    for first in range(0, len(height), _BAND_ROWS):
        top = max(first - min_cells, 0)
        band = _specks_of_band(height[top : first + _BAND_ROWS + min_cells], min_cells, step)
        specks[first : first + _BAND_ROWS] = band[first - top : first - top + _BAND_ROWS]
    return specks


def _specks_of_band(height: F32, min_cells: int, step: float) -> Bool:
    """As `_specks`. The picture of the graph has cells at its even pixels and the links between them at the odd ones.

    So one pass of 4-connected labelling respects the height steps as well.
    """
    rows, cols = height.shape
    graph = np.zeros((2 * rows - 1, 2 * cols - 1), np.uint8)
    graph[::2, ::2] = np.isfinite(height)
    with np.errstate(invalid="ignore"):
        graph[1::2, ::2] = np.abs(np.diff(height, axis=0)) <= step
        graph[::2, 1::2] = np.abs(np.diff(height, axis=1)) <= step
    _, labels = cv2.connectedComponents(graph, connectivity=4, ltype=cv2.CV_32S)
    of_cell = labels[::2, ::2]
    small = np.bincount(of_cell.ravel()) < min_cells
    small[0] = False
    return np.asarray(small[of_cell], np.bool_)
