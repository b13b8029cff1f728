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

MIN_SAMPLES = 20
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

    Calm flight may feel like standing, so the points in the image must stay as well; an image without any says nothing.
    """
    if len(samples) < MIN_SAMPLES or not frames:
        return "there are too few samples"
    accel, gyro = np.array([s.accel for s in samples]), np.array([s.gyro for s in samples])
    shaken, turned = float(accel.std(axis=0).max()), float(gyro.std(axis=0).max())
    if shaken > settings.still_accel or turned > settings.still_gyro:
        return f"the IMU moves by {shaken:.2f} m/s² and {turned:.4f} rad/s"
    first, last = common_rays(frames[0], frames[-1])
    flow = focal * float(np.median(np.linalg.norm(first - last, axis=1))) if len(first) else 0.0
    if flow > settings.still_px or (len(frames[0].ids) and not len(first)):
        return f"the image moves by {flow:.1f} px"
    return ""
