"""Everything about a camera and its IMU from an ordinary flight: no board, no known lens (core: no file, no clock).

What the gyroscope has felt turns the image by so many pixels. A first guess takes the scene to be far, so that the
image only turns; then a bundle adjustment with the gyroscope's rotations finds intrinsics, mounting, time offset and
the time of a line together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from air.calibration.flight_adjustment import Adjustment, Fit, Known
from air.calibration.flight_model import (
    BIAS,
    COUNT,
    FOCAL,
    LINE,
    MOUNTING,
    OFFSET,
    PRINCIPAL,
    RADIAL,
    FlightModel,
    Sightings,
)
from air.calibration.flight_start import first_flight
from air.calibration.gyroscope import Gyroscope
from air.calibration.imu_camera import guess_imu_camera
from air.calibration.rotations import Turn, turn_alone
from air.odometry.tracker import TrackedFrame
from air.sensors.calibration import Calibration
from common.arrays import F64, I64
from common.camera import CameraModel
from common.errors import CalibrationError
from common.se3 import SE3

FOCALS = np.geomspace(0.3, 1.5, 9)
"""First guesses of the focal length, image widths."""
FRAMES, MIN_FRAMES, MIN_VIEWS, POINTS = 70, 30, 4, 1200
PIXEL_SIGMA, INDEPENDENT = 1.0, 4.0
"""Errors of one track are alike: it counts as so many observations, each of so many px."""
ROUNDS, REJECT, ROBUST = 2, 2.5, 3.0
FIRST_STEPS, STEPS = 12, 15
MAX_FOCAL_SIGMA, MIN_TURNING = 0.05, np.radians(0.2)
_EVERYTHING = np.arange(COUNT)
_FIRST = np.array([FOCAL, *range(5, 9), *range(10, 13)])


@dataclass(frozen=True, eq=False)
class FlightCalibration:
    """A calibration, one sigma by the keys of its file, and how well it explains the flight: `error_px` rms of `points`
    in `frames`; `bias` (3,) rad/s of the gyroscope."""

    calibration: Calibration
    sigma: dict[str, float]
    bias: F64
    error_px: float
    points: int
    frames: int


def calibrate_in_flight(
    frames: Sequence[TrackedFrame], size: tuple[int, int], t_ns: Sequence[int], rates: F64
) -> FlightCalibration:
    """The camera of `size` (width, height) px that saw the frames, on the gyroscope with `rates` (N, 3) rad/s, body.

    Raises CalibrationError where the flight cannot tell.
    """
    if len(frames) < MIN_FRAMES or len(t_ns) < 2:
        raise CalibrationError(
            f"{len(frames)} frames and {len(t_ns)} IMU samples at the same time; {MIN_FRAMES} frames at least"
        )
    turned = turning(t_ns, rates)
    if not turned > MIN_TURNING:
        raise CalibrationError(
            f"the body turned by {np.degrees(turned):.2f}° rms only; turn the camera, "
            f"by {np.degrees(MIN_TURNING):.1f}° rms at least, while it sees a near and textured scene"
        )
    guess, R_body_cam, offset_s = _first_guess(frames, size, t_ns, rates)
    gyro = Gyroscope(t_ns, rates)
    model = FlightModel(_sightings(frames, gyro, offset_s), gyro, guess, R_body_cam)
    known = _known(frames, guess, offset_s)
    fit, model, kept_px = _adjusted(model, known)
    covariance = np.linalg.inv(fit.information) * PIXEL_SIGMA**2
    sigma = np.sqrt(np.diag(covariance))
    if not sigma[FOCAL] < MAX_FOCAL_SIGMA:
        raise CalibrationError(
            f"the flight leaves {sigma[FOCAL]:.0%} of the focal length open; turn the camera, faster, while it sees a "
            "near and textured scene"
        )
    theta = fit.flight.theta
    mounting = SE3(model.R_body_cam(theta), np.zeros(3))
    camera = model.camera(theta)
    values = [sigma[FOCAL] * camera.fx, sigma[FOCAL] * camera.fx, *sigma[PRINCIPAL], *sigma[RADIAL]]
    named = dict(zip(("fx", "fy", "cx", "cy", "k1", "k2"), map(float, values), strict=True))
    named |= {"time_offset_s": float(sigma[OFFSET]), "line_time_s": float(sigma[LINE])}
    named |= {"rotation_rad": float(sigma[MOUNTING].max())}
    found = Calibration(camera, mounting, float(theta[OFFSET]), max(float(theta[LINE]), 0.0))
    return FlightCalibration(found, named, theta[BIAS], kept_px, model.seen.points, len(model.seen.t_s))


def turning(t_ns: Sequence[int] | I64, rates: F64) -> float:
    """How far attitudes spread about a steady turn, rad rms, by the rates (N, 3) rad/s."""
    t_s = (np.asarray(t_ns, np.int64) - t_ns[0]) * 1e-9
    angle = np.cumsum(rates * np.gradient(t_s)[:, None], axis=0)
    trend = np.column_stack([np.ones(len(t_s)), t_s])
    rest = angle - trend @ np.linalg.lstsq(trend, angle, rcond=None)[0]
    return float(np.sqrt(np.sum(rest.var(axis=0))))


def _first_guess(
    frames: Sequence[TrackedFrame], size: tuple[int, int], t_ns: Sequence[int], rates: F64
) -> tuple[CameraModel, F64, float]:
    """The pinhole camera, `R_body_cam` and time offset s under which image and gyroscope turn most alike."""
    best: tuple[float, CameraModel, F64, float] | None = None
    width, height = size
    for focal in FOCALS * width:
        camera = CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        turns = []
        for a, b in pairwise(frames):
            _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
            if len(in_a) >= MIN_FRAMES:
                turn = turn_alone(camera.rays(a.uv[in_a]), camera.rays(b.uv[in_b]))
                turns.append(Turn(a.t_ns, b.t_ns, turn))
        R_body_cam, offset_s, residual = guess_imu_camera(t_ns, rates, turns)
        if best is None or residual < best[0]:
            best = residual, camera, R_body_cam, offset_s
    assert best is not None
    return best[1:]


def _sightings(frames: Sequence[TrackedFrame], gyro: Gyroscope, offset_s: float) -> Sightings:
    """What some frames, evenly spread, saw of points that several of them saw."""
    times_s = [(frame.t_ns - gyro.first_ns) * 1e-9 for frame in frames]
    covered = [f for f, t in zip(frames, times_s, strict=True) if 0.0 < t + offset_s < gyro.last_s and len(f.ids)]
    if len(covered) < MIN_FRAMES:
        raise CalibrationError(f"only {len(covered)} frames show anything while the IMU records; {MIN_FRAMES} at least")
    chosen = np.unique(np.linspace(0, len(covered) - 1, FRAMES).round().astype(int)).tolist()
    picked = [covered[i] for i in chosen]
    ids = np.concatenate([f.ids for f in picked])
    known, point, views = np.unique(ids, return_inverse=True, return_counts=True)
    t_s = np.array([(f.t_ns - gyro.first_ns) * 1e-9 for f in picked])
    frame = np.concatenate([np.full(len(f.ids), k) for k, f in enumerate(picked)])
    seen = Sightings(t_s, frame, point, np.concatenate([f.uv for f in picked]), len(known))
    enough = np.flatnonzero(views >= MIN_VIEWS)
    kept = np.zeros(len(known), bool)
    kept[enough[np.linspace(0, len(enough) - 1, min(POINTS, len(enough))).round().astype(int)]] = True
    return seen.only(kept)


def _known(frames: Sequence[TrackedFrame], guess: CameraModel, offset_s: float) -> Known:
    """What is known of the unknowns before the adjustment."""
    interval_s = float(np.median(np.diff([frame.t_ns for frame in frames]))) * 1e-9
    line_s = 0.25 * interval_s / guess.height  # a frame is read out in half the time to the next, or so
    theta, sigma, step = np.zeros(COUNT), np.ones(COUNT), np.full(COUNT, 1e-6)
    theta[FOCAL], theta[PRINCIPAL], theta[OFFSET], theta[LINE] = (
        np.log(guess.fx),
        (guess.cx, guess.cy),
        offset_s,
        line_s,
    )
    sigma[PRINCIPAL], sigma[RADIAL], sigma[OFFSET], sigma[LINE], sigma[BIAS] = (
        0.01 * guess.width,
        0.2,
        0.1,
        line_s,
        0.05,
    )
    step[PRINCIPAL], step[LINE] = 1e-6 * guess.width, 1e-6 / guess.height
    return Known(theta, sigma / PIXEL_SIGMA, step)


def _adjusted(model: FlightModel, known: Known) -> tuple[Fit, FlightModel, float]:
    """The adjusted flight, without points that move by themselves, and the rms error px of the others."""
    adjustment = Adjustment(model, known, _weights(model.seen), 1.0)
    fit = adjustment.fit(first_flight(model, known.theta), _FIRST, FIRST_STEPS)
    rms_px = 0.0
    for _ in range(ROUNDS):
        errors = np.nan_to_num(model.errors(fit.flight), nan=100.0)
        seen = model.seen
        views = np.bincount(seen.point, minlength=seen.points)
        square = np.bincount(seen.point, np.sum(errors**2, axis=1), minlength=seen.points) / views
        kept = square < REJECT**2 * np.median(square)
        model = model.only(kept)
        flight = fit.flight.only(kept)
        width = ROBUST * float(np.sqrt(np.median(square)))
        fit = Adjustment(model, known, _weights(model.seen), width).fit(flight, _EVERYTHING, STEPS)
        rms_px = float(np.sqrt(np.mean(np.nansum(model.errors(fit.flight) ** 2, axis=1))))
    return fit, model, rms_px


def _weights(seen: Sightings) -> F64:
    """Weights (M,) of observations, by which a long track counts as a few."""
    views = np.bincount(seen.point, minlength=seen.points)
    return np.asarray(np.minimum(1.0, INDEPENDENT / views)[seen.point])
