"""What the image and the IMU say together about an aircraft in flight: its velocity, where down is, and the scale.

The gyroscope gives the rotations, so positions are linear in the first velocity, in gravity and in the accelerometer's
increments, each times one over the scale. No step asks which of two motions a flat ground has seen, as the rotations
come from elsewhere; and as the accelerometer is the regressor, noise in the image does not shrink the scale.

Source: T.-C. Dong-Si, A. Mourikis, Estimator initialization in vision-aided inertial navigation with unknown
camera–IMU calibration (2012).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from air.odometry.initial import level
from air.odometry.initial_points import InitialPoints
from air.odometry.settings import ImuSettings
from common.arrays import F64

ROUNDS, UNKNOWNS = 8, 7
SPREAD = 8.0
"""Points nearer or further than the median by this factor count as being there."""
IN_FRONT = 0.9
"""Share of the points that must lie before their cameras; the near ones weigh most."""


@dataclass(frozen=True, eq=False)
class InertialMotion:
    """Where the IMU says that the body is at N frames, as seen from the first: rotations (N, 3, 3) and, without gravity
    and first velocity, positions (N, 3) m and velocities (N, 3) m/s at times (N,) s."""

    t_s: F64
    R: F64
    p: F64
    v: F64


@dataclass(frozen=True)
class SpeedAt:
    """A known speed m/s, with one sigma, at a frame."""

    frame: int
    speed: float
    sigma: float


@dataclass(frozen=True, eq=False)
class Aligned:
    """First velocity (3,) m/s and what falls (3,) m/s², gravity less the accelerometer's bias, both in the first body
    frame; one over the distance of the points, per m, and its sigma."""

    v_first: F64
    fall: F64
    one_over_scale: float
    sigma: float


def align(
    seen: InitialPoints, motion: InertialMotion, lever: F64, imu: ImuSettings, speeds: Sequence[SpeedAt] = ()
) -> Aligned | None:
    """Least squares of the angles between points and rays, robust; None where it comes out behind.

    The scene is at a mean distance of one; `lever` (3,) m is the camera on the body. Unknown are the first velocity,
    one over the scale k, and a change of gravity, all times k. Known are, within their sigmas, the size of gravity with
    the accelerometer's bias, and `speeds`, whose errors are taken to be alike: together they count as one.
    """
    fall = -imu.gravity * motion.p[-1] / np.linalg.norm(motion.p[-1])
    towards = np.eye(3) - seen.direction[:, :, None] * seen.direction[:, None, :]
    closeness, belief = (seen.angle / np.median(seen.angle))[seen.point], np.ones(len(seen.point))
    known, ahead = np.zeros((UNKNOWNS, UNKNOWNS)), np.ones(len(seen.point))
    for round_ in range(ROUNDS):
        axes = _axes(fall)
        moves = _moves(seen, motion, lever, fall, axes)
        H, points = _reduced(seen, moves, towards * (belief * closeness**2)[:, None, None])
        H = H + known
        depths = np.einsum("nk,nkj->nj", seen.direction, points[seen.point] - moves)
        mean = (belief * closeness * ahead) @ depths / belief.sum()
        free = np.linalg.solve(H, mean)
        x = free / (mean @ free)
        if round_ > 0:  # what is known of gravity and speed has had no say in the first
            if x[3] <= 0:
                return None
            fall = fall + x[4:] @ axes / x[3]
        along = depths @ x
        ahead = (along > 0).astype(float)
        closeness = 1.0 / np.clip(np.abs(along) / np.median(np.abs(along)), 1.0 / SPREAD, SPREAD)
        off = np.linalg.norm(np.einsum("nij,nj->ni", towards, (points[seen.point] - moves) @ x), axis=1) * closeness
        belief = 1.0 / (1.0 + (off / (2.0 * np.median(off) + 1e-12)) ** 2)
        variance = float(belief @ off**2) / max(2.0 * belief.sum() - 3.0 * len(seen.angle), 1.0)
        known = variance * _known(x, motion, fall, _axes(fall), imu, speeds)
    if (belief * closeness) @ ahead < IN_FRONT * (belief @ closeness):
        return None
    covariance = variance * (np.linalg.inv(H) - np.outer(free, free) / (mean @ free))
    return Aligned(x[:3] / x[3], fall, float(x[3]), float(np.sqrt(max(covariance[3, 3], 0.0))))


def _axes(fall: F64) -> F64:
    """Directions (3, 3), two level ones and down."""
    return np.vstack([level(fall)[:2], fall / np.linalg.norm(fall)])


def _moves(seen: InitialPoints, motion: InertialMotion, lever: F64, fall: F64, axes: F64) -> F64:
    """How each observation's camera moves (M, 3, 7) with the unknowns."""
    t = (motion.t_s[seen.frame] + seen.row_dt_s)[:, None]
    p = (motion.p + motion.R @ lever)[seen.frame] + seen.row_dt_s[:, None] * motion.v[seen.frame]
    felt = p + fall * t**2 / 2
    return np.concatenate([t[:, :, None] * np.eye(3), felt[:, :, None], t[:, :, None] ** 2 / 2 * axes.T], axis=2)


def _reduced(seen: InitialPoints, moves: F64, weight: F64) -> tuple[F64, F64]:
    """Normal equations (7, 7) without the points, and how the points (P, 3, 7) follow the unknowns."""
    A, b = np.zeros((len(seen.angle), 3, 3)), np.zeros((len(seen.angle), 3, UNKNOWNS))
    np.add.at(A, seen.point, weight)
    np.add.at(b, seen.point, weight @ moves)
    points = np.asarray(np.linalg.solve(A + 1e-12 * np.eye(3), b), np.float64)
    H = np.einsum("nki,nkl,nlj->ij", moves, weight, moves) - np.einsum("nki,nkj->ij", b, points)
    return np.asarray(H, np.float64), points


def _known(x: F64, motion: InertialMotion, fall: F64, axes: F64, imu: ImuSettings, speeds: Sequence[SpeedAt]) -> F64:
    """Normal equations (7, 7) of the size of gravity and the speeds, in sigmas, linear around the last solution x."""
    size = np.zeros(UNKNOWNS)
    size[3], size[6] = np.linalg.norm(fall) - imu.gravity, 1.0
    rows, sigmas, scales = [size], [imu.accel_bias_sigma], []
    for s in speeds:
        t = motion.t_s[s.frame]
        velocity = np.column_stack([np.eye(3), motion.v[s.frame] + fall * t, t * axes.T])
        heading = velocity @ x
        scales.append(float(np.linalg.norm(heading)) / s.speed)
        row = heading / np.linalg.norm(heading) @ velocity
        row[3] -= s.speed
        rows.append(row)
        sigmas.append(s.sigma * np.sqrt(len(speeds)))
    k = float(np.median(scales)) if scales else abs(float(x[3]))
    weighted = np.array(rows) / (k * np.array(sigmas)[:, None])
    return np.asarray(weighted.T @ weighted)
