"""Comparison of two trajectories: position errors before and after alignment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import F64, I64
from common.errors import EvaluationError
from common.export.datum import read_datum
from common.export.trajectory import Trajectory, read_tum
from common.geo import T_world_other
from ground.evaluation.similarity import Similarity, umeyama

MAX_DT_NS = 10_000_000
_MIN_POSES = 3


@dataclass(frozen=True)
class ErrorStatistics:
    """Of position errors, all m; the standard deviation is that of the whole population."""

    max: float
    mean: float
    median: float
    min: float
    rmse: float
    std: float


@dataclass(frozen=True)
class TrajectoryRow:
    """One alignment: the errors that remain and what the alignment did; `shift` (m) is that of our centre."""

    alignment: str
    error: ErrorStatistics
    shift: float
    rotation_deg: float
    scale: float


@dataclass(frozen=True)
class TrajectoryComparison:
    """Our trajectory against the truth: pose counts, how many were matched, one row for each alignment."""

    poses: int
    truth_poses: int
    matched: int
    rows: tuple[TrajectoryRow, ...]


def read_trajectories(path: Path, truth_path: Path) -> tuple[Trajectory, Trajectory]:
    """Our trajectory and the truth, both in the world frame of the truth.

    A `datum.json` beside each file says where its world frame lies; without both, the frames count as one.
    """
    ours, truth = read_tum(path), read_tum(truth_path)
    datums = [p.parent / "datum.json" for p in (path, truth_path)]
    if all(p.exists() for p in datums):
        T_truth_ours = T_world_other(read_datum(datums[1]), read_datum(datums[0]))
        ours = Trajectory(ours.t_ns, tuple(T_truth_ours @ pose for pose in ours.poses))
    return ours, truth


def associate(t_ns: I64, truth_t_ns: I64, max_dt_ns: int = MAX_DT_NS) -> tuple[I64, I64]:
    """Indices (K,) into both sorted time series of the stamps that are each other's nearest within the limit."""
    if not len(t_ns) or not len(truth_t_ns):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    to_truth, to_ours = _nearest(t_ns, truth_t_ns), _nearest(truth_t_ns, t_ns)
    ours = np.arange(len(t_ns))
    keep = (to_ours[to_truth] == ours) & (np.abs(t_ns - truth_t_ns[to_truth]) <= max_dt_ns)
    return ours[keep], to_truth[keep]


def _nearest(t_ns: I64, others_ns: I64) -> I64:
    right = np.clip(np.searchsorted(others_ns, t_ns), 0, len(others_ns) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(others_ns[left] - t_ns) <= np.abs(others_ns[right] - t_ns), left, right)


def compare_trajectories(ours: Trajectory, truth: Trajectory) -> TrajectoryComparison:
    """Position errors without alignment, after rigid and after similarity alignment (Umeyama).

    Poses are matched by time stamp within 10 ms. Raises EvaluationError when fewer than three match.
    """
    index, truth_index = associate(ours.t_ns, truth.t_ns)
    if len(index) < _MIN_POSES:
        raise EvaluationError(
            f"only {len(index)} poses of {len(ours.t_ns)} have a true pose of {len(truth.t_ns)} within "
            f"{MAX_DT_NS / 1e6:g} ms, {_MIN_POSES} are needed: ours covers {_span(ours)}, the truth {_span(truth)}"
        )
    p, q = ours.positions[index], truth.positions[truth_index]
    alignments = {
        "none": Similarity.identity(),
        "rigid": umeyama(p, q, with_scale=False),
        "similarity": umeyama(p, q, with_scale=True),
    }
    rows = tuple(_row(name, T, p, q) for name, T in alignments.items())
    return TrajectoryComparison(len(ours.t_ns), len(truth.t_ns), len(index), rows)


def _row(name: str, T: Similarity, p: F64, q: F64) -> TrajectoryRow:
    aligned = T.apply(p)
    shift = float(np.linalg.norm((aligned - p).mean(axis=0)))
    return TrajectoryRow(name, _statistics(np.linalg.norm(aligned - q, axis=1)), shift, T.rotation_deg, T.scale)


def _statistics(error: F64) -> ErrorStatistics:
    return ErrorStatistics(
        max=float(error.max()),
        mean=float(error.mean()),
        median=float(np.median(error)),
        min=float(error.min()),
        rmse=float(np.sqrt((error**2).mean())),
        std=float(error.std()),
    )


def _span(trajectory: Trajectory) -> str:
    if not len(trajectory.t_ns):
        return "nothing"
    return f"{trajectory.t_ns[0] / 1e9:.3f} to {trajectory.t_ns[-1] / 1e9:.3f} s"
