"""What the odometry told over a whole flight: kept for files, and summed up for a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from air.odometry.odometry import Odometry, Output
from air.pose_log import PoseLog
from common.arrays import F64
from common.export.trajectory import Trajectory
from common.geo import T_world_other
from common.messages import Datum, EstimatorState, Keyframe, Pose

LEAST_SIGMA = 1e-3
"""m; nothing is known better."""


@dataclass(frozen=True)
class OdometryReport:
    """What a report says of the odometry: times in s since its first measurement, lengths in m, px.

    `modes` are the times at which the mode changed, `modes_s` how long each lasted in all, `notes` what happened when.
    `world_found_s` is when GNSS had told where the world lies: poses and keyframes are then those since. `statistics`
    are the median, the 95 % quantile and the largest of what is told every second.
    """

    poses: int
    keyframes: int
    refused_frames: int
    refused_samples: int
    first_pose_s: float | None
    world_found_s: float | None
    travelled_m: float
    modes: list[tuple[float, str]]
    modes_s: dict[str, float]
    notes: list[tuple[float, str]]
    reprojection_rms_px: float
    statistics: dict[str, dict[str, float]]


@dataclass(frozen=True)
class Consistency:
    """How poses, one a second, compare with the truth: largest and root mean square of the error of position, m.

    `nees` is the mean of its square in its own sigmas, 3 where these are right: axes count as independent.
    """

    poses: int
    rmse: float
    largest: float
    nees: float


@dataclass(eq=False)
class Told:
    """What the odometry has told so far; poses and keyframes are those in the world of the datum once there is one."""

    poses: PoseLog = field(default_factory=PoseLog)
    keyframes: PoseLog = field(default_factory=PoseLog)
    states: list[EstimatorState] = field(default_factory=list)
    datum: Datum | None = None
    first_pose_ns: int | None = None
    world_ns: int | None = None
    modes: list[tuple[int, str]] = field(default_factory=list)
    last_ns: int = 0

    def add(self, message: Output) -> None:
        """Keep a message."""
        match message:
            case Datum():
                self.datum = message
                self.poses, self.keyframes = PoseLog(), PoseLog()
            case Pose():
                self._note_mode(message)
                self.first_pose_ns = self.first_pose_ns or message.t_ns
                if self.datum is not None:
                    self.world_ns = self.world_ns or message.t_ns
                self.poses.add(message.t_ns, message.T_world_body, message.sigma)
            case Keyframe():
                self.keyframes.add(message.t_ns, message.T_world_cam, message.sigma)
            case EstimatorState():
                self._note_mode(message)
                self.states.append(message)

    def _note_mode(self, message: Pose | EstimatorState) -> None:
        self.last_ns = max(self.last_ns, message.t_ns)
        if not self.modes or self.modes[-1][1] != str(message.mode):
            self.modes.append((message.t_ns, str(message.mode)))

    def compare(self, truth: Trajectory, datum: Datum) -> Consistency | None:
        """The poses against a true trajectory of the body in the world of a datum; None where they share no time."""
        if self.datum is None or not len(truth.t_ns):
            return None
        all_ns = self.poses.t_ns
        within = np.flatnonzero((truth.t_ns[0] <= all_ns) & (all_ns <= truth.t_ns[-1]))
        if not len(within):
            return None
        chosen = within[np.unique(all_ns[within] // 1_000_000_000, return_index=True)[1]]
        t_ns = all_ns[chosen]
        since_ns, true_ns = t_ns - truth.t_ns[0], truth.t_ns - truth.t_ns[0]
        p_true = np.column_stack([np.interp(since_ns, true_ns, axis) for axis in truth.positions.T])
        errors = T_world_other(datum, self.datum).apply(self.poses.positions[chosen]) - p_true
        sigmas = np.maximum(self.poses.sigmas[chosen], LEAST_SIGMA)
        lengths = np.linalg.norm(errors, axis=1)
        rmse, nees = float(np.sqrt(np.mean(lengths**2))), float(np.mean(np.sum((errors / sigmas) ** 2, axis=1)))
        return Consistency(len(chosen), rmse, float(lengths.max()), nees)

    def report(self, odometry: Odometry) -> OdometryReport:
        """All of it summed up."""
        first_ns = odometry.first_ns or 0
        rms_px = [state.reprojection_rms_px for state in self.states if state.reprojection_rms_px > 0]
        return OdometryReport(
            poses=len(self.poses),
            keyframes=len(self.keyframes),
            refused_frames=odometry.refused_frames,
            refused_samples=odometry.estimator.buffer.refused,
            first_pose_s=_since(self.first_pose_ns, first_ns),
            world_found_s=_since(self.world_ns, first_ns),
            travelled_m=_length(self.poses.positions[::10]),
            modes=[((t_ns - first_ns) * 1e-9, mode) for t_ns, mode in self.modes],
            modes_s=self._durations_s(),
            notes=[((t_ns - first_ns) * 1e-9, text) for t_ns, text in odometry.notes],
            reprojection_rms_px=float(np.sqrt(np.mean(np.square(rms_px)))) if rms_px else 0.0,
            statistics={
                "reprojection_px": _statistics(rms_px),
                "points": _statistics([state.points for state in self.states]),
                "satellites": _statistics([state.satellites for state in self.states]),
                "code_rms_m": _statistics([state.code_rms_m for state in self.states]),
                "doppler_rms_mps": _statistics([state.doppler_rms_mps for state in self.states]),
                "carrier_rms_m": _statistics([state.carrier_rms_m for state in self.states]),
                "position_sigma_m": _statistics(np.linalg.norm(self.poses.sigmas[::100], axis=1).tolist()),
            },
        )

    def _durations_s(self) -> dict[str, float]:
        durations: dict[str, float] = {}
        ends = [*(t_ns for t_ns, _ in self.modes[1:]), self.last_ns]
        for (t_ns, mode), end_ns in zip(self.modes, ends, strict=True):
            durations[mode] = durations.get(mode, 0.0) + (end_ns - t_ns) * 1e-9
        return durations


def _since(t_ns: int | None, first_ns: int) -> float | None:
    return None if t_ns is None else (t_ns - first_ns) * 1e-9


def _length(p: F64) -> float:
    return float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())


def _statistics(values: Sequence[float]) -> dict[str, float]:
    finite = np.array([value for value in values if np.isfinite(value)])
    if not len(finite):
        return {}
    return {"median": float(np.median(finite)), "p95": float(np.quantile(finite, 0.95)), "max": float(finite.max())}
