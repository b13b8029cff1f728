"""LAZ and PLY clouds, read back by laspy and trimesh; UTM by pymap3d and PROJ."""

from pathlib import Path

import laspy
import numpy as np
import pymap3d
import pytest
import trimesh
from pyproj import Transformer

from common.export.laz import write_points
from common.export.ply import write_points_ply
from common.export.projection import UtmProjection
from common.messages import Datum

PLACES = [
    Datum("equator", 0.001, 9.0, 12.0),
    Datum("zone edge", 60.0, 11.9995, 250.0),
    Datum("south", -43.5, 172.6, -3.0),
    Datum("west of Greenwich", 48.9, -123.2, 50.0),
]


def cloud(count: int = 500) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    p_world = rng.uniform([-800.0, -800.0, -20.0], [800.0, 800.0, 60.0], (count, 3))
    return p_world, rng.integers(0, 256, (count, 3), np.uint8), rng.random(count), rng.integers(0, 9, count, np.uint8)


def utm_oracle(datum: Datum, p_world: np.ndarray) -> np.ndarray:
    lat, lon, h = pymap3d.enu2geodetic(*p_world.T, datum.latitude_deg, datum.longitude_deg, datum.height)
    zone = Transformer.from_crs(4326, UtmProjection(datum).epsg, always_xy=True)
    return np.column_stack([*zone.transform(lon, lat), h])


@pytest.mark.parametrize("datum", PLACES, ids=lambda datum: datum.flight)
def test_projection_agrees_with_pymap3d_and_comes_back(datum: Datum) -> None:
    p_world, *_ = cloud()
    projection = UtmProjection(datum)
    assert projection.from_world(p_world) == pytest.approx(utm_oracle(datum, p_world), abs=1e-6)
    assert projection.to_world(projection.from_world(p_world)) == pytest.approx(p_world, abs=1e-6)


@pytest.mark.parametrize("datum", PLACES, ids=lambda datum: datum.flight)
def test_laz_holds_every_point_in_utm(tmp_path: Path, datum: Datum) -> None:
    p_world, colour, sigma, views = cloud()
    write_points(tmp_path / "map.laz", p_world, colour, datum, sigma, views)
    las = laspy.read(tmp_path / "map.laz")
    assert las.xyz == pytest.approx(utm_oracle(datum, p_world), abs=0.00051)  # steps of 1 mm
    assert np.array_equal(np.column_stack([las.red, las.green, las.blue]) // 257, colour)
    assert np.asarray(las.sigma) == pytest.approx(sigma, abs=1e-6)
    assert np.array_equal(np.asarray(las.views), views)


def test_laz_says_what_it_is(tmp_path: Path) -> None:
    p_world, colour, *_ = cloud()
    write_points(tmp_path / "map.laz", p_world, colour, PLACES[1])
    with laspy.open(tmp_path / "map.laz") as reader:
        header = reader.header
        assert (str(header.version), header.point_format.id, header.are_points_compressed) == ("1.4", 7, True)
        crs = header.parse_crs()
        assert header.global_encoding.wkt
        assert list(header.point_format.extra_dimension_names) == []
    assert crs.to_2d().to_epsg() == 32632
    assert [axis.name for axis in crs.axis_info][2] == "Ellipsoidal height"


def test_same_cloud_gives_the_same_bytes(tmp_path: Path) -> None:
    p_world, colour, sigma, views = cloud()
    for name in ("a", "b"):
        write_points(tmp_path / f"{name}.laz", p_world, colour, PLACES[0], sigma, views)
        write_points_ply(tmp_path / f"{name}.ply", p_world, colour, PLACES[0], sigma, views)
    for suffix in ("laz", "ply"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


def test_ply_holds_every_point_in_the_world_frame(tmp_path: Path) -> None:
    p_world, colour, sigma, views = cloud()
    write_points_ply(tmp_path / "map.ply", p_world, colour, PLACES[0], sigma, views)
    read = trimesh.load(tmp_path / "map.ply", process=False)
    assert read.vertices == pytest.approx(p_world, abs=1e-4)  # float32 at 1 km
    assert np.array_equal(read.colors[:, :3], colour)
    raw = read.metadata["_ply_raw"]["vertex"]["data"]
    assert raw["sigma"] == pytest.approx(sigma, abs=1e-6)
    assert np.array_equal(raw["views"], views)
    assert b'"latitude_deg": 0.001' in (tmp_path / "map.ply").read_bytes()[:600]
