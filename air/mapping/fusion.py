"""One surface from what many pairs of photos say about the same cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from air.mapping.layer import Layer
from common.arrays import F16, F32, F64, I32, I64, U8, Bool

# Heights agree within this many standard deviations of their difference, and a quarter of a cell.
AGREEMENT_SIGMAS = 3.0
AGREEMENT_CELLS = 0.25
# More outliers than this share make a cell disputed.
MAX_OUTLIER_SHARE = 1 / 3
# Of two surfaces that are nearly as well supported a surface model shows the upper one.
UPPER_SUPPORT = 0.9
CLEAR_MAJORITY = 0.7
# A layer's sigma is raised to what its heights show, but a layer that is plainly wrong stays in dispute.
MAX_EXCESS = 4.0
MIN_COMMON_CELLS = 100
MEDIAN_TO_SIGMA = 1.4826
# The part of a pair's sigma that all pairs share (poses adjusted together), so that averaging does not lower it.
COMMON_SHARE = 0.3


@dataclass(frozen=True, eq=False)
class Surface:
    """Fused cells of a tile, arrays (N, N) as in `MapTile`."""

    height: F32
    sigma: F32
    colour: U8
    views: U8
    disputed: Bool


def fuse(layers: Sequence[Layer], cell: float, tile_cells: int) -> Surface:
    """The surface that most of the layers agree on, cell by cell.

    The height that gathers the most weight (inverse variance) within the agreement is the start; the result is the
    inverse-variance mean of all that agree with it. `views` counts the photos, not the pairs, that agree; the colour
    comes from the agreeing photo that saw the cell nearest to its image centre.
    """
    shape = (len(layers), tile_cells, tile_cells)
    height, sigma, radius = (np.full(shape, np.nan, np.float32) for _ in range(3))
    for k, layer in enumerate(layers):
        part = _part(layer)
        height[k][part], sigma[k][part], radius[k][part] = layer.height, layer.sigma, layer.radius
    numbers = {photo: n for n, photo in enumerate(sorted({p for layer in layers for p in layer.photos}))}
    photos = np.array([[numbers[p] for p in layer.photos] for layer in layers], np.int32).reshape(-1, 2)
    first, *_ = _fuse(height, sigma, radius, photos, AGREEMENT_CELLS * cell)
    for k, layer in enumerate(layers):
        sigma[k] *= _excess(height[k][_part(layer)], first[_part(layer)], layer.sigma)
    fused, deviation, views, disputed, source = _fuse(height, sigma, radius, photos, AGREEMENT_CELLS * cell)
    colour = np.zeros((tile_cells, tile_cells, 3), np.uint8)
    for k, layer in enumerate(layers):
        part = _part(layer)
        best = source[part] == k
        colour[part][best] = layer.colour[best]
    return Surface(fused, deviation, colour, views, disputed)


def _excess(height: F32, fused: F32, sigma: F16) -> float:
    """How many times more than predicted a layer differs from what all agree on, within [1, MAX_EXCESS].

    What a pose that is a little wrong does to a whole layer is no dispute about its cells.
    """
    difference = np.abs(height - fused)
    difference = difference[difference > 0]
    if len(difference) < MIN_COMMON_CELLS:
        return 1.0
    ratio = MEDIAN_TO_SIGMA * float(np.median(difference)) / float(np.nanmedian(sigma.astype(np.float32)))
    return float(np.clip(ratio, 1.0, MAX_EXCESS))


def _part(layer: Layer) -> tuple[slice, slice]:
    rows, columns = layer.height.shape
    return np.s_[layer.row : layer.row + rows, layer.column : layer.column + columns]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _fuse(heights: F32, sigmas: F32, radii: F32, photos: I32, floor: float) -> tuple[F32, F32, U8, Bool, I32]:
    count, rows, columns = heights.shape
    height = np.full((rows, columns), np.nan, np.float32)
    deviation = np.full((rows, columns), np.nan, np.float32)
    views = np.zeros((rows, columns), np.uint8)
    disputed = np.zeros((rows, columns), np.bool_)
    source = np.full((rows, columns), -1, np.int32)
    z, sigma, weight = np.empty(count), np.empty(count), np.empty(count)
    layer, order = np.empty(count, np.int64), np.empty(count, np.int64)
    agrees = np.empty(count, np.bool_)
    seen = np.full(photos.max() + 1 if count else 1, -1, np.int64)
    for row in range(rows):
        for column in range(columns):
            n = 0
            for k in range(count):
                if np.isfinite(heights[k, row, column]):
                    z[n], sigma[n], layer[n] = heights[k, row, column], sigmas[k, row, column], k
                    weight[n] = 1 / (sigma[n] * sigma[n])
                    n += 1
            if n == 0:
                continue
            best = _consensus(z[:n], sigma[:n], weight[:n], floor, order[:n])
            total, mean, inliers = 0.0, 0.0, 0
            for i in range(n):
                limit = AGREEMENT_SIGMAS * np.sqrt(sigma[i] ** 2 + sigma[best] ** 2) + floor
                agrees[i] = abs(z[i] - z[best]) <= limit
                if agrees[i]:
                    total += weight[i]
                    mean += weight[i] * (z[i] - z[best])
                    inliers += 1
            mean = z[best] + mean / total
            scatter, nearest, cell = 0.0, np.inf, row * columns + column
            for i in range(n):
                if not agrees[i]:
                    continue
                scatter += weight[i] * (z[i] - mean) ** 2
                for side in range(2):
                    photo = photos[layer[i], side]
                    if seen[photo] != cell:
                        seen[photo] = cell
                        views[row, column] += 1
                if radii[layer[i], row, column] < nearest:
                    nearest = radii[layer[i], row, column]
                    source[row, column] = layer[i]
            # Scatter beyond the prediction raises it; a common part never averages out.
            excess = max(1.0, scatter / max(inliers - 1, 1))
            variance = excess / total + COMMON_SHARE**2 * inliers / total
            height[row, column] = mean
            deviation[row, column] = np.sqrt(variance)
            disputed[row, column] = n - inliers > MAX_OUTLIER_SHARE * n
    return height, deviation, views, disputed, source


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _consensus(z: F64, sigma: F64, weight: F64, floor: float, order: I64) -> int:
    """Index of the height that most of the weight agrees with; of two that are nearly equal in that, the upper one."""
    _sort(z, order)
    half, total = 0.0, weight.sum()
    middle = order[-1]
    for i in order:
        half += weight[i]
        if half >= 0.5 * total:
            middle = i
            break
    # Where a clear majority agrees with the weighted median nothing else can win: the search is for the rest.
    if _support(middle, z, sigma, weight, floor) > CLEAR_MAJORITY * total:
        return int(middle)
    best, best_support = order[0], 0.0
    for i in order:
        support = _support(i, z, sigma, weight, floor)
        if support > UPPER_SUPPORT * best_support:
            best, best_support = i, max(support, best_support)
    return int(best)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _sort(z: F64, order: I64) -> None:
    """Fills `order` with the indices of ascending heights, by insertion: there are few, and nothing is allocated."""
    for i in range(len(z)):
        j = i
        while j > 0 and z[order[j - 1]] > z[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = i


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _support(i: int, z: F64, sigma: F64, weight: F64, floor: float) -> float:
    support = 0.0
    for j in range(len(z)):
        if abs(z[j] - z[i]) <= AGREEMENT_SIGMAS * np.sqrt(sigma[i] ** 2 + sigma[j] ** 2) + floor:
            support += weight[j]
    return support
