"""IMU samples between two moments, as one relative motion with its covariance.

Source: C. Forster et al., On-Manifold Preintegration for Real-Time Visual–Inertial Odometry (2017), sections V and VI;
the integration itself and its first-order correction for another bias are gtsam's.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import gtsam
import numpy as np

from air.odometry.settings import ImuSettings
from common.arrays import F64, Bool
from common.measurements import ImuSample
from common.se3 import SE3

RATE_S = 0.005
"""Assumed between samples until two of them are there."""


@dataclass(frozen=True, eq=False)
class InertialState:
    """Pose and velocity m/s in world, and the biases (3,) m/s² and rad/s of the IMU."""

    t_ns: int
    T_world_body: SE3
    v_world: F64
    accel_bias: F64
    gyro_bias: F64

    @property
    def bias(self) -> gtsam.imuBias.ConstantBias:
        """The biases as gtsam has them."""
        return gtsam.imuBias.ConstantBias(self.accel_bias, self.gyro_bias)


@dataclass(frozen=True, eq=False)
class ImuPieces:
    """Constant motion over N consecutive pieces of time.

    `dt_s` (N,); `accel` (N, 3) m/s², specific force; `gyro` (N, 3) rad/s; `doubtful` (N,) where samples were missing
    or out of range.
    """

    dt_s: F64
    accel: F64
    gyro: F64
    doubtful: Bool

    @property
    def rate(self) -> F64:
        """Mean rate of turn (3,) rad/s, as measured; zero over no time."""
        return np.asarray(self.dt_s @ self.gyro / self.dt_s.sum()) if len(self.dt_s) else np.zeros(3)

    def turn(self, gyro_bias: F64) -> F64:
        """`R_begin_end` (3, 3), how the body turned over all pieces."""
        R = gtsam.Rot3()
        for step in (self.gyro - gyro_bias) * self.dt_s[:, None]:
            R = R.compose(gtsam.Rot3.Expmap(step))
        return np.asarray(R.matrix())


class ImuBuffer:
    """Samples in order of time. Each holds from half-way after the one before to half-way before the next.

    A strapdown IMU gives the mean over its sampling period, so its increments add up exactly.
    """

    def __init__(self, settings: ImuSettings) -> None:
        self._settings = settings
        self._t: list[int] = []
        self._samples: list[ImuSample] = []
        self.refused = 0

    def add(self, sample: ImuSample) -> bool:
        """Whether the sample was taken: it is later than the last one, and finite."""
        if (self._t and sample.t_ns <= self._t[-1]) or not np.isfinite([sample.accel, sample.gyro]).all():
            self.refused += 1
            return False
        self._t.append(sample.t_ns)
        self._samples.append(sample)
        return True

    @property
    def last_ns(self) -> int | None:
        """Time of the last sample."""
        return self._t[-1] if self._t else None

    def covers(self, begin_ns: int, end_ns: int) -> bool:
        """Whether samples lie on both sides of a stretch of time."""
        return bool(self._t) and self._t[0] <= begin_ns and end_ns <= self._t[-1]

    def forget(self, t_ns: int) -> None:
        """Drop what is not needed from a time on."""
        first = max(0, bisect_right(self._t, t_ns) - 2)
        del self._t[:first], self._samples[:first]

    def samples(self, begin_ns: int, end_ns: int) -> list[ImuSample]:
        """The samples with begin ≤ t ≤ end."""
        return self._samples[bisect_left(self._t, begin_ns) : bisect_right(self._t, end_ns)]

    def between(self, begin_ns: int, end_ns: int) -> ImuPieces:
        """What was felt from `begin_ns` to `end_ns`; beyond the samples the nearest one holds, in doubt."""
        first = max(0, bisect_right(self._t, begin_ns) - 1)
        last = min(len(self._t), bisect_left(self._t, end_ns) + 1)
        t, samples = self._t[first:last], self._samples[first:last]
        if not samples or end_ns <= begin_ns:
            return ImuPieces(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
        since_s = (np.array(t) - begin_ns) * 1e-9
        edges = np.concatenate([[-np.inf], (since_s[1:] + since_s[:-1]) / 2, [np.inf]])
        edges = np.clip(edges, 0.0, (end_ns - begin_ns) * 1e-9)
        dt_s = np.diff(edges)
        doubtful = np.array([s.saturated for s in samples]) | (dt_s > self._settings.max_gap_s)
        held = dt_s > 0
        accel, gyro = (np.array([getattr(s, name) for s in samples])[held] for name in ("accel", "gyro"))
        return ImuPieces(dt_s[held], accel, gyro, doubtful[held])


class Preintegrator:
    """Turns pieces of motion into gtsam's pre-integrated measurements."""

    def __init__(self, settings: ImuSettings) -> None:
        self._settings = settings

    def integrate(self, pieces: ImuPieces, bias: gtsam.imuBias.ConstantBias) -> gtsam.PreintegratedCombinedMeasurements:
        """The pieces as one measurement, at a bias; what is doubtful in them counts with a large sigma."""
        s = self._settings
        parameters = self.parameters()
        measurement = gtsam.PreintegratedCombinedMeasurements(parameters, bias)
        in_doubt = False
        steps = zip(pieces.accel, pieces.gyro, pieces.dt_s.tolist(), pieces.doubtful.tolist(), strict=True)
        for accel, gyro, dt, doubtful in steps:
            if doubtful != in_doubt:  # the measurement reads its parameters at each step
                in_doubt = doubtful
                sigmas = (s.doubtful_accel, s.doubtful_gyro) if doubtful else (s.accel_noise, s.gyro_noise)
                parameters.setAccelerometerCovariance(np.eye(3) * sigmas[0] ** 2)
                parameters.setGyroscopeCovariance(np.eye(3) * sigmas[1] ** 2)
            measurement.integrateMeasurement(accel, gyro, dt)
        return measurement

    def parameters(self) -> gtsam.PreintegrationCombinedParams:
        """Noise and gravity as gtsam has them; z is up."""
        s = self._settings
        parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(s.gravity)
        parameters.setAccelerometerCovariance(np.eye(3) * s.accel_noise**2)
        parameters.setGyroscopeCovariance(np.eye(3) * s.gyro_noise**2)
        parameters.setIntegrationCovariance(np.eye(3) * 1e-8)
        parameters.setBiasAccCovariance(np.eye(3) * s.accel_bias_walk**2)
        parameters.setBiasOmegaCovariance(np.eye(3) * s.gyro_bias_walk**2)
        return parameters

    def moved(self, measurement: gtsam.PreintegratedCombinedMeasurements, bias: gtsam.imuBias.ConstantBias) -> bool:
        """Whether the bias is so far from the one of a measurement that the first order does not do."""
        then, s = measurement.biasHat(), self._settings
        far_accel = np.linalg.norm(bias.accelerometer() - then.accelerometer()) > s.accel_bias_step
        return bool(far_accel or np.linalg.norm(bias.gyroscope() - then.gyroscope()) > s.gyro_bias_step)

    def predict(self, state: InertialState, pieces: ImuPieces) -> InertialState:
        """Where a state leads to over pieces of motion."""
        measurement = self.integrate(pieces, state.bias)
        nav = measurement.predict(gtsam.NavState(to_pose3(state.T_world_body), state.v_world), state.bias)
        t_ns = state.t_ns + round(float(pieces.dt_s.sum()) * 1e9)
        return InertialState(t_ns, from_pose3(nav.pose()), nav.velocity(), state.accel_bias, state.gyro_bias)


