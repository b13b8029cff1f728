"""The surface that the video camera sees, as plain arrays that compiled code takes, and how they are made.

The surface is the highest of a raster of ground and vegetation (bilinear), of houses (exact planes) and of still water.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from air.sources.simulated.sites.layout import Bounds
from air.sources.simulated.sites.scene import Light, Solids
from air.sources.simulated.sites.solids import index_solids
from common.arrays import F32, F64, I32, U8, U32

CELL = 0.125
"""Between nodes of the raster, m."""
LUMP = 4
"""Cells of the raster along the side of a lump, whose highest point is known."""
INDEX_CELL = 1.0
LEVELS = 6
"""Of the pyramid of highest points: cells of 1, 2, … 32 m."""
MIPS = 7
"""Of the texture: the coarsest texel is 64 times the finest."""
LIGHT_SCALE = 255.0 / np.sqrt(1.5)
"""Colours are stored as the root of light times this: 255 is 1.5 times what white paper gives under light 1."""
PATTERN_TEXELS, PATTERN_MIPS = 512, 6
DETAIL_TEXELS, DETAIL_MIPS = 1024, 6
PATTERN_TEXEL, DETAIL_TEXEL = 0.02, 0.004


class Surface(NamedTuple):
    """All that a ray can meet; node [0, 0] of every raster is at (`west`, `south`), rows go north.

    `height` (h, w) m every CELL; `lump_top` its highest point per lump. Per cell of INDEX_CELL, its eight neighbours
    included: `floor` and `steep` (rows, columns) are the lowest height and the steepest slope of the raster, and
    `listed[first[c]:first[c + 1]]` the solids. `tops` holds the highest points of everything, level by level as
    `top_at` (LEVELS, 3) says: begin, rows, columns. `colour` holds light that the raster sends out, RGB as LIGHT_SCALE
    says and the strength of the finest detail, a byte each from the lowest on, level by level as `colour_at` (MIPS, 3)
    says, texels of `texel` m at the finest. `shadow` (h, w) m: a point below it lies in the shade. `sway` (h, w) is 255
    where plants move fully. `pattern` and `detail` are periodic textures, level by level: 128 is 1.
    """

    west: float
    south: float
    height: F32
    lump_top: F32
    floor: F32
    steep: F32
    first: I32
    listed: I32
    tops: F32
    top_at: I32
    solids: Solids
    colour: U32
    colour_at: I32
    texel: float
    per_texel: float
    shadow: F32
    sway: U8
    pattern: U8
    detail: U8
    water: float
    """Height of still water, m; −inf without."""
    highest: float
    lowest: float
    still: int
    """Solids from this one on move."""


def texture_grid(bounds: Bounds, texel: float) -> tuple[int, int]:
    """Rows and columns of the finest texture, multiples of the coarsest texel."""
    coarsest = 2 ** (MIPS - 1)
    rows, columns = bounds.grid(texel)
    return -(-rows // coarsest) * coarsest, -(-columns // coarsest) * coarsest


def empty_texture(bounds: Bounds, texel: float) -> tuple[U32, I32]:
    """Room for all levels of a texture (N,) and where they are: (MIPS, 3) begin, rows, columns."""
    rows, columns = texture_grid(bounds, texel)
    at = np.zeros((MIPS, 3), np.int64)
    at[:, 1], at[:, 2] = rows >> np.arange(MIPS), columns >> np.arange(MIPS)
    at[1:, 0] = np.cumsum(at[:-1, 1] * at[:-1, 2])
    return np.empty(int(at[-1, 0] + at[-1, 1] * at[-1, 2]), "<u4"), at.astype(np.int32)


def texture_level(colour: U32, colour_at: I32, level: int) -> U8:
    """One level (H, W, 4) uint8 of a texture, a view."""
    begin, rows, columns = (int(n) for n in colour_at[level])
    return colour[begin : begin + rows * columns].view(np.uint8).reshape(rows, columns, 4)


def build_surface(
    bounds: Bounds, height: F32, solids: Solids, moving: Solids, texel: float, light: Light, water: float, sway: U8,
    textures: tuple[U8, U8],
) -> Surface:  # fmt: skip
    """The surface of a raster (h, w) m and solids, with room for its colours."""
    first, listed, _ = index_solids(solids, bounds, INDEX_CELL, INDEX_CELL)
    rows, columns = bounds.grid(INDEX_CELL)
    own_top = index_solids(solids, bounds, INDEX_CELL)[2].reshape(rows, columns).astype(np.float32)
    highest, lowest = _extremes(height, round(INDEX_CELL / CELL), (rows, columns))
    tops, top_at = _pyramid(np.maximum(np.maximum(highest, own_top), np.float32(water)))
    slope = np.maximum(
        np.abs(np.diff(height, axis=0, append=height[-1:])), np.abs(np.diff(height, append=height[:, -1:]))
    )
    steep = _extremes(np.asarray(slope / CELL, np.float32), round(INDEX_CELL / CELL), (rows, columns))[0]
    lumps = (-(-height.shape[0] // LUMP), -(-height.shape[1] // LUMP))
    colour, colour_at = empty_texture(bounds, texel)
    return Surface(
        bounds.west, bounds.south, height, _extremes(height, LUMP, lumps)[0],
        cv2.erode(lowest, np.ones((3, 3))), cv2.dilate(steep, np.ones((3, 3))), first, listed, tops, top_at,
        np.concatenate([solids, moving]), colour, colour_at, texel, 1 / texel,
        _shadow(bounds, height, solids, light), sway, *textures, water, float(tops.max()) + 0.01,
        float(height.min()), len(solids),
    )  # fmt: skip


def _extremes(raster: F32, factor: int, shape: tuple[int, int]) -> tuple[F32, F32]:
    """Highest and lowest value of each cell of `factor` × `factor` nodes, its far border included."""
    rows, columns = shape
    pad = ((0, rows * factor + 1 - raster.shape[0]), (0, columns * factor + 1 - raster.shape[1]))
    wide = np.pad(raster, [(low, max(high, 0)) for low, high in pad], mode="edge")
    window = np.ones((factor + 1, factor + 1))
    high, low = cv2.dilate(wide, window, anchor=(0, 0)), cv2.erode(wide, window, anchor=(0, 0))
    take = (slice(0, rows * factor, factor), slice(0, columns * factor, factor))
    return np.ascontiguousarray(high[take]), np.ascontiguousarray(low[take])


def _pyramid(top: F32) -> tuple[F32, I32]:
    """Highest points level by level, the eight neighbours of each cell included, and where each level is."""
    parts, at, begin = [], [], 0
    for _ in range(LEVELS):
        parts.append(cv2.dilate(top, np.ones((3, 3))).ravel())
        at.append((begin, *top.shape))
        begin += top.size
        even = np.pad(top, [(0, size % 2) for size in top.shape], mode="edge")
        top = np.maximum(np.maximum(even[::2, ::2], even[1::2, ::2]), np.maximum(even[::2, 1::2], even[1::2, 1::2]))
    return np.concatenate(parts), np.array(at, np.int32)


def _shadow(bounds: Bounds, height: F32, solids: Solids, light: Light) -> F32:
    """Height (h, w) m below which a point does not see the sun, what is within a cell of it left out.

    The maximum over distances d of the height there less d times the rise of the sun, by doubling.
    """
    shade: F32 = rasterize(bounds, height, solids)
    sun = np.asarray(light.sun) / np.hypot(light.sun[0], light.sun[1])
    distance, farthest = 2 * CELL, (float(shade.max()) - float(shade.min())) / sun[2]
    shade = _moved(shade, sun, distance)
    while distance < farthest:
        shade = np.maximum(shade, _moved(shade, sun, distance))
        distance *= 2
    return shade


def _moved(shade: F32, sun: F64, distance: float) -> F32:
    shift = np.array([[1.0, 0.0, sun[0] * distance / CELL], [0.0, 1.0, sun[1] * distance / CELL]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(shade, shift, shade.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved - np.float32(sun[2] * distance), np.float32)


def rasterize(bounds: Bounds, height: F32, solids: Solids) -> F32:
    """Height (h, w) m of the raster and the solids on the nodes of the raster."""
    raster = height.copy()
    for s in solids:
        reach = np.hypot(s["a"], s["b"])
        low = np.maximum(np.floor(bounds.pixels(np.array([s["x"] - reach, s["y"] - reach]), CELL)), 0).astype(int)
        high = np.ceil(bounds.pixels(np.array([s["x"] + reach, s["y"] + reach]), CELL)).astype(int) + 1
        part = raster[low[1] : max(high[1], 0), low[0] : max(high[0], 0)]
        y, x = np.mgrid[: part.shape[0], : part.shape[1]]
        x, y = bounds.west + (low[0] + x) * CELL - s["x"], bounds.south + (low[1] + y) * CELL - s["y"]
        u, v = s["cos"] * x + s["sin"] * y, s["cos"] * y - s["sin"] * x
        top = np.where((np.abs(u) <= s["a"]) & (np.abs(v) <= s["b"]), s["top"] - s["slope"] * np.abs(v), -np.inf)
        np.maximum(part, top, out=part, casting="same_kind")
    return raster
