"""What `luojia-air calibrate flight` does: reads the part of a recording that turns most, calibrates, writes, tells."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from air.calibration.command import decoded_grey, imu_lines, write_calibration
from air.calibration.in_flight import FlightCalibration, calibrate_in_flight, turning
from air.odometry.settings import TrackerSettings
from air.odometry.tracker import TrackedFrame, Tracker
from air.sensors.calibration import to_toml
from air.sources.source import open_source
from common.arrays import F64, I64
from common.camera import CameraModel
from common.errors import CalibrationError
from common.measurements import CameraFrame, ImuSample

LONGEST_S, STEP_S = 15.0, 1.0
FEATURES, SPACING, FOCAL = 400, 0.024, 0.7
"""Points followed, the least distance between them and the focal length assumed to follow them, in image widths."""


def calibrate_from_flight(url: str, out: Path | None, quiet: bool) -> str:
    """A report of the camera of a source and how it sits on its IMU; written to `out` as our TOML.

    Raises SourceError, and CalibrationError for a flight that cannot tell.
    """
    t_ns, rates = _imu(url, quiet)
    begin_ns, end_ns = busiest(t_ns, rates)
    frames, size = _tracked(url, begin_ns, end_ns, quiet)
    within = (t_ns >= begin_ns) & (t_ns <= end_ns)
    found = calibrate_in_flight(frames, size, t_ns[within].tolist(), rates[within])
    write_calibration(out, to_toml(found.calibration, found.sigma))
    return "\n".join(_report(found, out))


def busiest(t_ns: I64, rates: F64) -> tuple[int, int]:
    """Begin and end, ns, of the stretch of at most `LONGEST_S` in which the body, rates (N, 3) rad/s, turned most.

    By how far attitudes spread about their trend: vibration does not count.
    """
    t_s = (t_ns - t_ns[0]) * 1e-9
    begins_s = np.arange(0.0, max(t_s[-1] - LONGEST_S, 0.0) + STEP_S, STEP_S)

    def spread(begin_s: float) -> float:
        part = slice(*np.searchsorted(t_s, [begin_s, begin_s + LONGEST_S]))
        return turning(t_ns[part], rates[part]) if t_s[part].size > 2 else 0.0

    begin_s = float(max(begins_s, key=spread))
    return int(t_ns[0] + round(begin_s * 1e9)), int(min(t_ns[0] + round((begin_s + LONGEST_S) * 1e9), t_ns[-1]))


def _imu(url: str, quiet: bool) -> tuple[I64, F64]:
    """Stamps (N,) and rates (N, 3) rad/s of a source."""
    items: Iterable[object] = tqdm(open_source(url), unit=" items", leave=False, disable=True if quiet else None)
    samples = [item for item in items if isinstance(item, ImuSample)]
    if len(samples) < 2:
        raise CalibrationError(f"{url}: holds {len(samples)} IMU samples; a flight with camera and IMU is needed")
    return np.array([s.t_ns for s in samples], np.int64), np.array([s.gyro for s in samples], float)


def _tracked(url: str, begin_ns: int, end_ns: int, quiet: bool) -> tuple[list[TrackedFrame], tuple[int, int]]:
    """The frames of the first camera of a source between two times, and the size of its images."""
    tracker: Tracker | None = None
    frames: list[TrackedFrame] = []
    name, size = None, (0, 0)
    for item in tqdm(open_source(url), unit=" items", leave=False, disable=True if quiet else None):
        if not isinstance(item, CameraFrame) or item.camera != (name := name or item.camera):
            continue
        if not begin_ns <= item.t_ns <= end_ns or (grey := decoded_grey(item)) is None:
            continue
        height, width = grey.shape
        if tracker is None:
            size, focal = (width, height), FOCAL * width
            settings = TrackerSettings(features=FEATURES, spacing=max(SPACING * width, 2.0))
            tracker = Tracker(CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2), settings)
        if (width, height) == size and (not frames or item.t_ns > frames[-1].t_ns):
            frames.append(tracker.track(grey, item.t_ns, np.eye(3)))
    return frames, size


def _report(found: FlightCalibration, out: Path | None) -> list[str]:
    known, sigma = found.calibration, found.sigma
    names = ("fx", "cx", "cy", "k1", "k2")
    return [
        *(f"{name} = {getattr(known.camera, name):.6g} ± {sigma[name]:.2g}" for name in names),
        f"time of a line = {1e6 * known.line_time_s:.1f} ± {1e6 * sigma['line_time_s']:.1f} µs",
        *imu_lines(known, np.full(3, sigma["rotation_rad"]), sigma["time_offset_s"], found.bias),
        f"{found.points} points in {found.frames} frames: reprojection error {found.error_px:.2f} px rms",
        *([] if out is None else [f"written: {out}"]),
    ]
