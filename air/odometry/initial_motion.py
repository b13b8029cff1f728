"""The first states of an aircraft in flight, from a few seconds of tracked points and IMU samples, in closed form.

The gyroscope gives the rotations once its bias is known from the epipolar geometry; the rest is linear.

Source: L. Kneip, S. Lynen, Direct optimization of frame-to-frame rotation (2013).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np

from air.odometry.initial import Initial, KnownSpeed, Refusal, common_rays, level
from air.odometry.initial_alignment import InertialMotion, SpeedAt, align
from air.odometry.initial_points import MIN_POINTS, near_points
from air.odometry.initial_prior import Sigmas
from air.odometry.preintegration import ImuBuffer, InertialState, Preintegrator
from air.odometry.settings import ImuSettings, InitializationSettings
from air.odometry.tracker import TrackedFrame
from common.arrays import F64
from common.se3 import SE3

BIAS_ITERATIONS, BIAS_STEP = 8, 1e-5
NEAR_NS = 300_000_000
"""How near to a frame a speed must have been known."""
SIGNIFICANT = 3.0
"""Sigmas by which one over the scale must differ from zero."""
LOOSE_TILT, LOOSE_VELOCITY = 0.2, 20.0
"""What the first state is said to be known within, rad and m/s: measurements decide."""


def initial_in_motion(
    frames: Sequence[TrackedFrame],
    buffer: ImuBuffer,
    T_body_cam: SE3,
    focal: float,
    settings: InitializationSettings,
    imu: ImuSettings,
    speeds: Sequence[KnownSpeed] = (),
) -> Initial | Refusal:
    """States of all frames. Rays to the points must open wide enough, and the speed change enough.

    Known `speeds` of several sigmas tell the scale in steady flight too.
    """
    gyro_bias = gyro_bias_of(frames, buffer, T_body_cam.R, focal, imu)
    if np.linalg.norm(gyro_bias) > 4 * imu.gyro_bias_sigma:
        return Refusal("the image turns otherwise than the gyroscope")
    motion = _integrate(frames, buffer, gyro_bias, imu)
    points, angle = near_points(frames, motion.R @ T_body_cam.R, np.radians(settings.parallax_deg), focal)
    if points is None:
        return Refusal(f"the image has moved by {np.degrees(angle):.1f}° so far")
    known = [s for s in speeds if s.speed > SIGNIFICANT * s.sigma]
    aligned = align(points, motion, T_body_cam.t, imu, _at_frames(known, frames))
    if aligned is None or not aligned.one_over_scale > SIGNIFICANT * aligned.sigma:
        return Refusal("there was too little acceleration to tell the scale")
    R_world_first = level(-aligned.fall)
    bias_first = (1.0 - imu.gravity / np.linalg.norm(aligned.fall)) * -aligned.fall
    states = []
    for i, frame in enumerate(frames):
        t = motion.t_s[i]
        p = R_world_first @ (aligned.v_first * t + aligned.fall * t**2 / 2 + motion.p[i])
        v = R_world_first @ (aligned.v_first + aligned.fall * t + motion.v[i])
        bias = motion.R[i].T @ bias_first
        states.append(InertialState(frame.t_ns, SE3(R_world_first @ motion.R[i], p), v, bias, gyro_bias))
    sigma_v = min((s.sigma for s in known), default=LOOSE_VELOCITY)
    sigmas = Sigmas(LOOSE_TILT, 1e-4, 1e-3, sigma_v, imu.accel_bias_sigma, imu.gyro_bias_sigma)
    return Initial(states, frames, sigmas, depth=1.0 / aligned.one_over_scale)


def _at_frames(speeds: Sequence[KnownSpeed], frames: Sequence[TrackedFrame]) -> list[SpeedAt]:
    """For each frame the speed that was known next to its time, if any was."""
    found = []
    for i, frame in enumerate(frames):
        near = [s for s in speeds if abs(s.t_ns - frame.t_ns) <= NEAR_NS]
        if near:
            best = min(near, key=lambda s: abs(s.t_ns - frame.t_ns))
            found.append(SpeedAt(i, best.speed, best.sigma))
    return found


def gyro_bias_of(
    frames: Sequence[TrackedFrame], buffer: ImuBuffer, R_body_cam: F64, focal: float, imu: ImuSettings
) -> F64:
    """Bias (3,) rad/s that lets the rays of successive frames lie in planes with one direction of travel each.

    Gauss–Newton on the least eigenvalues of the scatter of the planes' normals, with a prior of the device's sigma.
    """
    pairs = [(buffer.between(a.t_ns, b.t_ns), *common_rays(a, b)) for a, b in pairwise(frames)]
    pairs = [pair for pair in pairs if len(pair[1]) >= MIN_POINTS]

    def residuals(bias: F64) -> F64:
        out = list(bias / imu.gyro_bias_sigma)
        for pieces, a, b in pairs:
            R = R_body_cam.T @ pieces.turn(bias) @ R_body_cam
            normals = np.cross(a, b @ R.T)
            out.append(focal * np.sqrt(max(float(np.linalg.eigvalsh(normals.T @ normals)[0]), 0.0)))
        return np.array(out)

    bias = np.zeros(3)
    for _ in range(BIAS_ITERATIONS):
        r = residuals(bias)
        J = np.stack([(residuals(bias + BIAS_STEP * axis) - r) / BIAS_STEP for axis in np.eye(3)], axis=1)
        step = np.linalg.lstsq(J, -r, rcond=None)[0]
        while np.linalg.norm(step) > BIAS_STEP and np.sum(residuals(bias + step) ** 2) > np.sum(r**2):
            step = step / 2
        bias = bias + step
        if np.linalg.norm(step) <= BIAS_STEP:
            break
    return bias


def _integrate(frames: Sequence[TrackedFrame], buffer: ImuBuffer, gyro_bias: F64, imu: ImuSettings) -> InertialMotion:
    integrator, R, p, v = Preintegrator(imu), [np.eye(3)], [np.zeros(3)], [np.zeros(3)]
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias)
    for a, b in pairwise(frames):
        step = integrator.integrate(buffer.between(a.t_ns, b.t_ns), bias)
        p.append(p[-1] + v[-1] * step.deltaTij() + R[-1] @ step.deltaPij())
        v.append(v[-1] + R[-1] @ step.deltaVij())
        R.append(R[-1] @ step.deltaRij().matrix())
    t_s = np.array([(f.t_ns - frames[0].t_ns) * 1e-9 for f in frames])
    return InertialMotion(t_s, np.array(R), np.array(p), np.array(v))
