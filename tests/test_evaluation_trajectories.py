"""Trajectory comparison against evo."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from evaluation_ground import distortion
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

from common.errors import EvaluationError
from common.export.datum import write_datum
from common.export.trajectory import Trajectory, write_tum
from common.geo import T_world_other
from common.messages import Datum
from common.se3 import SE3
from ground.evaluation.table import as_json, render
from ground.evaluation.trajectories import associate, compare_trajectories, read_trajectories

SECOND = 1_000_000_000


def flight(count: int = 300, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    t = np.arange(count)
    positions = np.column_stack([30 * np.sin(t / 25), 1.5 * t, 40 + rng.normal(size=count).cumsum() * 0.1])
    poses = tuple(SE3.from_quaternion(rng.normal(size=4), p) for p in positions)
    return Trajectory(1_700_000_000 * SECOND + t * SECOND // 5, poses)


def estimated(truth: Trajectory, seed: int = 1) -> Trajectory:
    """A scaled, tilted, shifted, noisy copy at every other time, a few milliseconds off."""
    rng = np.random.default_rng(seed)
    moved = distortion(seed, 1.02).apply(truth.positions) + rng.normal(scale=0.3, size=(len(truth.poses), 3))
    poses = [SE3(pose.R, p) for pose, p in zip(truth.poses, moved, strict=True)]
    jitter = rng.integers(-6_000_000, 6_000_000, len(poses))
    return Trajectory((truth.t_ns + jitter)[::2], tuple(poses[::2]))


def evo_statistics(ours: Path, truth: Path, rigid: bool, scale: bool) -> dict[str, float]:
    reference: PoseTrajectory3D = file_interface.read_tum_trajectory_file(truth)
    estimate: PoseTrajectory3D = file_interface.read_tum_trajectory_file(ours)
    reference, estimate = sync.associate_trajectories(reference, estimate, max_diff=0.01)
    if rigid:
        estimate.align(reference, correct_scale=scale)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((reference, estimate))
    return dict(error.get_all_statistics())


def test_statistics_are_those_of_evo(tmp_path: Path) -> None:
    truth = flight()
    ours = estimated(truth)
    write_tum(tmp_path / "a.tum", ours.t_ns, ours.poses)
    write_tum(tmp_path / "b.tum", truth.t_ns, truth.poses)
    comparison = compare_trajectories(*read_trajectories(tmp_path / "a.tum", tmp_path / "b.tum"))
    assert comparison.matched == 150
    for row, (rigid, scale) in zip(comparison.rows, [(False, False), (True, False), (True, True)], strict=True):
        oracle = evo_statistics(tmp_path / "a.tum", tmp_path / "b.tum", rigid, scale)
        for name, value in asdict(row.error).items():
            assert value == pytest.approx(oracle[name], abs=1e-9), (row.alignment, name)


def test_alignment_gives_back_scale_and_rotation() -> None:
    truth = flight()
    applied = distortion(4, 1.02)
    moved = tuple(SE3(pose.R, applied.apply(pose.t[None])[0]) for pose in truth.poses)
    none, rigid, similarity = compare_trajectories(Trajectory(truth.t_ns, moved), truth).rows
    assert similarity.error.max < 1e-9
    assert similarity.scale == pytest.approx(1 / 1.02)
    assert similarity.rotation_deg == pytest.approx(3.0)
    assert none.error.rmse > rigid.error.rmse > similarity.error.rmse
    assert (none.shift, none.rotation_deg, none.scale, rigid.scale) == (0.0, 0.0, 1.0, 1.0)


def test_straight_flight_can_be_aligned() -> None:
    line = np.linspace(0.0, 100.0, 50)[:, None] * [1.0, 0.5, 0.0]
    truth = Trajectory(np.arange(50) * SECOND, tuple(SE3(np.eye(3), p) for p in line))
    ours = Trajectory(truth.t_ns, tuple(SE3(np.eye(3), p) for p in distortion(3).apply(line)))
    assert compare_trajectories(ours, truth).rows[1].error.max < 1e-9


def test_stamps_match_one_to_one_within_ten_milliseconds() -> None:
    truth = np.array([0, 100, 200, 300]) * 1_000_000
    ours = np.array([-10, 3, 109, 195, 204, 311]) * 1_000_000
    index, truth_index = associate(ours, truth)
    assert list(zip(index.tolist(), truth_index.tolist(), strict=True)) == [(1, 0), (2, 1), (4, 2)]


def test_other_datum_is_brought_into_the_frame_of_the_truth(tmp_path: Path) -> None:
    truth = flight()
    here, there = Datum("a", 48.0, 9.0, 300.0), Datum("b", 48.01, 9.02, 250.0)
    ours = [T_world_other(there, here) @ pose for pose in truth.poses]
    for name, poses, datum in (("truth", truth.poses, here), ("ours", ours, there)):
        (tmp_path / name).mkdir()
        write_tum(tmp_path / name / "t.tum", truth.t_ns, poses)
        write_datum(tmp_path / name / "datum.json", datum)
    comparison = compare_trajectories(*read_trajectories(tmp_path / "ours" / "t.tum", tmp_path / "truth" / "t.tum"))
    # Nine decimals in the files, and the lever of 1.8 km.
    assert comparison.rows[0].error.max < 1e-5
    (tmp_path / "ours" / "datum.json").unlink()
    unaware = compare_trajectories(*read_trajectories(tmp_path / "ours" / "t.tum", tmp_path / "truth" / "t.tum"))
    assert unaware.rows[0].error.min > 1000.0


def test_flights_at_different_times_are_refused() -> None:
    truth = flight()
    late = Trajectory(truth.t_ns + 50_000_000, truth.poses)
    with pytest.raises(EvaluationError, match=r"only 0 poses of 300 .* 10 ms"):
        compare_trajectories(late, truth)
    with pytest.raises(EvaluationError, match="covers nothing"):
        compare_trajectories(Trajectory(np.zeros(0, np.int64), ()), truth)


def test_table_and_json_tell_the_same() -> None:
    truth = flight()
    comparison = compare_trajectories(estimated(truth), truth)
    text, fields = render(comparison), json.loads(as_json(comparison))
    assert fields["kind"] == "trajectory"
    assert fields["matched"] == 150
    for row in fields["rows"]:
        assert all(f"{value:.3f}" in text for value in row["error"].values())
