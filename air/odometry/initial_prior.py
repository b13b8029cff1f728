"""What is known of the first state in a window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gtsam.symbol_shorthand import B, V, X

from air.odometry.preintegration import InertialState, to_pose3
from air.odometry.quadratic import Quadratic
from air.odometry.settings import ImuSettings
from common.arrays import F64


@dataclass(frozen=True)
class Sigmas:
    """How well a state is known: tilt and yaw rad, position m, velocity m/s, biases m/s² and rad/s."""

    tilt: float
    yaw: float
    position: float
    velocity: float
    accel_bias: float
    gyro_bias: float

    def covariance(self, R_world_body: F64) -> F64:
        """Covariance (15, 15) of rotation and position in body axes, velocity, biases."""
        squares = np.repeat([self.position, self.velocity, self.accel_bias, self.gyro_bias], 3) ** 2
        out = np.diag([0.0, 0.0, 0.0, *squares])
        # gtsam's tangent turns about body axes: tilt and yaw are seen from there
        out[:3, :3] = R_world_body.T @ np.diag(np.square([self.tilt, self.tilt, self.yaw])) @ R_world_body
        return out


def initial_prior(k: int, state: InertialState, covariance: F64, imu: ImuSettings) -> Quadratic:
    """The state of frame k, known within a covariance (15, 15); its biases are also those that such a device has."""
    point = {X(k): to_pose3(state.T_world_body), V(k): state.v_world, B(k): state.bias.vector()}
    G, g = np.asarray(np.linalg.inv(covariance), np.float64), np.zeros(15)
    made: F64 = np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3) ** -2.0
    G[9:, 9:] += np.diag(made)
    g[9:] -= made * state.bias.vector()
    return Quadratic(point, G, g)
