"""The first state of an aircraft that stands: gravity tells where up is, and the gyroscope feels its bias alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from air.odometry.initial import Initial, Refusal, common_rays, level
from air.odometry.initial_prior import Sigmas
from air.odometry.preintegration import InertialState
from air.odometry.settings import ImuSettings, InitializationSettings
from air.odometry.tracker import TrackedFrame
from common.measurements import ImuSample
from common.se3 import SE3

MIN_SAMPLES, MIN_POINTS = 20, 12
SHAKEN = 15.0
"""How much more than a quiet IMU one may move while the image stays."""
STILL_SPEED, STILL_TURN = 0.02, 0.002


def initial_at_rest(
    samples: Sequence[ImuSample],
    frames: Sequence[TrackedFrame],
    focal: float,
    settings: InitializationSettings,
    imu: ImuSettings,
) -> Initial | Refusal:
    """The state at the last frame, when IMU and image stood still over all samples and frames."""
    if why := moving(samples, frames, focal, settings):
        return Refusal(why)
    force = np.mean([s.accel for s in samples], axis=0)
    error = abs(float(np.linalg.norm(force)) - imu.gravity)
    if error > 3 * imu.accel_bias_sigma:
        return Refusal(f"the specific force at rest is {error:.2f} m/s² off gravity")
    gyro_bias = np.mean([s.gyro for s in samples], axis=0)
    state = InertialState(frames[-1].t_ns, SE3(level(force), np.zeros(3)), np.zeros(3), np.zeros(3), gyro_bias)
    tilt = imu.accel_bias_sigma / imu.gravity
    sigmas = Sigmas(tilt, 1e-4, 1e-3, STILL_SPEED, imu.accel_bias_sigma, STILL_TURN)
    return Initial([state], [frames[-1]], sigmas)


def moving(
    samples: Sequence[ImuSample], frames: Sequence[TrackedFrame], focal: float, settings: InitializationSettings
) -> str:
    """Why an aircraft is not at rest; empty when it is.

    An image in which all points stay speaks for itself, also while idling rotors shake the IMU; without such an image
    the IMU must be quiet.
    """
    if len(samples) < MIN_SAMPLES or not frames:
        return "there are too few samples"
    pairs = [common_rays(frames[0], frame) for frame in frames]
    seen = min(len(first) for first, _ in pairs) >= MIN_POINTS
    if not seen and len(frames[0].ids) >= MIN_POINTS:
        return "the image has changed"
    flow = max(focal * float(np.median(np.linalg.norm(a - b, axis=1))) for a, b in pairs) if seen else 0.0
    if flow > settings.still_px:
        return f"the image moves by {flow:.1f} px"
    accel, gyro = np.array([s.accel for s in samples]), np.array([s.gyro for s in samples])
    shaken, turned = float(accel.std(axis=0).max()), float(gyro.std(axis=0).max())
    allowed = SHAKEN if seen else 1.0
    if shaken > allowed * settings.still_accel or turned > allowed * settings.still_gyro:
        return f"the IMU moves by {shaken:.2f} m/s² and {turned:.4f} rad/s"
    return ""
