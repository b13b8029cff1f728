"""DSM and orthophoto, read back by rasterio and compared with the true surface through pymap3d."""

from pathlib import Path

import numpy as np
import pymap3d
import pytest
import rasterio
from export_scene import TILTED, colour_of, plane, tiles
from pyproj import Transformer
from rasterio.enums import ColorInterp

from common.export.raster import write_dsm, write_ortho
from common.export.surface import Surface, mosaic
from common.messages import Datum

EQUATOR = Datum("equator", 0.0, 9.3, 12.0)
ZONE_EDGE = Datum("zone edge", 60.0, 11.999, 250.0)
SOUTH = Datum("south", -43.5, 172.6, 5.0)


def utm_of(datum: Datum, p_world: np.ndarray, epsg: int) -> np.ndarray:
    lat, lon, h = pymap3d.enu2geodetic(*p_world.T, datum.latitude_deg, datum.longitude_deg, datum.height)
    return np.column_stack([*Transformer.from_crs(4326, epsg, always_xy=True).transform(lon, lat), h])


def interpolated(band: np.ndarray, transform: rasterio.Affine, east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """The raster's value between pixel centres, as a GIS would read it."""
    col, row = ~transform @ (east, north)
    col, row = np.asarray(col) - 0.5, np.asarray(row) - 0.5
    c, r = np.floor(col).astype(int), np.floor(row).astype(int)
    u, v = col - c, row - r
    north_side = band[r, c] * (1 - u) + band[r, c + 1] * u
    south_side = band[r + 1, c] * (1 - u) + band[r + 1, c + 1] * u
    return np.asarray(north_side * (1 - v) + south_side * v)


def true_points(reach: float, count: int = 400) -> np.ndarray:
    east, north = np.random.default_rng(1).uniform(-reach, reach, (2, count))
    return np.column_stack([east, north, plane(east, north)])


@pytest.mark.parametrize("datum", [EQUATOR, ZONE_EDGE, SOUTH, TILTED], ids=lambda datum: datum.flight)
@pytest.mark.parametrize("cell", [0.25, 4.0])  # the map spans 32 m and 512 m
def test_dsm_gives_the_true_ellipsoidal_height(tmp_path: Path, datum: Datum, cell: float) -> None:
    write_dsm(tmp_path / "dsm.tif", mosaic(tiles(cell=cell), patch_step=cell), datum)
    with rasterio.open(tmp_path / "dsm.tif") as raster:
        band, transform, epsg = raster.read(1), raster.transform, raster.crs.to_epsg()
    p_utm = utm_of(datum, true_points(reach=60 * cell), epsg)
    read = interpolated(band, transform, p_utm[:, 0], p_utm[:, 1])
    assert np.isfinite(read).all()
    assert np.abs(read - p_utm[:, 2]).max() < 0.01


def test_ortho_shows_each_colour_at_its_place(tmp_path: Path) -> None:
    write_ortho(tmp_path / "ortho.tif", mosaic(tiles()), ZONE_EDGE)
    with rasterio.open(tmp_path / "ortho.tif") as raster:
        rgba, transform, epsg = raster.read(), raster.transform, raster.crs.to_epsg()
        assert raster.colorinterp == (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
    points = true_points(reach=15.0)
    p_utm = utm_of(ZONE_EDGE, points, epsg)
    read = [interpolated(band.astype(float), transform, p_utm[:, 0], p_utm[:, 1]) for band in rgba[:3]]
    # Colours were cut to whole numbers twice.
    assert np.abs(np.stack(read, axis=-1) - colour_of(points[:, 0], points[:, 1])).max() < 2.0


def surface_with_a_pond() -> Surface:
    surface = mosaic(tiles())
    surface.height[40:80, 40:80] = np.nan
    surface.colour[40:80, 40:80] = 0
    return surface


def test_nothing_bleeds_into_or_out_of_a_hole(tmp_path: Path) -> None:
    surface = surface_with_a_pond()
    write_dsm(tmp_path / "dsm.tif", surface, TILTED)
    write_ortho(tmp_path / "ortho.tif", surface, TILTED)
    with rasterio.open(tmp_path / "dsm.tif") as raster:
        height = raster.read(1)
    with rasterio.open(tmp_path / "ortho.tif") as raster:
        rgba = raster.read()
    known = np.isfinite(height)
    assert np.array_equal(rgba[3] == 255, known)
    assert set(np.unique(rgba[3])) == {0, 255}
    missing = surface.height.size - np.count_nonzero(known)
    assert missing == pytest.approx(40 * 40, rel=0.1)
    # A black or zero neighbour mixed in would show at once: the true range is narrow.
    true = surface.height[surface.valid] + TILTED.height
    assert height[known].min() > true.min() - 0.1
    assert height[known].max() < true.max() + 0.1
    assert rgba[:3, known].min() > 60


def test_files_are_cloud_optimised(tmp_path: Path) -> None:
    surface = mosaic(tiles(radius=9))
    write_dsm(tmp_path / "dsm.tif", surface, ZONE_EDGE)
    write_ortho(tmp_path / "ortho.tif", surface, ZONE_EDGE)
    for name, kind in (("dsm.tif", "float32"), ("ortho.tif", "uint8")):
        with rasterio.open(tmp_path / name) as raster:
            assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert raster.profile["tiled"]
            assert raster.overviews(1)
            assert raster.dtypes[0] == kind
            assert raster.crs.to_epsg() == 32632
            assert raster.res == (0.25, 0.25)
    with rasterio.open(tmp_path / "dsm.tif") as raster:
        assert np.isnan(raster.nodata)
        assert raster.units == ("metre",)
        assert np.isnan(raster.read(1)[0, 0])  # the corner of the rotated square
