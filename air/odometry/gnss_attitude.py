"""The attitude of an IMU in motion, from what it felt and from GNSS velocities: initialization without a camera.

Specific force turned by the gyroscope must add up to the changes of the Doppler velocity. All unknowns are solved for
at once, from several headings, as the problem has more than one minimum. Source: Wu and Pan, Velocity/Position
Integration Formula, Part I: Application to In-flight Coarse Alignment (2013).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from air.odometry.preintegration import ImuBuffer, InertialState, Preintegrator, from_pose3
from air.odometry.settings import ImuSettings
from common.arrays import F64

HEADINGS = 8
MAX_YAW_SIGMA = np.radians(12.0)
"""A heading that is known worse has not been found; the window improves on it."""
SAME_YAW = np.radians(30.0)
LIKELIER = 12.0
"""By how much the error of another heading must be larger."""
MAX_CHI_SQUARE = 4.0
"""Per velocity component; Doppler does not get better than its sigma, but worse."""
_MIN_VELOCITIES = 6
_FAR = 1e3
_ITERATIONS = 15


@dataclass(frozen=True, eq=False)
class MeasuredVelocity:
    """Velocity (3,) m/s of the antenna in world at GPST `t_ns`, with `sigma` (3,)."""

    t_ns: int
    v_world: F64
    sigma: F64


@dataclass(frozen=True, eq=False)
class InitialAttitude:
    """State at the last of the velocities, its position not known yet; `yaw_sigma` rad."""

    state: InertialState
    covariance: F64
    yaw_sigma: float


def find_attitude(
    imu: ImuBuffer, velocities: Sequence[MeasuredVelocity], settings: ImuSettings
) -> InitialAttitude | str:
    """Attitude, velocity and biases at the last of the velocities, or why they are not known.

    The position of the state is where the first velocity was. `covariance` (15, 15) is of rotation and position in
    body, velocity, biases.
    """
    if len(velocities) < _MIN_VELOCITIES:
        return "too few velocities"
    if not imu.covers(velocities[0].t_ns, velocities[-1].t_ns):
        return "IMU does not cover the velocities"
    integrate = Preintegrator(settings).integrate
    zero = gtsam.imuBias.ConstantBias()
    pieces = [imu.between(a.t_ns, b.t_ns) for a, b in pairwise(velocities)]
    measured = [integrate(piece, zero) for piece in pieces]
    graph = _graph(measured, velocities, settings)
    up = _up(pieces[0].accel.mean(axis=0))
    tries = [_solve(graph, measured, velocities, up, yaw) for yaw in np.arange(HEADINGS) * 2 * np.pi / HEADINGS]
    found = sorted((error, i) for i, (error, _) in enumerate(tries) if np.isfinite(error))
    if not found:
        return "no heading fits"
    best = tries[found[0][1]][1]
    last = len(velocities) - 1
    yaw = _yaw(best.atPose3(X(last)))
    for error, i in found[1:]:
        apart = abs((_yaw(tries[i][1].atPose3(X(last))) - yaw + np.pi) % (2 * np.pi) - np.pi)
        if apart > SAME_YAW and error - found[0][0] < LIKELIER:
            return "two headings fit"
    if 2 * found[0][0] > MAX_CHI_SQUARE * 3 * len(velocities):
        return f"IMU and Doppler contradict each other: χ² {2 * found[0][0]:.0f} of {3 * len(velocities)}"
    covariance = _covariance(graph, best, last)
    R = best.atPose3(X(last)).rotation().matrix()
    yaw_sigma = float(np.sqrt(R[2] @ covariance[:3, :3] @ R[2]))
    if yaw_sigma > MAX_YAW_SIGMA:
        return f"heading known to {np.degrees(yaw_sigma):.0f}° only: it takes accelerating"
    bias = best.atConstantBias(B(last))
    state = InertialState(
        velocities[-1].t_ns,
        from_pose3(best.atPose3(X(last))),
        best.atVector(V(last)),
        bias.accelerometer(),
        bias.gyroscope(),
    )
    return InitialAttitude(state, covariance, yaw_sigma)


def _graph(
    measured: Sequence[gtsam.PreintegratedCombinedMeasurements],
    velocities: Sequence[MeasuredVelocity],
    s: ImuSettings,
) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([s.accel_bias_sigma, s.gyro_bias_sigma], 3))
    graph.add(gtsam.PriorFactorConstantBias(B(0), gtsam.imuBias.ConstantBias(), sigmas))
    origin = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([_FAR, 0.1], 3))
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), origin))
    for i, one in enumerate(measured):
        graph.add(gtsam.CombinedImuFactor(X(i), V(i), X(i + 1), V(i + 1), B(i), B(i + 1), one))
    for i, velocity in enumerate(velocities):
        noise = gtsam.noiseModel.Diagonal.Sigmas(velocity.sigma)
        graph.add(gtsam.PriorFactorVector(V(i), velocity.v_world, noise))
    return graph


def _solve(
    graph: gtsam.NonlinearFactorGraph,
    measured: Sequence[gtsam.PreintegratedCombinedMeasurements],
    velocities: Sequence[MeasuredVelocity],
    R_level_body: F64,
    yaw: float,
) -> tuple[float, gtsam.Values]:
    """Error and values of the minimum that a heading leads to."""
    values = gtsam.Values()
    rotation = gtsam.Rot3.Rz(yaw).compose(gtsam.Rot3(R_level_body))
    p = np.zeros(3)
    for i, velocity in enumerate(velocities):
        values.insert(X(i), gtsam.Pose3(rotation, p))
        values.insert(V(i), velocity.v_world)
        values.insert(B(i), gtsam.imuBias.ConstantBias())
        if i < len(measured):
            rotation = rotation.compose(measured[i].deltaRij())
            p = p + velocity.v_world * measured[i].deltaTij()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    try:
        result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    except RuntimeError:
        return np.inf, values
    return float(graph.error(result)), result


def _covariance(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, last: int) -> F64:
    keys = [X(last), V(last), B(last)]
    others = [key for i in range(last) for key in (X(i), V(i), B(i))]
    left = graph.linearize(values).eliminatePartialSequential(gtsam.Ordering(others))[1]
    return np.asarray(np.linalg.inv(left.hessian(gtsam.Ordering(keys))[0]))


def _up(force: F64) -> F64:
    """`R_level_body` (3, 3) that turns a specific force upwards, without a turn about it."""
    z = force / np.linalg.norm(force)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 0.1 else np.cross(z, [0.0, 1.0, 0.0])
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _yaw(pose: gtsam.Pose3) -> float:
    R = pose.rotation().matrix()
    return float(np.arctan2(R[1, 0], R[0, 0]))
