"""The trajectory of a recorded or simulated flight: the odometry over a source, as files."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from itertools import tee
from pathlib import Path

from tqdm import tqdm

from air.navigation import mounted, with_lever_arm
from air.odometry.odometry import Odometry
from air.odometry.settings import OdometrySettings
from air.odometry.smoothing import Smoother
from air.odometry_report import OdometryReport, Told
from air.report import Stopwatch, peak_memory
from air.sensors.calibration import read_calibration
from air.sources.known import known_of
from air.sources.source import Source, open_source
from common.errors import CalibrationError, ExportError
from common.export.datum import write_datum
from common.export.trajectory import write_tum
from common.measurements import CameraFrame, GnssEpoch
from common.messages import Keyframe, Pose

SMOOTHED = "smoothed.tum"


@dataclass(frozen=True)
class TrajectoryReport:
    """What `report.json` says; `camera` is "" where there is none. Times in s, memory in bytes."""

    source: str
    camera: str
    frames: int
    odometry: OdometryReport
    problems: list[dict[str, str]]
    wall_s: float
    stages_s: dict[str, float]
    peak_memory_bytes: int


def find_trajectory(
    url: str, out: Path, calibration: Path | None, settings: OdometrySettings, quiet: bool, smooth: bool = False
) -> TrajectoryReport:
    """The report of a source's trajectory, after files have been written into `out`.

    These are `trajectory.tum` (body, at the rate of the IMU, as it was told at its time), `report.json`, with `smooth`
    also `smoothed.tum`, the same as all measurements of the flight tell it afterwards, with a camera `keyframes.tum`,
    and where GNSS has told where the world lies, `datum.json`. Without a camera GNSS and IMU alone tell the trajectory.

    Raises SourceError, CalibrationError where the camera is not known, and ExportError where nothing can be written.
    """
    source, watch, told = open_source(url), Stopwatch(), Told()
    known = known_of(source)
    given = None if calibration is None else ("", read_calibration(calibration))
    camera, mounting = given or mounted(known) or ("", None)
    odometry = Odometry(mounting, "flight", with_lever_arm(settings, known), known.p_base_ecef, watch.stage)
    smoother = odometry.estimator.history = Smoother(odometry.estimator.buffer) if smooth else None
    frames, epochs = 0, 0
    for message in tqdm(source, unit=" items", leave=False, disable=True if quiet else None):
        if isinstance(message, CameraFrame):
            if mounting is None:
                raise _unknown(source, message.camera)
            camera = camera or message.camera
            if message.camera != camera:
                continue
            frames += 1
        epochs += isinstance(message, GnssEpoch)
        in_world = odometry.in_world
        for said in odometry.feed(message):
            if told.datum is None or in_world or not isinstance(said, Pose | Keyframe):
                told.add(said)
    if not frames and not epochs:
        raise CalibrationError(f"source {url!r}: holds no camera frames and no GNSS epochs; the odometry needs either")
    report = TrajectoryReport(
        source=url,
        camera=camera if frames else "",
        frames=frames,
        odometry=told.report(odometry),
        problems=[asdict(problem) for problem in source.problems],
        wall_s=watch.total,
        stages_s=watch.stages,
        peak_memory_bytes=peak_memory(),
    )
    if smoother is not None and odometry.estimator.window is not None:
        smoother.ended(odometry.estimator.window)
    _write(out, told, report, smoother)
    return report


def _unknown(source: Source, camera: str) -> CalibrationError:
    """What is missing about a camera."""
    if camera not in known_of(source).cameras:
        return CalibrationError(
            f"source {source.url!r}: camera {camera!r} has no calibration; name one: --calibration F"
        )
    return CalibrationError(
        f"source {source.url!r}: the calibration of {camera!r} lacks T_body_cam; "
        "find it with luojia-air calibrate imu-camera and name it: --calibration F"
    )


def _write(out: Path, told: Told, report: TrajectoryReport, smoother: Smoother | None) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_tum(out / "trajectory.tum", told.poses.t_ns, told.poses)
        if report.frames:
            write_tum(out / "keyframes.tum", told.keyframes.t_ns, told.keyframes)
        if smoother is not None:
            one, same = tee(smoother.states())
            write_tum(out / SMOOTHED, (state.t_ns for state in one), (state.T_world_body for state in same))
        if told.datum is not None:
            write_datum(out / "datum.json", told.datum)
        (out / "report.json").write_text(json.dumps(asdict(report), indent=2) + "\n")
    except OSError as error:
        raise ExportError(f"{str(out)!r} cannot be written: {error.strerror}") from error


def in_words(report: TrajectoryReport) -> list[str]:
    """Lines that sum a report up."""
    told = report.odometry
    seen = f"{report.frames} frames of {report.camera}" if report.frames else "GNSS and IMU"
    if told.first_pose_s is None:
        return [f"{seen}, and no pose: the odometry could not begin"]
    between = f", {told.reprojection_rms_px:.2f} px between points and images" if report.frames else ""
    return [
        f"{told.keyframes} keyframes and {told.poses} poses of {seen} in {report.wall_s:.1f} s",
        f"first pose after {told.first_pose_s:.1f} s, {told.travelled_m:.1f} m travelled{between}",
        *(f"{t_s:8.1f} s  {text}" for t_s, text in sorted([*told.modes, *told.notes])),
    ]
