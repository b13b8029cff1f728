"""Dense disparities of a rectified pair: equation 2 of seed 000, coarse to fine, to a fraction of a pixel.

S. Sun et al., Real-time UAV 3D image point clouds mapping (seed 000), equation 2: the disparity of a pixel minimises
the sum of squared differences of gray values over a window. Here the windows follow the surface (each pixel of a
window is compared at its own disparity), images are normalised to local mean and contrast so that exposure does not
matter, and the minimum is found to a fraction of a pixel by Gauss-Newton (Lucas and Kanade, IJCAI 1981), whose normal
equation also predicts the standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from air.mapping.kernels import OUTSIDE, normal_equations, squared_difference
from common.arrays import F32, U8, AnyFloat, Bool

WINDOW_RADIUS = (4, 3, 2)  # px at full, half and coarser resolution
LEAN = 2
CONTRAST_RADIUS = 10
# Gray levels of noise: texture weaker than this is not stretched to full contrast.
NOISE_FLOOR = 2.0
# Largest share of a window's contrast that may remain unexplained: a normalised correlation of about 0.75.
MAX_RESIDUAL = 0.55
MAX_SIGMA_PX = 0.35
# What no window can do better than, and the least noise of normalised images: a blank wall has no residual either.
MIN_SIGMA_PX = 0.05
RESIDUAL_FLOOR = 0.01
MIN_UNIQUENESS = 1.12
LEFT_RIGHT_PX = 1.5
SPECKLE_PIXELS = 150
COARSEST_RANGE = 48
# Disparities that differ by more within a window belong to two surfaces.
MAX_STEP_PX = 3.0
GAUSS_NEWTON_STEPS = 3


@dataclass(frozen=True, eq=False)
class DisparityMap:
    """Disparities (h, w) float32 px of the left image, NaN where unknown, and their sigma (h, w) float32 px."""

    disparity: F32
    sigma: F32


def match(
    left: U8, right: U8, left_valid: Bool, right_valid: Bool, low: float, high: float, method: str = "block"
) -> DisparityMap:
    """Disparities of the left image between `low` and `high` px, found by "block" or "semi-global" search.

    left, right: rectified grayscale (h, w) uint8; left_valid, right_valid: (h, w) bool, pixels that a photo covers.
    """
    levels = 1 + max(1, int(np.ceil(np.log2(max(high - low, 1.0) / COARSEST_RANGE))))
    levels = min(levels, max(1, int(np.log2(min(left.shape) / 40.0))))
    lefts, rights = _pyramid(left, levels), _pyramid(right, levels)
    forward = _search(lefts, rights, low, high, method)
    backward = _search([_mirror(i) for i in rights], [_mirror(i) for i in lefts], low, high, method)
    half = (left.shape[1], left.shape[0])
    start = _enlarge(forward, half)
    field = _refine(lefts[0], rights[0], start, WINDOW_RADIUS[0])
    result = _subpixel(lefts[0], rights[0], field)
    inside = _inside(left_valid, right_valid, result.disparity)
    consistent = _consistent(result.disparity, _enlarge(_mirror(backward), half))
    return _without_speckles(result, inside & consistent)


def _search(lefts: list[F32], rights: list[F32], low: float, high: float, method: str) -> F32:
    """Disparities at half resolution, in pixels of that resolution, known everywhere."""
    if method == "semi-global":
        field = _semi_global(lefts[1], rights[1], low / 2, high / 2)
        return _refine(lefts[1], rights[1], field, _radius(1))
    top = len(lefts) - 1
    field = _block(lefts[top], rights[top], low / 2**top, high / 2**top)
    for level in range(top - 1, 0, -1):
        shape = lefts[level].shape
        field = _refine(lefts[level], rights[level], _enlarge(field, (shape[1], shape[0])), _radius(level))
    return field


def _block(left: F32, right: F32, low: float, high: float) -> F32:
    """Whole-pixel minimum of equation 2 over all disparities, gaps filled from around."""
    disparities = np.arange(int(np.floor(low)), int(np.ceil(high)) + 1)
    costs = np.full((len(disparities), *left.shape), OUTSIDE, np.float32)
    w = left.shape[1]
    for k, d in enumerate(disparities.tolist()):
        a, b = max(0, d), min(w, w + d)
        if b - a > 2:
            difference = left[:, a:b] - right[:, a - d : b - d]
            costs[k, :, a:b] = _box(difference * difference, _radius(2))
    best = np.argmin(costs, axis=0)
    rows, columns = np.indices(best.shape)
    least = costs[best, rows, columns].copy()
    for step in (-1, 0, 1):
        costs[np.clip(best + step, 0, len(disparities) - 1), rows, columns] = np.inf
    unique = np.min(costs, axis=0) > MIN_UNIQUENESS * least
    field = disparities[best].astype(np.float32)
    return _median(_fill(field, unique & (least < OUTSIDE * MAX_RESIDUAL)), 5)


def _semi_global(left: F32, right: F32, low: float, high: float) -> F32:
    """Disparities by H. Hirschmüller, Stereo processing by semiglobal matching (PAMI 2008), as in OpenCV."""
    first = int(np.floor(low))
    count = 16 * max(1, int(np.ceil((high - first + 1) / 16)))
    sgm = cv2.StereoSGBM.create(
        minDisparity=first,
        numDisparities=count,
        blockSize=5,
        P1=8 * 25,
        P2=32 * 25,
        uniquenessRatio=5,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    images = [np.clip(128 + 40 * i, 0, 255).astype(np.uint8) for i in (left, right)]
    margin = max(first + count, -first, 0)
    padded = [cv2.copyMakeBorder(i, 0, 0, margin, margin, cv2.BORDER_REPLICATE) for i in images]
    raw = sgm.compute(*padded)[:, margin : margin + left.shape[1]]
    return _fill(raw.astype(np.float32) / 16, raw >= 16 * first)


def _refine(left: F32, right: F32, start: F32, radius: int) -> F32:
    """The cheapest of the start, its neighbours ±1 px, and the highest and lowest surface near by.

    The extremes, first of a wide then of a narrow neighbourhood, bring the edges of the field to where they are
    in the image: the window on either side of a wall takes that side's disparity.
    """
    wide, narrow = (np.ones((size, size), np.uint8) for size in (4 * radius - 1, 5))
    best, least = start, _window_cost(left, right, start, radius)

    def offer(field: F32) -> None:
        nonlocal best, least
        cost = _window_cost(left, right, field, radius)
        best, least = np.where(cost < least, field, best), np.minimum(cost, least)

    offer(start + 1)
    offer(start - 1)
    offer(cv2.dilate(start, wide))
    offer(cv2.erode(start, wide))
    offer(cv2.dilate(best, narrow))
    offer(cv2.erode(best, narrow))
    return _median(best, 3)


def _subpixel(left: F32, right: F32, field: F32) -> DisparityMap:
    """Gauss–Newton from `field`: the disparities, NaN where texture or agreement is too weak, and their sigma px."""
    radius = WINDOW_RADIUS[0]
    count = (2 * radius + 1) ** 2
    start = field
    for _ in range(GAUSS_NEWTON_STEPS):
        field = _smooth(field, radius)
        gg, gr, rr = (_box(a, radius) for a in normal_equations(left, right, field))
        step = -gr / (gg + 1e-4)
        # A step beyond a pixel leaves the range in which the linearisation holds.
        field = field + np.clip(step, -0.7, 0.7)
    gg, gr, rr = (_box(a, radius) for a in normal_equations(left, right, field))
    sigma = np.sqrt((rr + RESIDUAL_FLOOR) / (count * (gg + 1e-6)))
    known = (rr < MAX_RESIDUAL) & (sigma < MAX_SIGMA_PX) & (np.abs(gr / (gg + 1e-4)) < 0.5)
    known &= np.abs(field - start) < 1.5
    return DisparityMap(np.where(known, field, np.nan).astype(np.float32), np.hypot(sigma, MIN_SIGMA_PX))


def _smooth(field: F32, radius: int) -> F32:
    """The field with the roughness inside a window averaged out, but not across the steps of a surface.

    Pixels of a window are compared each at its own disparity, so Gauss-Newton corrects their mean and would keep
    any roughness of the start.
    """
    size = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    spread = cv2.dilate(field, size) - cv2.erode(field, size)
    return np.where(spread < MAX_STEP_PX, _box(field, radius), field)


def _consistent(disparity: F32, other: F32) -> Bool:
    """Where the right image, asked at the matching pixel, answers with the same disparity."""
    u, v = _pixels(disparity.shape)
    known = np.nan_to_num(disparity)
    answer = cv2.remap(other, u - known, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=1e6)
    return np.asarray(np.abs(answer - known) < LEFT_RIGHT_PX)


def _inside(left_valid: Bool, right_valid: Bool, disparity: F32) -> Bool:
    u, v = _pixels(disparity.shape)
    size = np.ones((2 * WINDOW_RADIUS[0] + 1,) * 2, np.uint8)
    left, right = (cv2.erode(m.astype(np.uint8), size, borderValue=0) for m in (left_valid, right_valid))
    seen = cv2.remap(right, u - np.nan_to_num(disparity), v, cv2.INTER_NEAREST, borderValue=0)
    return np.asarray((left > 0) & (seen > 0))


def _without_speckles(result: DisparityMap, keep: Bool) -> DisparityMap:
    """The result without islands: small patches that differ from all around them are chance matches."""
    known = keep & np.isfinite(result.disparity)
    low = np.nanmin(result.disparity) if known.any() else 0.0
    quantised = np.where(known, (np.nan_to_num(result.disparity) - low) * 16 + 16, 0).clip(0, 32767).astype(np.int16)
    cv2.filterSpeckles(quantised, 0, SPECKLE_PIXELS, 16)
    return DisparityMap(np.where(quantised > 0, result.disparity, np.float32(np.nan)), result.sigma)


def _pyramid(image: U8, levels: int) -> list[F32]:
    """The image and its halves, each with local mean zero and local contrast one."""
    images = [image.astype(np.float32)]
    for _ in range(levels):
        h, w = images[-1].shape
        images.append(cv2.resize(images[-1], ((w + 1) // 2, (h + 1) // 2), interpolation=cv2.INTER_AREA))
    return [_normalise(i) for i in images]


def _normalise(image: F32) -> F32:
    mean = _box(image, CONTRAST_RADIUS)
    centred = image - mean
    variance = _box(centred * centred, CONTRAST_RADIUS)
    return np.asarray(centred / np.sqrt(variance + NOISE_FLOOR**2), np.float32)


def _window_cost(left: F32, right: F32, field: F32, radius: int) -> F32:
    """Equation 2 per pixel, of the best window that holds the pixel near its middle.

    Beside a wall a window that leans away from it sees one surface only (Fusiello et al., CVPR 1997).
    """
    cost = _box(squared_difference(left, right, field), radius)
    return np.asarray(cv2.erode(cost, np.ones((2 * LEAN + 1, 2 * LEAN + 1), np.uint8)))


def _box(image: AnyFloat, radius: int) -> F32:
    """Mean over a window of 2·radius + 1 px."""
    size = (2 * radius + 1, 2 * radius + 1)
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, size, borderType=cv2.BORDER_REFLECT_101))


def _fill(field: F32, known: Bool) -> F32:
    """The field with its gaps filled by the weighted mean of what surrounds them, coarse to fine."""
    if known.all() or min(field.shape) < 2:
        return field if known.any() else np.zeros_like(field)
    weight = known.astype(np.float32)
    size = ((field.shape[1] + 1) // 2, (field.shape[0] + 1) // 2)
    total = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(field * weight, size, interpolation=cv2.INTER_AREA) / np.maximum(total, 1e-6)
    around = cv2.resize(_fill(mean, total > 0), field.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(known, field, around)


def _enlarge(field: F32, size: tuple[int, int]) -> F32:
    """Disparities of a coarser image for one of `size` (width, height), in its pixels."""
    factor = size[0] / field.shape[1]
    return np.asarray(cv2.resize(field, size, interpolation=cv2.INTER_LINEAR) * np.float32(factor))


def _median(field: F32, size: int) -> F32:
    return np.asarray(cv2.medianBlur(field, size))


def _mirror(image: F32) -> F32:
    return np.ascontiguousarray(image[:, ::-1])


def _pixels(shape: tuple[int, ...]) -> tuple[F32, F32]:
    u, v = np.meshgrid(np.arange(shape[1], dtype=np.float32), np.arange(shape[0], dtype=np.float32))
    return u, v


def _radius(level: int) -> int:
    return WINDOW_RADIUS[min(level, len(WINDOW_RADIUS) - 1)]
