"""A flight over random points of the ground: IMU samples of the simulated device, and what a tracker would see."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from air.odometry.preintegration import InertialState
from air.odometry.tracker import TrackedFrame
from air.sources.simulated.clocks import ClockOptions, Device, DeviceClock
from air.sources.simulated.extrinsics import R_BODY_NADIR
from air.sources.simulated.imu import ImuOptions, SimulatedImu
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.simulated.motion.multirotor import fly
from air.sources.simulated.survey import START_NS
from common.arrays import F64
from common.camera import CameraModel
from common.measurements import ImuSample
from common.messages import Datum
from common.se3 import SE3

DATUM = Datum("2024-06-01T09-00-00-test", 30.5355, 114.3655, 62.0)
CAMERA = CameraModel(1280, 720, 900.0, 900.0, 639.5, 359.5)
T_BODY_CAM = SE3(R_BODY_NADIR, np.array([0.10, 0.0, -0.08]))
HOME = np.array([0.0, 0.0, 0.2])
FEATURES = 160


@dataclass(eq=False)
class Scene:
    """What `sensed` gives in order of time: IMU samples, and frames at `rate_hz` with `noise_px` of each coordinate.

    The camera's rows are exposed `line_time_s` apart.
    """

    seed: int
    duration_s: float
    options: FlightOptions
    imu: ImuOptions
    noise_px: float = 0.5
    rate_hz: float = 10.0
    line_time_s: float = 0.0

    def __post_init__(self) -> None:
        self.trajectory = fly(self.options, self.seed, self.duration_s, HOME)[0]
        clock = DeviceClock.draw(ClockOptions.perfect(), self.seed, Device.IMU, self.duration_s)
        self.device = SimulatedImu(self.trajectory, DATUM, self.imu, self.seed, clock)
        rng = np.random.default_rng([self.seed, 7])
        p = rng.uniform(-110.0, 110.0, (60_000, 2))
        relief = 1.5 * np.sin(p[:, 0] / 23.0) * np.cos(p[:, 1] / 17.0)
        self.points = np.column_stack([p, relief + rng.exponential(0.5, len(p))])
        self._rng = rng

    def sensed(self) -> Iterator[ImuSample | TrackedFrame]:
        """Samples and frames."""
        times = iter(np.arange(0.05, self.duration_s - 0.05, 1.0 / self.rate_hz).tolist())
        next_s, seen, next_id = next(times), {}, 0  # type: ignore[var-annotated]
        for sample in self.samples():
            while _ns(next_s) < sample.t_ns:
                frame, seen, next_id = self._frame(next_s, seen, next_id)
                yield frame
                next_s = next(times, 1e6)
            yield sample

    def samples(self) -> Iterator[ImuSample]:
        """The IMU samples alone."""
        for batch in self.device.batches():
            for t_s, accel, gyro, clipped in zip(batch.t_s, batch.accel, batch.gyro, batch.clipped, strict=True):
                yield ImuSample(_ns(t_s - self.imu.delay_s), accel, gyro, saturated=bool(clipped.any()))

    def _frame(self, t_s: float, seen: dict[int, int], next_id: int) -> tuple[TrackedFrame, dict[int, int], int]:
        T_world_cam = self.T_world_cam(t_s)
        uv = np.full((len(self.points), 2), np.nan)
        near = (np.abs(self.points[:, :2] - T_world_cam.t[:2]) < 20.0 + 1.2 * T_world_cam.t[2]).all(axis=1)
        uv[near] = CAMERA.project(T_world_cam.inverse().apply(self.points[near]))
        visible = np.isfinite(uv).all(axis=1)
        visible &= (np.abs(uv - [CAMERA.cx, CAMERA.cy]) < [CAMERA.cx - 12, CAMERA.cy - 12]).all(axis=1)
        seen = {j: i for j, i in seen.items() if visible[j]}
        known, free = len(seen), np.flatnonzero(visible)
        for j in self._rng.permutation(free)[: 3 * FEATURES].tolist():
            if len(seen) >= FEATURES:
                break
            if j not in seen:
                seen[j], next_id = next_id, next_id + 1
        rows = np.array(list(seen), int)
        row_dt_s = np.zeros(len(rows))
        if self.line_time_s and len(rows):
            row_dt_s = (uv[rows, 1] - CAMERA.cy) * self.line_time_s
            moved = [
                self.T_world_cam(t_s + dt).inverse().apply(self.points[j]) for j, dt in zip(rows, row_dt_s, strict=True)
            ]
            uv[rows] = CAMERA.project(np.array(moved))
        uv = uv[rows].reshape(-1, 2) + self.noise_px * self._rng.standard_normal((len(rows), 2))
        rays = CAMERA.rays(uv)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        new = np.arange(len(rows)) >= known
        ids = np.array(list(seen.values()), np.int64)
        return TrackedFrame(_ns(t_s), ids, uv, rays, row_dt_s, new, len(rows) < 12), seen, next_id

    def T_world_body(self, t_s: float) -> SE3:
        """The true pose."""
        motion = self.trajectory.at(np.array([t_s]))
        return SE3(motion.R_world_body[0], motion.p_world[0])

    def T_world_cam(self, t_s: float) -> SE3:
        """The camera's true pose."""
        return self.T_world_body(t_s) @ T_BODY_CAM

    def state(self, t_ns: int) -> InertialState:
        """The true state."""
        t_s = (t_ns - START_NS) * 1e-9
        accel_bias, gyro_bias = self.device.biases(np.array([t_s]))
        v_world = self.trajectory.at(np.array([t_s])).v_world[0]
        return InertialState(t_ns, self.T_world_body(t_s), v_world, accel_bias[0], gyro_bias[0])


def _ns(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)


def aligned_rmse(estimate: F64, truth: F64) -> tuple[float, float]:
    """Root mean square error m of positions (N, 3) after the best rigid alignment, and the scale that a similarity has.

    Source: S. Umeyama, Least-squares estimation of transformation parameters between two point patterns (1991).
    """
    a, b = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    moved = a @ (U @ sign @ Vt).T
    return float(np.sqrt(np.mean(np.sum((moved - b) ** 2, axis=1)))), float(np.trace(np.diag(S) @ sign) / np.sum(a**2))
