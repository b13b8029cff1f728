"""A picture of the surface for people: the orthophoto beside a shaded relief, north up."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from common.arrays import F32, F64, U8, Bool
from common.errors import ExportError
from common.export.surface import Surface

PANEL_PX = 880
"""Longer side of each of the two pictures."""
GAP_PX, FOOT_PX = 16, 44
QUALITY = 80
SUN_AZIMUTH, SUN_ELEVATION = np.radians(315.0), np.radians(40.0)
"""Light from the upper left, as cartographers have it: from below, hills look like hollows."""
EXAGGERATION = 1.5
_PAPER, _INK = 255, (40, 40, 40)
_COLOUR_STRENGTH = 0.55


def write_preview(path: Path, surface: Surface) -> None:
    """Write the orthophoto and the relief side by side, with a scale bar and the colours of the heights, as JPEG.

    The heights count from the lowest ground shown. Raises ExportError that names the file.
    """
    image = preview(surface)
    _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    try:
        path.write_bytes(jpeg.tobytes())
    except OSError as error:
        raise ExportError(f"{path}: cannot be written ({error.strerror})") from error


def preview(surface: Surface) -> U8:
    """The picture (H, W, 3) uint8 RGB of a surface that has at least one height."""
    height, colour, cell = _reduced(surface)
    known = np.isfinite(height)
    low, high = (float(np.percentile(height[known], q)) for q in (1, 99))
    relief = _relief(height, cell, low, high)
    enlarge = max(1, PANEL_PX // max(height.shape))
    panels = [
        np.where(known[..., None], panel, _PAPER).repeat(enlarge, axis=0).repeat(enlarge, axis=1)
        for panel in (colour, relief)
    ]
    rows, cols = panels[0].shape[:2]
    sheet = np.full((rows + FOOT_PX, 2 * cols + GAP_PX, 3), _PAPER, np.uint8)
    sheet[:rows, :cols], sheet[:rows, cols + GAP_PX :] = panels
    _draw_scale_bar(sheet[rows:, :cols], cell / enlarge)
    _draw_height_bar(sheet[rows:, cols + GAP_PX :], high - low)
    return sheet


def _reduced(surface: Surface) -> tuple[F32, U8, float]:
    """Heights (H, W) m with NaN, colours (H, W, 3) and cell size m of what is known, row 0 at the north edge."""
    rows, cols = _box(surface.valid)
    height, colour = surface.height[rows, cols][::-1], surface.colour[rows, cols][::-1]
    factor = min(1.0, PANEL_PX / max(height.shape))
    size = tuple(max(1, round(n * factor)) for n in height.shape[::-1])
    known = np.isfinite(height)
    interpolation = cv2.INTER_AREA
    weight = cv2.resize(known.astype(np.float32), size, interpolation=interpolation)
    safe = np.maximum(weight, 1e-6)
    small = cv2.resize(np.where(known, height, 0).astype(np.float32), size, interpolation=interpolation) / safe
    rgb = cv2.resize(colour.astype(np.float32), size, interpolation=interpolation) / safe[..., None]
    return np.where(weight >= 0.5, small, np.nan), rgb.round().clip(0, 255).astype(np.uint8), surface.cell / factor


def _box(valid: Bool) -> tuple[slice, slice]:
    """The rows and columns that hold something."""
    rows, cols = (np.flatnonzero(valid.any(axis=axis)) for axis in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)


def _relief(height: F32, cell: float, low: float, high: float) -> F64:
    """Colours (H, W, 3) of the heights under slanting light; row 0 is north."""
    scaled = np.nan_to_num((height - low) / max(high - low, 1e-6)).clip(0, 1)
    colour = _height_colours((255 * scaled).astype(np.uint8)).astype(float)
    return (_PAPER + _COLOUR_STRENGTH * (colour - _PAPER)) * hillshade(height, cell)[..., None]


def hillshade(height: F32, cell: float) -> F64:
    """Brightness (H, W) from 0 to 1 of a surface whose row 0 is north; sin(elevation) where it is flat or unknown.

    Source: B. K. P. Horn, Hill shading and the reflectance map, Proceedings of the IEEE 69(1), 1981.
    """
    per_metre = EXAGGERATION / (8 * cell)
    east = np.nan_to_num(cv2.Sobel(height, cv2.CV_64F, 1, 0, scale=per_metre, borderType=cv2.BORDER_REPLICATE))
    north = np.nan_to_num(cv2.Sobel(height, cv2.CV_64F, 0, 1, scale=-per_metre, borderType=cv2.BORDER_REPLICATE))
    towards_sun = np.array([np.sin(SUN_AZIMUTH), np.cos(SUN_AZIMUTH)]) * np.cos(SUN_ELEVATION)
    lit = np.sin(SUN_ELEVATION) - towards_sun[0] * east - towards_sun[1] * north
    return np.asarray((lit / np.sqrt(1 + east**2 + north**2)).clip(0, 1))


def _height_colours(level: U8) -> U8:
    """Colours (H, W, 3) RGB of levels (H, W) from low to high, without the dark ends, which would look like shadow."""
    bright = (28 + level * (200 / 255)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(bright, cv2.COLORMAP_TURBO)[..., ::-1])


def _draw_scale_bar(foot: U8, cell: float) -> None:
    """A bar of a round length, up to a third of the width, with its length beside it."""
    length = _round_length(foot.shape[1] * cell / 3)
    right = 4 + max(1, round(length / cell))
    cv2.rectangle(foot, (4, 18), (right, 24), _INK, cv2.FILLED)
    _write(foot, f"{length:g} m", right + 10)


def _draw_height_bar(foot: U8, span: float) -> None:
    """A bar of the colours from the lowest to the highest ground."""
    width = max(1, foot.shape[1] // 3)
    ramp = np.tile(np.linspace(0, 255, width).astype(np.uint8), (12, 1))
    foot[15:27, 4 : 4 + width] = _height_colours(ramp)[:, : foot.shape[1] - 4]
    _write(foot, f"0 to {span:.1f} m high", 4 + width + 10)


def _round_length(limit: float) -> float:
    """The largest of 1, 2, 5, 10, 20, … (and 0.1, 0.2, 0.5, …) that does not exceed a length, m."""
    power = 10.0 ** np.floor(np.log10(limit))
    return float(max(step * power for step in (1, 2, 5) if step * power <= limit))


def _write(foot: U8, text: str, left: int) -> None:
    cv2.putText(foot, text, (left, 27), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _INK, 1, cv2.LINE_AA)
