"""What one pair of photos says about one tile: the surface cut into cells.

The grid of disparities is a mesh; a cell takes the height of the mesh at its centre. So nothing depends on how many
points fall into a cell, and there are no gaps where pixels are larger than cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from air.mapping.triangulation import DISPARITY_STEPS, I16, UNKNOWN, Correspondences, PointGrid
from common.arrays import F16, F32, I32, U8
from common.messages import TileId

# Neighbouring pixels whose disparities differ by more lie on two surfaces: a wall between them was not seen.
MAX_STEP_PX = 1.0


@dataclass(frozen=True, eq=False)
class Layer:
    """Cells of a tile as one pair sees them, from (`row`, `column`) of the tile on.

    `photos` are the indices of both photos; `height` (n, m) float32 m in world, NaN where not seen; `sigma` (n, m)
    float16 m; `colour` (n, m, 3) uint8 RGB; `radius` (n, m) float16, distance of the pixel from its image centre.
    """

    photos: tuple[int, int]
    row: int
    column: int
    height: F32
    sigma: F16
    colour: U8
    radius: F16


def layers(
    matches: Correspondences, points: PointGrid, photos: tuple[int, int], cell: float, tile_cells: int
) -> dict[TileId, Layer]:
    """The pair's surface as layers of the tiles that it touches."""
    if not np.isfinite(points.p_origin[..., 2]).any():
        return {}
    # One axis at a time: a reduction over the first axes of an array of triples takes ten times as long.
    low, high = (np.array([f(points.p_origin[..., axis]) for axis in (0, 1)]) for f in (np.nanmin, np.nanmax))
    origin = np.floor((points.origin[:2] + low) / cell).astype(int)
    top = np.floor((points.origin[:2] + high) / cell).astype(int)
    columns, rows = top - origin + 1
    # Coordinates in cells from the centre of the first cell.
    shift = points.origin[:2] / cell - origin - 0.5
    height, pixel = _rasterise(
        points.p_origin, matches.disparity, shift[0], shift[1], 1 / cell, int(rows), int(columns)
    )
    height += np.float32(points.origin[2])
    found: dict[TileId, Layer] = {}
    for y in range(origin[1] // tile_cells, top[1] // tile_cells + 1):
        for x in range(origin[0] // tile_cells, top[0] // tile_cells + 1):
            row, column = y * tile_cells - origin[1], x * tile_cells - origin[0]
            part = np.s_[max(row, 0) : row + tile_cells, max(column, 0) : column + tile_cells]
            layer = _crop(matches, points, photos, height[part], pixel[part], max(-row, 0), max(-column, 0))
            if layer is not None:
                found[TileId(0, int(x), int(y))] = layer
    return found


def _crop(
    matches: Correspondences,
    points: PointGrid,
    photos: tuple[int, int],
    height: F32,
    pixel: I32,
    row: int,
    column: int,
) -> Layer | None:
    """The layer without empty rows and columns at its borders."""
    seen = pixel >= 0
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if len(rows) == 0:
        return None
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    source = np.maximum(pixel[part], 0)
    return Layer(
        photos,
        int(row + rows[0]),
        int(column + columns[0]),
        height[part].copy(),
        points.sigma.ravel()[source].astype(np.float16),
        matches.colour.reshape(-1, 3)[source],
        points.radius.ravel()[source].astype(np.float16),
    )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _rasterise(
    points: F32, disparity: I16, shift_x: float, shift_y: float, per_cell: float, rows: int, columns: int
) -> tuple[F32, I32]:
    """Height (rows, columns) float32 of the highest triangle over each cell's centre, and its nearest pixel or −1."""
    h, w = disparity.shape
    height = np.full((rows, columns), np.float32(np.nan), np.float32)
    pixel = np.full((rows, columns), np.int32(-1), np.int32)
    for v in range(h - 1):
        for u in range(w - 1):
            # Two triangles share the diagonal from (v, u + 1) to (v + 1, u).
            if disparity[v, u + 1] == UNKNOWN or disparity[v + 1, u] == UNKNOWN:
                continue
            a = _vertex(points, v, u, shift_x, shift_y, per_cell)
            b = _vertex(points, v, u + 1, shift_x, shift_y, per_cell)
            c = _vertex(points, v + 1, u, shift_x, shift_y, per_cell)
            d = _vertex(points, v + 1, u + 1, shift_x, shift_y, per_cell)
            if _is_flat(disparity[v, u], disparity[v, u + 1], disparity[v + 1, u]):
                _draw(a, b, c, v * w + u, v * w + u + 1, v * w + w + u, height, pixel)
            if _is_flat(disparity[v + 1, u + 1], disparity[v, u + 1], disparity[v + 1, u]):
                _draw(d, b, c, v * w + w + u + 1, v * w + u + 1, v * w + w + u, height, pixel)
    return height, pixel


@njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def _vertex(points: F32, v: int, u: int, shift_x: float, shift_y: float, per_cell: float) -> tuple[float, float, float]:
    return points[v, u, 0] * per_cell + shift_x, points[v, u, 1] * per_cell + shift_y, points[v, u, 2]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _is_flat(a: int, b: int, c: int) -> bool:
    """Whether three disparities are known and belong to one surface."""
    return a != UNKNOWN and max(a, b, c) - min(a, b, c) <= MAX_STEP_PX * DISPARITY_STEPS


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _draw(
    a: tuple[float, float, float],
    b: tuple[float, float, float],
    c: tuple[float, float, float],
    pixel_a: int,
    pixel_b: int,
    pixel_c: int,
    height: F32,
    pixel: I32,
) -> None:
    """Raises the cells whose centre lies in the triangle to its plane."""
    first, last = int(np.ceil(min(a[0], b[0], c[0]))), int(np.floor(max(a[0], b[0], c[0])))
    bottom, top = int(np.ceil(min(a[1], b[1], c[1]))), int(np.floor(max(a[1], b[1], c[1])))
    if first > last or bottom > top or np.isnan(a[2] + b[2] + c[2]):
        return
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if abs(area) < 1e-9:
        return
    for row in range(max(bottom, 0), min(top, height.shape[0] - 1) + 1):
        for column in range(max(first, 0), min(last, height.shape[1] - 1) + 1):
            x, y = column - a[0], row - a[1]
            # Barycentric coordinates of the cell's centre.
            at_b = (x * (c[1] - a[1]) - (c[0] - a[0]) * y) / area
            at_c = ((b[0] - a[0]) * y - x * (b[1] - a[1])) / area
            if at_b < -1e-6 or at_c < -1e-6 or at_b + at_c > 1 + 1e-6:
                continue
            z = a[2] + at_b * (b[2] - a[2]) + at_c * (c[2] - a[2])
            if not height[row, column] >= z:
                height[row, column] = z
                at_a = 1 - at_b - at_c
                pixel[row, column] = pixel_a if at_a >= max(at_b, at_c) else (pixel_b if at_b >= at_c else pixel_c)
