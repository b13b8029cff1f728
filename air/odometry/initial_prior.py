"""What is known of the first state in a window, as factors."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from air.odometry.preintegration import InertialState, to_pose3
from air.odometry.settings import ImuSettings
from common.arrays import F64

noise = gtsam.noiseModel


@dataclass(frozen=True)
class Sigmas:
    """How well a state is known: tilt and yaw rad, position m, velocity m/s, biases m/s² and rad/s."""

    tilt: float
    yaw: float
    position: float
    velocity: float
    accel_bias: float
    gyro_bias: float


def initial_prior(
    k: int, state: InertialState, sigmas: Sigmas, imu: ImuSettings
) -> tuple[gtsam.NonlinearFactorGraph, F64]:
    """Factors on the state of frame k, and the covariance (6, 6) of its pose: rotation and position in body axes."""
    s = sigmas
    axes = state.T_world_body.R.T  # gtsam's tangent turns about body axes: tilt and yaw are seen from there
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = axes @ np.diag([s.tilt**2, s.tilt**2, s.yaw**2]) @ axes.T
    covariance[3:, 3:] = np.eye(3) * s.position**2
    prior = gtsam.NonlinearFactorGraph()
    prior.add(gtsam.PriorFactorPose3(X(k), to_pose3(state.T_world_body), noise.Gaussian.Covariance(covariance)))
    prior.add(gtsam.PriorFactorVector(V(k), state.v_world, noise.Isotropic.Sigma(3, s.velocity)))
    bias = noise.Diagonal.Sigmas(np.repeat([s.accel_bias, s.gyro_bias], 3))
    prior.add(gtsam.PriorFactorConstantBias(B(k), state.bias, bias))
    made = noise.Diagonal.Sigmas(np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3))
    prior.add(gtsam.PriorFactorConstantBias(B(k), gtsam.imuBias.ConstantBias(), made))
    return prior, covariance
