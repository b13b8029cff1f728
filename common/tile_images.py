"""A map tile as images: heights on a linear scale, their sigma on a logarithmic one, colour as JPEG.

Images are north up (first row at the north edge), a tile's arrays south up, so every plane is flipped on the way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from common.arrays import F32, U8, U16, Bool
from common.images import decode_jpeg, decode_png, encode_jpeg, encode_png, fill_smoothly
from common.messages import MapTile

HEIGHT_STEP = 0.005
SIGMA_MIN = 0.001
SIGMA_RATIO = 1.06
_TOP = {8: 255, 16: 65535}
# What is given up, in this order, when a tile is too large: JPEG quality first, then height resolution. The last
# rung holds even pure noise of 256 × 256 cells within 256 kB.
_LADDER = ((90, 1), (75, 1), (50, 1), (30, 1), (30, 16), (30, 256), (20, 1024), (10, 4096))


@dataclass(frozen=True)
class HeightScale:
    """Height of pixel value p > 0: `base + (p − 1)·step`, m in world."""

    base: float
    step: float


def pack_images(tile: MapTile, budget: int) -> dict[str, Any]:
    """Image fields of the `map_tile` schema, together at most `budget` bytes, for a tile whose arrays were checked.

    Raises ValueError when even the coarsest encoding is larger.
    """
    known = np.isfinite(tile.height)
    sigma = encode_png(_north_up(sigma_to_pixels(tile.sigma, known)))
    views, disputed = encode_png(_north_up(tile.views)), encode_png(_north_up(tile.disputed))
    colour = _north_up(fill_smoothly(tile.colour, known))
    for quality, coarser in _LADDER:
        scale = fit_height_scale(tile.height[known], coarser)
        height = encode_png(_north_up(height_to_pixels(tile.height, scale)))
        jpeg = encode_jpeg(colour, quality)
        if len(height) + len(sigma) + len(views) + len(disputed) + len(jpeg) <= budget:
            return {
                "height_base": scale.base,
                "height_step": scale.step,
                "height_png": height,
                "sigma_min": SIGMA_MIN,
                "sigma_ratio": SIGMA_RATIO,
                "sigma_png": sigma,
                "colour_jpeg": jpeg,
                "views_png": views,
                "disputed_png": disputed,
            }
    raise ValueError(f"does not fit into {budget} bytes: send smaller tiles")


def unpack_images(fields: Mapping[str, Any]) -> tuple[F32, F32, U8, U8, Bool]:
    """Height, sigma, colour, views and disputed (south up, as in MapTile) of the image fields of a `map_tile`.

    Raises ValueError naming the field when an image is damaged or the images contradict each other.
    """
    size = fields["size"]
    height_px = _plane(fields, "height_png", size, 16)
    sigma_px = _plane(fields, "sigma_png", size, 8)
    views = _plane(fields, "views_png", size, 8)
    disputed = _plane(fields, "disputed_png", size, 1)
    known = height_px > 0
    if not np.array_equal(known, sigma_px > 0):
        raise ValueError("sigma_png knows other cells than height_png")
    try:
        colour = _south_up(decode_jpeg(fields["colour_jpeg"], size))
    except ValueError as error:
        raise ValueError(f"colour_jpeg {error}") from error
    height = pixels_to_height(height_px, HeightScale(fields["height_base"], fields["height_step"]))
    sigma = pixels_to_sigma(sigma_px, fields["sigma_min"], fields["sigma_ratio"])
    return height, sigma, np.where(known[..., None], colour, np.uint8(0)), views, disputed


def fit_height_scale(heights: F32, coarser: int = 1) -> HeightScale:
    """The finest scale with a step of 0.005·2ᵏ m that holds finite heights (K,) m in 16 bits; then made `coarser`."""
    if heights.size == 0:
        return HeightScale(0.0, HEIGHT_STEP * coarser)
    low, high = float(heights.min()), float(heights.max())
    excess = (high - low) / (HEIGHT_STEP * (_TOP[16] - 3))
    step = HEIGHT_STEP * coarser * 2.0 ** max(0, math.ceil(math.log2(excess)) if excess > 0 else 0)
    # A base on a multiple of the step makes encoding a decoded tile again change nothing.
    return HeightScale(round(low / step) * step, step)


def height_to_pixels(height: F32, scale: HeightScale) -> U16:
    """Pixels (N, N) uint16 of heights (N, N) m: 0 where not finite."""
    known = np.isfinite(height)
    steps = np.rint((np.where(known, height, scale.base).astype(np.float64) - scale.base) / scale.step)
    return np.where(known, steps.clip(0, _TOP[16] - 1) + 1, 0).astype(np.uint16)


def pixels_to_height(pixels: U16, scale: HeightScale) -> F32:
    """Heights (N, N) float32 m, NaN where unknown, of pixels (N, N). Raises ValueError beyond float32."""
    with np.errstate(over="ignore"):
        height: F32 = (scale.base + (pixels.astype(np.float64) - 1.0) * scale.step).astype(np.float32)
    if not np.isfinite(height).all():
        raise ValueError(f"height_base {scale.base} with height_step {scale.step} exceeds float32")
    height[pixels == 0] = np.nan
    return height


def sigma_to_pixels(sigma: F32, known: Bool) -> U8:
    """Pixels (N, N) uint8 of standard deviations (N, N) m: 0 where unknown, saturating at both ends (1 mm, 2.7 km)."""
    levels = np.log(np.where(known, sigma, 1.0).astype(np.float64).clip(SIGMA_MIN) / SIGMA_MIN) / math.log(SIGMA_RATIO)
    return np.where(known, np.rint(levels).clip(0, _TOP[8] - 1) + 1, 0).astype(np.uint8)


def pixels_to_sigma(pixels: U8, sigma_min: float, sigma_ratio: float) -> F32:
    """Standard deviations (N, N) float32 m, NaN where unknown, of pixels (N, N). Raises ValueError beyond float32."""
    with np.errstate(over="ignore"):
        table = (sigma_min * sigma_ratio ** np.arange(-1.0, _TOP[8])).astype(np.float32)
    if not np.isfinite(table).all():
        raise ValueError(f"sigma_min {sigma_min} with sigma_ratio {sigma_ratio} exceeds float32")
    table[0] = np.nan
    sigma: F32 = table[pixels]
    return sigma


def _plane(fields: Mapping[str, Any], name: str, size: int, bit_depth: int) -> Any:
    try:
        return _south_up(decode_png(fields[name], size, bit_depth))
    except ValueError as error:
        raise ValueError(f"{name} {error}") from error


def _north_up(plane: Any) -> Any:
    return np.ascontiguousarray(plane[::-1])


_south_up = _north_up
