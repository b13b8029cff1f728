"""Cloud comparison against distances that are known by construction."""

import json
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
from evaluation_ground import degraded, distortion, ground
from pyproj import CRS

from common.errors import EvaluationError
from common.export.laz import write_points
from common.export.ply import write_points_ply
from common.export.projection import UtmProjection
from common.messages import Datum
from ground.evaluation.clouds import Cloud, compare_clouds, in_frame_of, read_cloud
from ground.evaluation.table import as_json, render

DATUM = Datum("f", 46.84, -91.99, 150.0)
UTM = UtmProjection(DATUM)


def grey(points: np.ndarray) -> np.ndarray:
    return np.full(points.shape, 128, np.uint8)


def rows_by_name(ours: np.ndarray, reference: np.ndarray) -> dict:  # type: ignore[type-arg]
    return {row.alignment: row for row in compare_clouds(Cloud(ours), Cloud(reference)).rows}


def test_distances_are_those_of_all_pairs() -> None:
    ours, reference = ground(700, seed=1, side=20.0), ground(900, seed=2, side=20.0)
    ours[:, 2] += 0.3
    row = compare_clouds(Cloud(ours), Cloud(reference)).rows[0]
    pairs = np.linalg.norm(ours[:, None] - reference[None], axis=2)
    cells_ours, cells_reference = ({tuple(c) for c in np.floor(p[:, :2])} for p in (ours, reference))
    common = cells_ours & cells_reference
    there = pairs.min(axis=1)[[tuple(c) in common for c in np.floor(ours[:, :2])]]
    back = pairs.min(axis=0)[[tuple(c) in common for c in np.floor(reference[:, :2])]]
    for found, truth in ((row.to_reference, there), (row.from_reference, back)):
        assert (found.mean, found.std, found.median, found.p90, found.max) == pytest.approx(
            (truth.mean(), truth.std(), np.median(truth), np.quantile(truth, 0.9), truth.max())
        )
        assert found.points == len(truth)
    assert row.completeness == pytest.approx((pairs.min(axis=0) <= 0.5).mean())
    assert row.footprint == len(common)


def test_alignment_removes_what_was_applied() -> None:
    reference = ground(120_000, seed=0)
    applied = distortion(2, 1.03)
    rows = rows_by_name(applied.apply(ground(60_000, seed=1)), reference)
    assert rows["none"].to_reference.mean > 0.5
    assert rows["rigid"].to_reference.mean < rows["none"].to_reference.mean
    # Two samplings of the same ground at 0.46 m spacing lie about 0.2 m apart.
    floor = rows_by_name(ground(60_000, seed=1), reference)["none"]
    assert rows["similarity"].to_reference.mean == pytest.approx(floor.to_reference.mean, abs=0.003)
    assert rows["similarity"].completeness == pytest.approx(floor.completeness, abs=0.01)
    assert rows["similarity"].scale == pytest.approx(1 / 1.03, abs=2e-4)
    assert rows["similarity"].rotation_deg == pytest.approx(3.0, abs=0.01)
    assert rows["rigid"].scale == 1.0
    assert rows["none"].shift == 0.0


def test_ground_that_only_one_cloud_has_counts_in_completeness_alone() -> None:
    reference = ground(30_000, seed=0, side=60.0)
    ours = ground(30_000, seed=1, side=60.0)
    ours = ours[ours[:, 0] < 0.0]
    extra = ground(1_000, seed=2, side=20.0) + np.array([200.0, 0.0, 60.0])
    alone, with_extra = rows_by_name(ours, reference)["none"], rows_by_name(np.vstack([ours, extra]), reference)["none"]
    assert alone.completeness == pytest.approx(0.5, abs=0.02)
    assert with_extra.to_reference == alone.to_reference
    assert with_extra.from_reference.mean == pytest.approx(alone.from_reference.mean, abs=1e-12)


