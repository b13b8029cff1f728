"""A site made of an orthophoto and a digital surface model, each in any projection."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.errors import RasterioError
from rasterio.fill import fillnodata
from rasterio.io import DatasetReader
from rasterio.warp import transform_bounds

from air.sources.simulated.camera.camera import daylight
from air.sources.simulated.sites.baking import fill_levels, periodic_textures
from air.sources.simulated.sites.layout import Bounds
from air.sources.simulated.sites.site import Site
from air.sources.simulated.sites.sites import texel_of
from air.sources.simulated.sites.solids import solid_table
from air.sources.simulated.sites.surface import CELL, LIGHT_SCALE, build_surface, texture_level
from common.arrays import F32, U8
from common.config import Range
from common.errors import SourceError
from common.geo import enu_to_geodetic, geodetic_to_enu
from common.messages import Datum

_TEXTURES = 24
_COARSE = 1.0
"""Projections are linear over this distance, m, to a micrometre."""
_EARTH = 6.371e6
"""Radius, m: by half the square of a distance over it, the ground falls below the plane of `world`."""
_WHITE, _DETAIL = 0.95, 40
_STRIP = 256


@dataclass(frozen=True)
class GeotiffOptions:
    """Files of the orthophoto and of the surface model, and the finest piece of the texture, m."""

    ortho: str = ""
    dsm: str = ""
    texel: Annotated[float, Range(0.01, 1)] = 0.04


def read_site(options: GeotiffOptions, seed: int, name: str) -> tuple[Site, Datum]:
    """The site where both files overlap, and its datum, in their middle at the height of the ground there.

    Heights are taken as above the ellipsoid. Light and shadow are those of the photo; to it comes the finest detail.
    Raises SourceError for a file that cannot be read or says not where it lies, and for two that do not overlap.
    """
    with _opened(options.ortho, "ortho") as ortho, _opened(options.dsm, "dsm") as dsm:
        west, south, east, north = _overlap(ortho, dsm, options)
        flat = Datum(name, (south + north) / 2, (west + east) / 2, 0.0)
        corners = geodetic_to_enu(flat, [south, south, north, north], [west, east, west, east], 0.0)[:, :2]
        reach = np.abs(corners).min(axis=0)
        bounds = Bounds(-float(reach[0]), -float(reach[1]), float(reach[0]), float(reach[1]))
        height = _heights(dsm, flat, bounds)
        middle = float(height[height.shape[0] // 2, height.shape[1] // 2])
        height -= np.float32(middle)
        light, texel = daylight(), texel_of(bounds, options.texel)
        textures = periodic_textures(np.random.default_rng([seed, _TEXTURES]))
        none, still = solid_table([]), np.zeros(height.shape, np.uint8)
        surface = build_surface(bounds, height, none, none, texel, light, -np.inf, still, textures)
        _paint(ortho, flat, bounds, texel, texture_level(surface.colour, surface.colour_at, 0))
    fill_levels(surface)
    return Site(bounds, surface, light, height), Datum(name, flat.latitude_deg, flat.longitude_deg, middle)


def _opened(file: str, option: str) -> DatasetReader:
    try:
        raster = rasterio.open(Path(file).expanduser())
    except RasterioError as error:
        raise SourceError(f"sim:geotiff: {option}={file} cannot be read: {error}; name a GeoTIFF") from error
    if raster.crs is None:
        raise SourceError(f"sim:geotiff: {option}={file} says not where it lies; give it a coordinate reference system")
    return raster


def _overlap(ortho: DatasetReader, dsm: DatasetReader, options: GeotiffOptions) -> tuple[float, float, float, float]:
    """West, south, east and north ° of what both rasters cover."""
    a, b = (transform_bounds(raster.crs, "EPSG:4326", *raster.bounds) for raster in (ortho, dsm))
    west, south, east, north = max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3])
    if west >= east or south >= north:
        raise SourceError(f"sim:geotiff: ortho={options.ortho} and dsm={options.dsm} do not overlap; name two that do")
    return west, south, east, north


def _pixels(raster: DatasetReader, datum: Datum, bounds: Bounds) -> F32:
    """Pixel coordinates (h, w, 2) of a raster, column first, 0 in the middle of the first, on nodes every _COARSE m."""
    rows, columns = bounds.grid(_COARSE)
    y, x = np.mgrid[:rows, :columns] * _COARSE
    p_world = np.stack([bounds.west + x, bounds.south + y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    latitude, longitude, _ = enu_to_geodetic(datum, p_world).T
    east, north = Transformer.from_crs("EPSG:4326", raster.crs, always_xy=True).transform(longitude, latitude)
    column, row = ~raster.transform @ (np.asarray(east), np.asarray(north))
    return np.stack([column - 0.5, row - 0.5], axis=-1).reshape(rows, columns, 2).astype(np.float32)


def _sampled(image: F32 | U8, pixels: F32, cell: float, first: int, shape: tuple[int, int], how: int) -> F32 | U8:
    """An image at `shape` nodes every `cell` m, from row `first` on; `pixels` as `_pixels` gives them."""
    scale = cell / _COARSE
    enlarge = np.array([[scale, 0, 0], [0, scale, first * scale]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    at = cv2.warpAffine(pixels, enlarge, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    sampled: F32 | U8 = cv2.remap(image, at, None, how, borderMode=cv2.BORDER_REPLICATE)
    return sampled


def _heights(dsm: DatasetReader, datum: Datum, bounds: Bounds) -> F32:
    """Height (h, w) m above the plane that touches the ellipsoid at the datum, gaps filled from around."""
    band = dsm.read(1, masked=True)
    known = ~np.ma.getmaskarray(band) & np.isfinite(band.data)
    values = np.where(known, band.data, 0).astype(np.float32)
    filled = fillnodata(values, mask=known.astype(np.uint8), max_search_distance=200.0) if not known.all() else values
    filled[(filled == 0) & ~known] = np.median(values[known]) if known.any() else 0.0
    rows, columns = bounds.grid(CELL)
    height = _sampled(filled, _pixels(dsm, datum, bounds), CELL, 0, (rows, columns), cv2.INTER_LINEAR)
    x, y = bounds.west + np.arange(columns) * CELL, bounds.south + np.arange(rows)[:, None] * CELL
    return np.asarray(height - (x * x + y * y) / (2 * _EARTH), np.float32)


def _paint(ortho: DatasetReader, datum: Datum, bounds: Bounds, texel: float, paint: U8) -> None:
    """Fill a texture (H, W, 4) with the orthophoto."""
    bands = [1, 2, 3] if ortho.count >= 3 else [1, 1, 1]
    image = np.ascontiguousarray(np.moveaxis(ortho.read(bands), 0, -1))
    if image.dtype != np.uint8:
        image = np.clip(image / max(float(np.percentile(image, 99.5)), 1e-9) * 235, 0, 255).astype(np.uint8)
    pixels, scale = _pixels(ortho, datum, bounds), np.sqrt(_WHITE) * LIGHT_SCALE / 255
    for begin in range(0, len(paint), _STRIP):
        part = paint[begin : begin + _STRIP]
        colour = _sampled(image, pixels, texel, begin, part.shape[:2], cv2.INTER_CUBIC)
        part[..., :3], part[..., 3] = np.rint(colour * scale), _DETAIL