class Propagation:
    """A state carried on by the IMU, piece by piece."""

    def __init__(self, integrator: Preintegrator, state: InertialState) -> None:
        self.state = state
        self._first = state
        self._start = gtsam.NavState(to_pose3(state.T_world_body), state.v_world)
        self._measurement = gtsam.PreintegratedCombinedMeasurements(integrator.parameters(), state.bias)

    def advance(self, pieces: ImuPieces) -> None:
        """Carry the state on over pieces that begin where it stands."""
        for accel, gyro, dt in zip(pieces.accel, pieces.gyro, pieces.dt_s.tolist(), strict=True):
            self._measurement.integrateMeasurement(accel, gyro, dt)
        nav, first = self._measurement.predict(self._start, self._first.bias), self._first
        t_ns = self.state.t_ns + round(float(pieces.dt_s.sum()) * 1e9)
        self.state = InertialState(t_ns, from_pose3(nav.pose()), nav.velocity(), first.accel_bias, first.gyro_bias)


def to_pose3(T: SE3) -> gtsam.Pose3:
    """The transform as gtsam has it."""
    return gtsam.Pose3(gtsam.Rot3(T.R), T.t)


def from_pose3(pose: gtsam.Pose3) -> SE3:
    """gtsam's transform as ours."""
    return SE3(pose.rotation().matrix(), pose.translation())
