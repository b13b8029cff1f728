"""The first states of an aircraft in flight, from a few seconds of tracked points and IMU samples, in closed form.

The gyroscope gives the rotations once its bias is known from the epipolar geometry. In a scene of mean depth one,
positions are linear in the first velocity, the tilt of gravity and the accelerometer's increments times one over the
scale. No step asks which of two motions a flat ground has seen, as the rotations come from elsewhere; and as the
accelerometer is the regressor, noise in the image does not shrink the scale.

Sources: L. Kneip, S. Lynen, Direct optimization of frame-to-frame rotation (2013); T.-C. Dong-Si, A. Mourikis,
Estimator initialization in vision-aided inertial navigation with unknown camera–IMU calibration (2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from air.odometry.initial import Initial, KnownSpeed, Refusal, common_rays, level
from air.odometry.initial_prior import Sigmas
from air.odometry.preintegration import ImuBuffer, InertialState, Preintegrator
from air.odometry.settings import ImuSettings, InitializationSettings
from air.odometry.tracker import TrackedFrame
from common.arrays import F64, I64
from common.se3 import SE3

MIN_POINTS = 20
BIAS_ITERATIONS, BIAS_STEP = 8, 1e-5
ROUNDS, UNKNOWNS = 4, 6
IN_FRONT = 0.9
"""Share of the points that must lie before their cameras."""
SIGNIFICANT = 3.0
"""Sigmas by which one over the scale must differ from zero."""
LOOSE_TILT, LOOSE_VELOCITY = 0.2, 20.0
"""What the first state is said to be known within, rad and m/s: measurements decide."""


@dataclass(frozen=True, eq=False)
class _Motion:
    """Where the IMU says that the body is at N frames, as seen from the first: rotations (N, 3, 3) and, without gravity
    and first velocity, positions (N, 3) m and velocities (N, 3) m/s at times (N,) s."""

    t_s: F64
    R: F64
    p: F64
    v: F64


def initial_in_motion(
    frames: Sequence[TrackedFrame],
    buffer: ImuBuffer,
    T_body_cam: SE3,
    focal: float,
    settings: InitializationSettings,
    imu: ImuSettings,
    speed: KnownSpeed | None = None,
) -> Initial | Refusal:
    """States of all frames. Rays of the first and the last must open wide enough, and the speed change enough.

    A known `speed` at the first frame, of several sigmas, tells the scale in steady flight too.
    """
    gyro_bias = gyro_bias_of(frames, buffer, T_body_cam.R, focal, imu)
    if np.linalg.norm(gyro_bias) > 4 * imu.gyro_bias_sigma:
        return Refusal("the image turns otherwise than the gyroscope")
    turned = buffer.between(frames[0].t_ns, frames[-1].t_ns).turn(gyro_bias)
    angle = parallax(frames[0], frames[-1], T_body_cam.R.T @ turned @ T_body_cam.R)
    if not angle > np.radians(settings.parallax_deg):
        return Refusal(f"the image has moved by {np.degrees(angle):.1f}° so far")
    motion = _integrate(frames, buffer, gyro_bias, imu)
    seen = _seen(frames, motion, T_body_cam)
    if seen is None:
        return Refusal("too few points are seen long enough")
    if speed is not None and speed.speed > SIGNIFICANT * speed.sigma:
        aligned, sigma_v = _align(seen, motion, T_body_cam, imu.gravity, speed.speed), speed.sigma
    else:
        aligned, sigma_v = _align(seen, motion, T_body_cam, imu.gravity), LOOSE_VELOCITY
    if aligned is None or not aligned.one_over_scale > SIGNIFICANT * aligned.sigma:
        return Refusal("there was too little acceleration to tell the scale")
    R_world_first = level(-aligned.down)
    gravity = imu.gravity * aligned.down
    states = []
    for i, frame in enumerate(frames):
        t = motion.t_s[i]
        p = R_world_first @ (aligned.v_first * t + gravity * t**2 / 2 + motion.p[i])
        v = R_world_first @ (aligned.v_first + gravity * t + motion.v[i])
        states.append(InertialState(frame.t_ns, SE3(R_world_first @ motion.R[i], p), v, np.zeros(3), gyro_bias))
    sigmas = Sigmas(LOOSE_TILT, 1e-4, 1e-3, sigma_v, imu.accel_bias_sigma, imu.gyro_bias_sigma)
    return Initial(states, frames, sigmas, depth=1.0 / aligned.one_over_scale)


def parallax(first: TrackedFrame, last: TrackedFrame, R_first_last: F64) -> float:
    """Median angle rad between the rays of the common points beyond a turn of the camera; NaN with few of them."""
    a, b = common_rays(first, last)
    if len(a) < MIN_POINTS:
        return float("nan")
    return float(np.median(np.arccos(np.clip(np.sum(a * (b @ R_first_last.T), axis=1), -1.0, 1.0))))


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


def _integrate(frames: Sequence[TrackedFrame], buffer: ImuBuffer, gyro_bias: F64, imu: ImuSettings) -> _Motion:
    integrator, R, p, v = Preintegrator(imu), [np.eye(3)], [np.zeros(3)], [np.zeros(3)]
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias)
    for a, b in pairwise(frames):
        step = integrator.integrate(buffer.between(a.t_ns, b.t_ns), bias)
        p.append(p[-1] + v[-1] * step.deltaTij() + R[-1] @ step.deltaPij())
        v.append(v[-1] + R[-1] @ step.deltaVij())
        R.append(R[-1] @ step.deltaRij().matrix())
    t_s = np.array([(f.t_ns - frames[0].t_ns) * 1e-9 for f in frames])
    return _Motion(t_s, np.array(R), np.array(p), np.array(v))


@dataclass(frozen=True, eq=False)
class _Seen:
    """M observations of P points: index of the frame and of the point, direction (M, 3) in the first body frame."""

    frame: I64
    point: I64
    direction: F64
    count: int


def _seen(frames: Sequence[TrackedFrame], motion: _Motion, T_body_cam: SE3) -> _Seen | None:
    """What was seen of the points that at least half of the frames saw; None when there are too few."""
    frame_of = np.concatenate([np.full(len(f.ids), i) for i, f in enumerate(frames)])
    all_ids, rays = np.concatenate([f.ids for f in frames]), np.concatenate([f.rays for f in frames])
    ids, counts = np.unique(all_ids, return_counts=True)
    ids = ids[counts >= max(3, len(frames) // 2)]
    if len(ids) < MIN_POINTS:
        return None
    used = np.isin(all_ids, ids)
    direction = np.einsum("nij,nj->ni", motion.R[frame_of[used]] @ T_body_cam.R, rays[used])
    return _Seen(frame_of[used], np.searchsorted(ids, all_ids[used]), direction, len(ids))


@dataclass(frozen=True, eq=False)
class _Aligned:
    """First velocity (3,) m/s and the unit vector (3,) down, both in the first body frame; one over the mean depth, per
    m, and its sigma."""

    v_first: F64
    down: F64
    one_over_scale: float
    sigma: float


def _align(
    seen: _Seen, motion: _Motion, T_body_cam: SE3, gravity: float, speed: float | None = None
) -> _Aligned | None:
    """Least squares of the distances of points from rays at a mean depth of one; None where it comes out behind.

    Unknown are the first velocity, one over the scale k, and k times a change of `down` on its sphere. A known first
    `speed` m/s tells k instead.
    """
    down = -motion.p[-1] / np.linalg.norm(motion.p[-1])
    projector = np.eye(3) - seen.direction[:, :, None] * seen.direction[:, None, :]
    t = motion.t_s[seen.frame][:, None, None]
    lever = motion.p + motion.R @ T_body_cam.t
    weight = np.ones(len(seen.frame))
    for _ in range(ROUNDS):
        tangent = level(down)[:2]
        fallen = (lever + gravity * down * motion.t_s[:, None] ** 2 / 2)[seen.frame][:, :, None]
        moves = np.concatenate([t * np.eye(3), fallen, gravity * t**2 / 2 * tangent.T], axis=2)
        P = projector * weight[:, None, None]
        A, Ax = np.zeros((seen.count, 3, 3)), np.zeros((seen.count, 3, UNKNOWNS))
        np.add.at(A, seen.point, P)
        np.add.at(Ax, seen.point, P @ moves)
        points = np.linalg.solve(A + 1e-12 * np.eye(3), Ax)
        H = np.einsum("nki,nkl,nlj->ij", moves, P, moves) - np.einsum("nki,nkj->ij", Ax, points)
        depths = np.einsum("nk,nkj->nj", seen.direction, points[seen.point] - moves)
        m = depths.mean(axis=0)
        free = np.linalg.solve(H, m)
        x = free / (m @ free)
        k, turn = x[3] if speed is None else np.linalg.norm(x[:3]) / speed, x[4:]
        along = depths @ x
        if k <= 0 or np.mean(along > 0) < IN_FRONT:
            return None
        down = down + turn @ tangent / k
        down /= np.linalg.norm(down)
        weight = 1.0 / np.clip(along, 0.2, 5.0) ** 2
    if speed is not None:
        return _Aligned(x[:3] / k, down, float(k), 0.0)
    variance = float(x @ H @ x) / (2 * len(weight) - 3 * seen.count)
    covariance = variance * (np.linalg.inv(H) - np.outer(free, free) / (m @ free))
    return _Aligned(x[:3] / k, down, float(k), float(np.sqrt(max(covariance[3, 3], 0.0))))
