"""The trajectory of a recorded or simulated flight: the odometry over a source, as files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from air.odometry.odometry import Odometry, Output
from air.odometry.settings import OdometrySettings
from air.report import Stopwatch, peak_memory
from air.sensors.calibration import Calibration, read_calibration
from air.sources.source import Source, open_source
from common.errors import CalibrationError, ExportError
from common.export.trajectory import write_tum
from common.measurements import CameraFrame
from common.messages import Datum, EstimatorState, Keyframe, Pose


@dataclass(frozen=True)
class TrajectoryReport:
    """What `report.json` says: times in s since the first frame, lengths in m, px.

    `modes` are the times at which the mode changed; `notes` what happened when.
    """

    source: str
    camera: str
    frames: int
    refused_frames: int
    refused_samples: int
    poses: int
    keyframes: int
    first_pose_s: float | None
    travelled_m: float
    modes: list[tuple[float, str]]
    notes: list[tuple[float, str]]
    reprojection_rms_px: float
    problems: list[dict[str, str]]
    wall_s: float
    stages_s: dict[str, float]
    peak_memory_bytes: int


@dataclass(eq=False)
class _Told:
    """What the odometry has told so far."""

    poses: list[Pose] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    states: list[EstimatorState] = field(default_factory=list)
    datum: Datum | None = None

    def add(self, outputs: list[Output]) -> None:
        for message in outputs:
            if isinstance(message, Pose):
                self.poses.append(message)
            elif isinstance(message, Keyframe):
                self.keyframes.append(message)
            elif isinstance(message, Datum):
                self.datum = message
            else:
                self.states.append(message)


def find_trajectory(
    url: str, out: Path, calibration: Path | None, settings: OdometrySettings, quiet: bool
) -> TrajectoryReport:
    """The report of a source's trajectory, after `trajectory.tum` (body, at the rate of the IMU), `keyframes.tum`
    (camera) and `report.json` have been written into `out`.

    Raises SourceError, CalibrationError where the camera is not known, and ExportError where nothing can be written.
    """
    source, watch = open_source(url), Stopwatch()
    known = None if calibration is None else read_calibration(calibration)
    odometry, camera, told, frames, first_ns = None, "", _Told(), 0, 0
    for message in tqdm(source, unit=" items", leave=False, disable=True if quiet else None):
        if isinstance(message, CameraFrame):
            if odometry is None:
                camera, first_ns = message.camera, message.t_ns
                odometry = Odometry(known or calibration_of(source, camera), "flight", settings)
            if message.camera != camera:
                continue
            frames += 1
        if odometry is not None:
            with watch.stage("frames" if isinstance(message, CameraFrame) else "imu"):
                told.add(odometry.feed(message))
    if odometry is None:
        raise CalibrationError(f"source {url!r}: holds no camera frames; the odometry needs frames and IMU samples")
    report = TrajectoryReport(
        source=url,
        camera=camera,
        frames=frames,
        refused_frames=odometry.refused_frames,
        refused_samples=odometry.estimator.buffer.refused,
        poses=len(told.poses),
        keyframes=len(told.keyframes),
        first_pose_s=_since(told.poses[0].t_ns, first_ns) if told.poses else None,
        travelled_m=_length(told.keyframes),
        modes=_changes(told.poses, first_ns),
        notes=[(_since(t_ns, first_ns), text) for t_ns, text in odometry.notes],
        reprojection_rms_px=_rms([state.reprojection_rms_px for state in told.states]),
        problems=[asdict(problem) for problem in source.problems],
        wall_s=watch.total,
        stages_s=watch.stages,
        peak_memory_bytes=peak_memory(),
    )
    _write(out, told, report)
    return report


def calibration_of(source: Source, camera: str) -> Calibration:
    """The calibration that comes with a source. Raises CalibrationError where there is none, or no mounting."""
    known = getattr(source, "known", None)
    calibrations: Mapping[str, Calibration] = (
        known.cameras if known is not None else getattr(source, "calibrations", {})
    )
    if camera not in calibrations:
        raise CalibrationError(
            f"source {source.url!r}: camera {camera!r} has no calibration; name one: --calibration F"
        )
    if calibrations[camera].T_body_cam is None:
        raise CalibrationError(
            f"source {source.url!r}: the calibration of {camera!r} lacks T_body_cam; "
            "find it with luojia-air calibrate imu-camera and name it: --calibration F"
        )
    return calibrations[camera]


def _write(out: Path, told: _Told, report: TrajectoryReport) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_tum(out / "trajectory.tum", [p.t_ns for p in told.poses], [p.T_world_body for p in told.poses])
        write_tum(out / "keyframes.tum", [k.t_ns for k in told.keyframes], [k.T_world_cam for k in told.keyframes])
        (out / "report.json").write_text(json.dumps(asdict(report), indent=2) + "\n")
    except OSError as error:
        raise ExportError(f"{str(out)!r} cannot be written: {error.strerror}") from error


def in_words(report: TrajectoryReport) -> list[str]:
    """Lines that sum a report up."""
    if report.first_pose_s is None:
        return [f"{report.frames} frames of {report.camera}, and no pose: the odometry could not begin"]
    return [
        f"{report.keyframes} keyframes and {report.poses} poses of {report.frames} frames in {report.wall_s:.1f} s",
        f"first pose after {report.first_pose_s:.1f} s, {report.travelled_m:.1f} m travelled, "
        f"{report.reprojection_rms_px:.2f} px between points and images",
        *(f"{t_s:8.1f} s  {text}" for t_s, text in sorted([*report.modes, *report.notes])),
    ]


def _since(t_ns: int, first_ns: int) -> float:
    return round((t_ns - first_ns) * 1e-9, 3)


def _changes(poses: list[Pose], first_ns: int) -> list[tuple[float, str]]:
    """When the mode changed, and to which."""
    changes: list[tuple[float, str]] = []
    for pose in poses:
        if not changes or changes[-1][1] != str(pose.mode):
            changes.append((_since(pose.t_ns, first_ns), str(pose.mode)))
    return changes


def _length(keyframes: list[Keyframe]) -> float:
    p = np.array([k.T_world_cam.t for k in keyframes]).reshape(-1, 3)
    return float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())


def _rms(values: list[float]) -> float:
    finite: Any = [value for value in values if np.isfinite(value) and value > 0]
    return float(np.sqrt(np.mean(np.square(finite)))) if finite else 0.0
