"""Trajectory and datum files, read back by ourselves, evo and pymap3d."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from evo.tools import file_interface
from export_scene import TILTED, keyframes

from common.errors import EvaluationError
from common.export.datum import read_datum, write_datum
from common.export.trajectory import read_tum, write_geojson, write_tum
from common.se3 import SE3


def poses(count: int = 20) -> tuple[np.ndarray, list[SE3]]:
    rng = np.random.default_rng(0)
    t_ns = 1_700_000_000_000_000_001 + np.cumsum(rng.integers(1, 10**9, count))
    return t_ns, [SE3.from_quaternion(rng.normal(size=4), rng.normal(scale=300.0, size=3)) for _ in range(count)]


def test_tum_keeps_every_nanosecond_and_pose(tmp_path: Path) -> None:
    t_ns, written = poses()
    write_tum(tmp_path / "t.tum", t_ns, written)
    read = read_tum(tmp_path / "t.tum")
    assert np.array_equal(read.t_ns, t_ns)
    for pose, back in zip(written, read.poses, strict=True):
        assert back.matrix == pytest.approx(pose.matrix, abs=1e-8)


def test_evo_reads_our_tum_file(tmp_path: Path) -> None:
    t_ns, written = poses()
    write_tum(tmp_path / "t.tum", t_ns, written)
    evo = file_interface.read_tum_trajectory_file(tmp_path / "t.tum")
    assert evo.timestamps == pytest.approx(t_ns / 1e9, abs=1e-6)
    assert np.array(evo.poses_se3) == pytest.approx(np.array([pose.matrix for pose in written]), abs=1e-8)


def test_tum_of_others_is_read(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("# time x y z\n\n2.5e0 4 5 6 0 0 0 1\n1 1 2 3 0 0 1 0\n")
    read = read_tum(tmp_path / "t.tum")
    assert read.t_ns.tolist() == [1_000_000_000, 2_500_000_000]
    assert read.positions == pytest.approx(np.array([[1, 2, 3], [4, 5, 6]]))


@pytest.mark.parametrize(
    "line", ["1 2 3", "1 2 3 4 0 0 0 0", "a 1 2 3 0 0 0 1", "1 nan 2 3 0 0 0 1", "nan 1 2 3 0 0 0 1"]
)
def test_damaged_tum_line_is_named(tmp_path: Path, line: str) -> None:
    (tmp_path / "t.tum").write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(EvaluationError, match=r"t\.tum, line 2"):
        read_tum(tmp_path / "t.tum")


def test_missing_tum_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match=r"none\.tum"):
        read_tum(tmp_path / "none.tum")


def test_geojson_gives_every_camera_in_wgs84(tmp_path: Path) -> None:
    flown = keyframes()
    moved = replace(flown[2], revision=1, T_world_cam=SE3(np.eye(3), np.array([100.0, 200.0, 30.0])))
    write_geojson(tmp_path / "t.geojson", TILTED, [moved, *flown])
    line, *points = json.loads((tmp_path / "t.geojson").read_text())["features"]
    assert line["geometry"]["type"] == "LineString"
    assert line["geometry"]["coordinates"] == [point["geometry"]["coordinates"] for point in points]
    assert [point["properties"]["name"] for point in points] == [f"photo_{i}.jpg" for i in range(5)]
    lon, lat, h = np.array(line["geometry"]["coordinates"]).T
    datum = (TILTED.latitude_deg, TILTED.longitude_deg, TILTED.height)
    enu = np.column_stack(pymap3d.geodetic2enu(lat, lon, h, *datum))
    truth = [(moved if k.index == 2 else k).T_world_cam.t for k in flown]
    assert enu == pytest.approx(np.array(truth), abs=0.001)


def test_datum_survives_its_file(tmp_path: Path) -> None:
    datum = replace(TILTED, latitude_deg=48.123456789012345)
    write_datum(tmp_path / "datum.json", datum)
    assert read_datum(tmp_path / "datum.json") == datum
    assert json.loads((tmp_path / "datum.json").read_text())["epsg"] == 32610


def test_file_that_is_no_datum_is_named(tmp_path: Path) -> None:
    (tmp_path / "datum.json").write_text('{"flight": "a"}')
    with pytest.raises(EvaluationError, match=r"datum\.json.*latitude_deg"):
        read_datum(tmp_path / "datum.json")
