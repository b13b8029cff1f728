"""Geodesy against pymap3d and PROJ."""

import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import CRS

from common.geo import (
    T_ecef_enu,
    T_world_other,
    ecef_to_geodetic,
    enu_to_geodetic,
    geodetic_to_ecef,
    geodetic_to_enu,
    utm_epsg,
)
from common.messages import Datum

latitudes = st.floats(-89.999, 89.999)
longitudes = st.floats(-179.999, 179.999)
heights = st.floats(-500.0, 9000.0)
offsets = st.tuples(st.floats(-2e4, 2e4), st.floats(-2e4, 2e4), st.floats(-500, 500)).map(np.array)


@given(latitudes, longitudes, heights)
def test_ecef_agrees_with_pymap3d(lat: float, lon: float, h: float) -> None:
    assert geodetic_to_ecef(lat, lon, h) == pytest.approx(np.array(pymap3d.geodetic2ecef(lat, lon, h)), abs=1e-7)


@given(latitudes, longitudes, heights)
def test_geodetic_survives_the_way_through_ecef(lat: float, lon: float, h: float) -> None:
    back = ecef_to_geodetic(geodetic_to_ecef(lat, lon, h))
    # A hundred-millionth of a degree is a millimetre; near a pole longitude hardly moves the point.
    assert back[0] == pytest.approx(lat, abs=1e-10)
    assert (back[1] - lon) * np.cos(np.radians(lat)) == pytest.approx(0.0, abs=1e-10)
    assert back[2] == pytest.approx(h, abs=1e-6)


@given(latitudes, longitudes, heights, offsets)
def test_enu_agrees_with_pymap3d(lat: float, lon: float, h: float, p_world: np.ndarray) -> None:
    datum = Datum("f", lat, lon, h)
    point = enu_to_geodetic(datum, p_world)
    assert np.array(pymap3d.geodetic2enu(*point, lat, lon, h)) == pytest.approx(p_world, abs=1e-6)
    assert geodetic_to_enu(datum, *point) == pytest.approx(p_world, abs=1e-6)


@given(latitudes, longitudes, heights)
def test_enu_axes_point_east_north_and_up(lat: float, lon: float, h: float) -> None:
    datum = Datum("f", lat, lon, h)
    assert pytest.approx(np.eye(3), abs=1e-12) == T_ecef_enu(datum).R.T @ T_ecef_enu(datum).R
    up = enu_to_geodetic(datum, np.array([0.0, 0.0, 10.0]))
    assert up[2] - h == pytest.approx(10.0, abs=1e-6)
    assert enu_to_geodetic(datum, np.array([0.0, 100.0, 0.0]))[0] > lat


@given(latitudes, longitudes, offsets)
def test_change_of_datum_keeps_places(lat: float, lon: float, p_other: np.ndarray) -> None:
    world, other = Datum("a", lat, lon, 10.0), Datum("b", np.clip(lat + 0.05, -89.9, 89.9), lon, 90.0)
    p_world = T_world_other(world, other).apply(p_other)
    assert geodetic_to_ecef(*enu_to_geodetic(world, p_world)) == pytest.approx(
        geodetic_to_ecef(*enu_to_geodetic(other, p_other)), abs=1e-6
    )


def test_arrays_of_any_shape_pass() -> None:
    p = np.random.default_rng(0).normal(scale=1000.0, size=(4, 5, 3))
    datum = Datum("f", -33.0, 151.0, 20.0)
    g = enu_to_geodetic(datum, p)
    assert g.shape == p.shape
    assert geodetic_to_enu(datum, g[..., 0], g[..., 1], g[..., 2]) == pytest.approx(p, abs=1e-6)


@given(st.floats(-79.9, 83.9), st.floats(-179.999, 179.999))
def test_utm_zone_holds_its_place(lat: float, lon: float) -> None:
    crs = CRS.from_epsg(utm_epsg(lat, lon))
    assert crs.utm_zone is not None
    assert crs.utm_zone.endswith("N") == (lat >= 0)
    area = crs.area_of_use
    assert area is not None
    # The exceptions around Norway and Svalbard shrink the official areas: central meridians tell the zone.
    central = 6 * int(crs.utm_zone[:-1]) - 183
    assert abs(lon - central) <= 3.0