def test_laz_and_ply_of_one_map_are_the_same_cloud(tmp_path: Path) -> None:
    points = ground(3_000)
    write_points(tmp_path / "a.laz", points, grey(points), DATUM)
    write_points_ply(tmp_path / "b.ply", points, grey(points), DATUM)
    laz, ply = read_cloud(tmp_path / "a.laz"), read_cloud(tmp_path / "b.ply")
    assert in_frame_of(laz, ply) == pytest.approx(points, abs=0.001)
    assert in_frame_of(ply, laz) == pytest.approx(laz.points, abs=0.001)


def test_cloud_in_the_neighbouring_zone_is_brought_over(tmp_path: Path) -> None:
    points = ground(1_000)
    write_points(tmp_path / "a.laz", points, grey(points), DATUM)
    ours = read_cloud(tmp_path / "a.laz")
    there = CRS.from_epsg(32616).to_3d()
    moved = in_frame_of(ours, Cloud(ours.points, there))
    assert abs(moved[:, 0].mean() - ours.points[:, 0].mean()) > 100_000.0
    assert in_frame_of(Cloud(moved, there), ours) == pytest.approx(ours.points, abs=1e-5)


def test_two_and_three_dimensional_crs_of_one_zone_are_the_same() -> None:
    points = UTM.from_world(ground(200))
    flat = Cloud(points, CRS.from_epsg(UTM.epsg))
    assert np.array_equal(in_frame_of(Cloud(points, UTM.crs), flat), points)


def test_other_datum_is_brought_over() -> None:
    points, elsewhere = ground(200), Datum("g", 46.841, -91.991, 100.0)
    moved = in_frame_of(Cloud(points, DATUM), Cloud(points, elsewhere))
    assert UtmProjection(elsewhere).from_world(moved) == pytest.approx(UTM.from_world(points), abs=1e-5)


def test_unreadable_clouds_are_named(tmp_path: Path) -> None:
    (tmp_path / "cloud.xyz").write_text("1 2 3\n")
    (tmp_path / "broken.laz").write_bytes(b"LASF" + bytes(50))
    (tmp_path / "broken.ply").write_bytes(b"not a ply")
    few = laspy.create(point_format=7, file_version="1.4")
    few.x = few.y = few.z = np.arange(3.0)
    few.write(tmp_path / "few.las")
    refusals = {
        "cloud.xyz": "LAZ, LAS and PLY",
        "none.laz": "no such file",
        "broken.laz": "cannot be read",
        "broken.ply": "cannot be read",
        "few.las": "holds 3 points",
    }
    for name, reason in refusals.items():
        with pytest.raises(EvaluationError, match=rf"{name}.*{reason}"):
            read_cloud(tmp_path / name)


def test_clouds_without_common_ground_are_refused_with_their_extents() -> None:
    points = ground(500)
    with pytest.raises(EvaluationError, match="coordinate system"):
        compare_clouds(Cloud(points + np.array([1e6, 0.0, 0.0])), Cloud(points))


def test_table_and_json_tell_the_same() -> None:
    comparison = compare_clouds(Cloud(degraded(ground(20_000, seed=1), 1)), Cloud(ground(20_000, seed=2)))
    text, fields = render(comparison), json.loads(as_json(comparison))
    assert fields["kind"] == "cloud"
    assert [row["alignment"] for row in fields["rows"]] == ["none", "rigid", "similarity"]
    for row in fields["rows"]:
        assert f"{row['to_reference']['mean']:.3f}" in text
        assert f"{row['completeness']:.1%}" in text
    assert max(map(len, text.splitlines())) <= 120


@pytest.mark.slow
def test_real_cloud_against_its_copy(real_data: Callable[[str], Path]) -> None:
    reference = read_cloud(real_data("brighton_beach") / "model.laz")
    applied = distortion(7, 1.03, about=reference.points.mean(axis=0))
    copy = degraded(applied.apply(reference.points[::2]), 7, noise=0.02, outliers=0.05)
    rows = {row.alignment: row for row in compare_clouds(Cloud(copy, reference.frame), reference).rows}
    assert rows["none"].to_reference.mean > 0.5
    assert rows["similarity"].to_reference.median < 0.04
    assert rows["similarity"].completeness > 0.99
