"""Rotation and time offset between camera and IMU, from how both saw the same turns (core: no file, no clock)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from air.calibration.jackknife import groups, jackknife
from air.calibration.rotations import Turn
from common.arrays import F64
from common.errors import CalibrationError
from common.se3 import rotation_vector, rotation_vector_to_matrix, skew

SEARCH_S = 0.5
"""Time offsets up to here are found."""
STEP_S = 0.0025
BLOCKS = 10
MIN_TURNS = 40
MIN_RATE = 0.003
"""Turning rate about a second axis without which the rotation is not known, rad/s rms."""
MAX_SIGMA_RAD = np.radians(3.0)
MAX_SIGMA_S = 0.01
ROUNDS = 15


@dataclass(frozen=True, eq=False)
class ImuCamera:
    """How the camera sits on the IMU, and how their clocks differ.

    `R_body_cam` (3, 3) with `sigma_rotation` (3,) rad about the axes of the body; IMU time = camera time +
    `time_offset_s` with `sigma_offset_s`; `bias` (3,) rad/s of the gyroscope; `residual` rad rms of a turn; `turns`.
    """

    R_body_cam: F64
    sigma_rotation: F64
    time_offset_s: float
    sigma_offset_s: float
    bias: F64
    residual: float
    turns: int


def calibrate_imu_camera(t_ns: Sequence[int], gyro: F64, turns: Sequence[Turn]) -> ImuCamera:
    """Rotation and time offset from rates `gyro` (N, 3) rad/s, body, at `t_ns`, and turns of the camera.

    Cross-correlation of the rates for the offset, Kabsch's solution for the rotation, then both and the bias by
    Gauss–Newton; sigmas by leaving out blocks of time. Raises CalibrationError when the recording cannot tell.
    """
    if len(t_ns) < 2 or len(turns) < MIN_TURNS:
        raise CalibrationError(
            f"{len(turns)} turns of the camera and {len(t_ns)} IMU samples; {MIN_TURNS} turns at least"
        )
    imu = _Gyro(np.asarray(t_ns, np.int64), np.asarray(gyro, float))
    seen = [turn for turn in turns if imu.covers(turn)]
    if len(seen) < MIN_TURNS:
        raise CalibrationError(f"only {len(seen)} turns lie within the IMU's recording; are both on one clock?")
    _check_excited(seen)
    offset_s = _correlate(imu, seen)
    start = _State(_kabsch(imu, seen, offset_s), offset_s, np.zeros(3))
    best = _fit(imu, seen, start)

    def shifted(blocks: Sequence[list[Turn]]) -> F64:
        state = _fit(imu, [turn for block in blocks for turn in block], best)
        return np.append(rotation_vector(state.R @ best.R.T), state.offset_s)

    sigma = jackknife(groups(seen, BLOCKS), shifted)
    if sigma[:3].max() > MAX_SIGMA_RAD or sigma[3] > MAX_SIGMA_S:
        raise CalibrationError(
            f"the recording leaves {np.degrees(sigma[:3].max()):.1f}° and {1e3 * sigma[3]:.0f} ms open; "
            "turn the camera about all axes, faster, in front of something with texture"
        )
    residual = float(np.sqrt(np.mean(_residuals(imu, seen, best) ** 2) * 3))
    return ImuCamera(best.R, sigma[:3], best.offset_s, float(sigma[3]), best.bias, residual, len(seen))


def guess_imu_camera(t_ns: Sequence[int], gyro: F64, turns: Sequence[Turn]) -> tuple[F64, float, float]:
    """`R_body_cam` (3, 3), the time offset s and the rms rad of what they leave of the turns, however uncertain.

    Raises CalibrationError when too few turns lie within the IMU's recording.
    """
    imu = _Gyro(np.asarray(t_ns, np.int64), np.asarray(gyro, float))
    seen = [turn for turn in turns if imu.covers(turn)]
    if len(seen) < MIN_TURNS // 2:
        raise CalibrationError(f"only {len(seen)} turns lie within the IMU's recording; are both on one clock?")
    offset_s = _correlate(imu, seen)
    state = _fit(imu, seen, _State(_kabsch(imu, seen, offset_s), offset_s, np.zeros(3)))
    return state.R, state.offset_s, float(np.sqrt(np.mean(_residuals(imu, seen, state) ** 2) * 3))


@dataclass(frozen=True, eq=False)
class _State:
    R: F64
    offset_s: float
    bias: F64


class _Gyro:
    """Integrals of the rate between any two times; s since the first sample."""

    def __init__(self, t_ns: np.typing.NDArray[np.int64], gyro: F64) -> None:
        self.first_ns = int(t_ns[0])
        self.t_s = (t_ns - t_ns[0]) * 1e-9
        self._rate = gyro
        steps = 0.5 * (gyro[1:] + gyro[:-1]) * np.diff(self.t_s)[:, None]
        self._angle = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])

    def covers(self, turn: Turn) -> bool:
        begin_s, end_s = ((t - self.first_ns) * 1e-9 for t in (turn.begin_ns, turn.end_ns))
        return begin_s >= 0.0 and end_s <= self.t_s[-1] and end_s - begin_s < 0.5

    def angle(self, t_s: F64) -> F64:
        """Integrated rate (N, 3) up to times (N,), extended with the first and last rate."""
        i = np.clip(np.searchsorted(self.t_s, t_s) - 1, 0, len(self.t_s) - 2)
        after_s = t_s - self.t_s[i]
        share = after_s / (self.t_s[i + 1] - self.t_s[i])
        slope = self._rate[i + 1] - self._rate[i]
        return np.asarray(self._angle[i] + after_s[:, None] * (self._rate[i] + 0.5 * share[:, None] * slope))

    def rate(self, t_s: F64) -> F64:
        """Rates (N, 3) at times (N,)."""
        return np.stack([np.interp(t_s, self.t_s, self._rate[:, k]) for k in range(3)], axis=1)

    def turned(self, turns: Sequence[Turn], offset_s: float) -> F64:
        """Rotation vectors (N, 3) of the body over the turns, to second order of the turning of the axis within."""
        begin_s, end_s = self.times(turns)
        first, last = self.angle(begin_s + offset_s), self.angle(end_s + offset_s)
        middle = self.angle(0.5 * (begin_s + end_s) + offset_s)
        return np.asarray(last - first + np.cross(middle - first, last - middle) * (2.0 / 3.0))

    def times(self, turns: Sequence[Turn]) -> tuple[F64, F64]:
        begin_s = np.array([(turn.begin_ns - self.first_ns) * 1e-9 for turn in turns])
        return begin_s, begin_s + _durations(turns)


def _durations(turns: Sequence[Turn]) -> F64:
    return np.array([(turn.end_ns - turn.begin_ns) * 1e-9 for turn in turns])


def _check_excited(turns: Sequence[Turn]) -> None:
    rates = np.array([turn.rotation for turn in turns]) / _durations(turns)[:, None]
    rates = rates - np.median(rates, axis=0)
    rates = rates[np.linalg.norm(rates, axis=1) < 10.0]
    second = float(np.sqrt(np.linalg.eigvalsh(rates.T @ rates / max(1, len(rates)))[1]))
    if second < MIN_RATE:
        raise CalibrationError(
            f"the camera turned at {second:.3f} rad/s about a second axis, {MIN_RATE} are needed; "
            "turn it about all axes by hand, for a minute"
        )


def _correlate(imu: _Gyro, turns: Sequence[Turn]) -> float:
    """The time offset, s, at which the turns of camera and body correlate best, each time under the best rotation.

    The sum of the singular values of their covariance is the correlation under that rotation. The mean is taken out,
    and with it the bias.
    """
    cam = np.array([turn.rotation for turn in turns])
    cam = _clipped(cam - np.median(cam, axis=0))
    offsets = np.arange(-SEARCH_S, SEARCH_S + STEP_S / 2, STEP_S)

    def alike(offset_s: float) -> float:
        body = imu.turned(turns, offset_s)
        body = _clipped(body - np.median(body, axis=0))
        covariance = np.asarray(body.T @ cam)
        s1, s2, s3 = np.linalg.svd(covariance, compute_uv=False)
        return float((s1 + s2 + np.sign(np.linalg.det(covariance)) * s3) / np.linalg.norm(body))

    return float(max(offsets, key=alike))


def _clipped(vectors: F64) -> F64:
    """Vectors (N, 3) of which the longest are shortened: a wrong turn counts no more than any other."""
    length = np.linalg.norm(vectors, axis=1)
    return np.asarray(vectors * np.minimum(1.0, np.percentile(length, 95) / np.maximum(length, 1e-12))[:, None])


def _kabsch(imu: _Gyro, turns: Sequence[Turn], offset_s: float) -> F64:
    """The rotation that best maps the camera's turns onto the body's; centred, which takes the bias out."""
    weight = np.ones(len(turns))
    cam, body = np.array([turn.rotation for turn in turns]), imu.turned(turns, offset_s)
    R = np.eye(3)
    for _ in range(5):
        a, b = (v - np.average(v, axis=0, weights=weight) for v in (cam, body))
        U, _, Vt = np.linalg.svd((b * weight[:, None]).T @ a)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        error = np.linalg.norm(b - a @ R.T, axis=1)
        weight = 1.0 / np.maximum(1.0, error / (1.5 * np.median(error)))
    return np.asarray(R)


def _residuals(imu: _Gyro, turns: Sequence[Turn], state: _State) -> F64:
    cam = np.array([turn.rotation for turn in turns])
    return np.asarray(imu.turned(turns, state.offset_s) - state.bias * _durations(turns)[:, None] - cam @ state.R.T)


def _fit(imu: _Gyro, turns: Sequence[Turn], state: _State) -> _State:
    """Gauss–Newton on rotation, offset and bias, robust against wrong turns."""
    durations, (begin_s, end_s) = _durations(turns), imu.times(turns)
    cam = np.array([turn.rotation for turn in turns])
    for _ in range(ROUNDS):
        residual = _residuals(imu, turns, state)
        J = np.zeros((len(turns), 3, 7))
        J[:, :, :3] = [skew(v) for v in cam @ state.R.T]
        J[:, :, 3] = imu.rate(end_s + state.offset_s) - imu.rate(begin_s + state.offset_s)
        J[:, :, 4:] = -durations[:, None, None] * np.eye(3)
        size = np.linalg.norm(residual, axis=1)
        weight = 1.0 / np.maximum(1.0, size / (1.5 * np.median(size) + 1e-12))
        H = np.einsum("nij,n,nik->jk", J, weight, J)
        g = np.einsum("nij,n,ni->j", J, weight, residual)
        step = -np.linalg.solve(H + 1e-12 * np.eye(7), g)
        state = _State(
            rotation_vector_to_matrix(step[:3]) @ state.R,
            float(np.clip(state.offset_s + step[3], -2 * SEARCH_S, 2 * SEARCH_S)),
            state.bias + step[4:],
        )
        if np.linalg.norm(step) < 1e-9:
            break
    return state
