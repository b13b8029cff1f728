"""Everything about a camera from an ordinary flight: exact geometry with noise, and a real drone's video."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from air.__main__ import main
from air.calibration import in_flight
from air.calibration.gyroscope import Gyroscope, rotation_matrices
from air.calibration.in_flight import calibrate_in_flight
from air.calibration.recorded_flight import busiest
from air.calibration.rotations import turn_alone
from air.odometry.tracker import TrackedFrame
from air.sensors.calibration import read_calibration
from common.arrays import F64
from common.camera import CameraModel
from common.errors import CalibrationError
from common.se3 import rotation_angle, rotation_vector, rotation_vector_to_matrix

T0_NS = 1_500_000_000_000_000_000
CAMERA = CameraModel(800, 480, 520.0, 520.0, 403.0, 236.0, -0.2, 0.04)
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
R_BODY_CAM = rotation_vector_to_matrix(np.array([0.05, -0.03, 0.04])) @ FORWARD
BIAS, OFFSET_S, LINE_S = np.array([0.01, -0.008, 0.004]), -0.02, 2e-5
RATE_HZ = 200.0


def rates(t_s: F64, turning: float) -> F64:
    """Rates (N, 3) rad/s of a body that weaves."""
    waves = [0.3 * np.sin(3.1 * t_s), 0.3 * np.cos(2.3 * t_s + 1), np.sin(1.3 * t_s) + 0.3 * np.sin(7.0 * t_s)]
    return np.asarray(turning * np.stack(waves, axis=1))


def flown(turning: float, seed: int = 1) -> tuple[list[TrackedFrame], list[int], F64]:
    """Frames at 15 Hz of 10 s of flight at 5 m/s over ground and trees, stamps of the IMU, and its rates."""
    random = np.random.default_rng(seed)
    t_s = np.arange(0.0, 10.6, 1 / RATE_HZ)
    path = np.empty((len(t_s), 3, 3))
    path[0] = np.eye(3)
    for i, step in enumerate(rotation_matrices(rates(t_s[:-1] + 0.5 / RATE_HZ, turning) / RATE_HZ)):
        path[i + 1] = path[i] @ step

    def seen_at(points: F64, at_s: F64) -> F64:
        i = np.clip((at_s * RATE_HZ).astype(int), 0, len(t_s) - 1)
        R = path[i] @ rotation_matrices(rates(at_s, turning) * (at_s - t_s[i])[:, None]) @ R_BODY_CAM
        place = np.stack([5.0 * at_s, 0.5 * np.sin(at_s), 0.2 * np.cos(at_s)], axis=1)
        uv = CAMERA.project(np.einsum("nji,nj->ni", R, points - place))
        return np.where(np.abs(rotation_free(uv)) < 1e4, uv, np.nan)

    points = np.column_stack(
        [random.uniform(5, 300, 9000), random.uniform(-80, 80, 9000), -12 + random.exponential(4.0, 9000)]
    )
    frames = []
    for begin_s in np.arange(0.3, 10.3, 1 / 15):
        uv = seen_at(points, np.full(len(points), begin_s))
        for _ in range(2):  # the row tells the time, and the time the row
            row_s = np.nan_to_num(uv[:, 1] - (CAMERA.height - 1) / 2) * LINE_S
            uv = seen_at(points, begin_s + row_s)
        with np.errstate(invalid="ignore"):
            inside = ((uv > 5) & (uv < [CAMERA.width - 5, CAMERA.height - 5])).all(axis=1)
        ids = np.flatnonzero(inside)[::18]
        uv = uv[ids] + random.normal(0.0, 0.3, (len(ids), 2))
        t_ns = T0_NS + round((begin_s - OFFSET_S) * 1e9)
        none = np.zeros(len(ids))
        frames.append(TrackedFrame(t_ns, ids, uv, np.zeros((len(ids), 3)), none, none > 0, False))
    gyro = rates(t_s, turning) + BIAS + random.normal(0.0, 2e-3, (len(t_s), 3))
    return frames, [T0_NS + round(t * 1e9) for t in t_s], gyro


def rotation_free(uv: F64) -> F64:
    """Pixels without those at infinity."""
    return np.nan_to_num(uv, nan=1e9)


def test_intrinsics_mounting_and_times_are_found_from_a_weaving_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(in_flight, "FRAMES", 35)  # half of them tell enough, in a fifth of the time
    frames, stamps, gyro = flown(0.3)
    found = calibrate_in_flight(frames, (CAMERA.width, CAMERA.height), stamps, gyro)
    camera = found.calibration.camera
    # 0.3 px of noise on some hundred tracks: the focal length is good to a thousandth, the model is exact.
    assert camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert (camera.cx, camera.cy) == pytest.approx((CAMERA.cx, CAMERA.cy), abs=5.0)
    # The radial terms make up for each other: what counts is where they move a point in a corner.
    corner = np.array([0.6, 0.4])
    np.testing.assert_allclose(camera.distort(corner) * camera.fx, CAMERA.distort(corner) * CAMERA.fx, atol=4.0)
    assert found.calibration.time_offset_s == pytest.approx(OFFSET_S, abs=2e-3)
    assert found.calibration.line_time_s == pytest.approx(LINE_S, abs=6e-6)
    assert found.calibration.T_body_cam is not None
    assert np.degrees(rotation_angle(found.calibration.T_body_cam.R @ R_BODY_CAM.T)) < 1.0
    np.testing.assert_allclose(found.bias, BIAS, atol=2e-3)
    assert found.error_px < 0.6


def test_a_flight_that_does_not_turn_is_refused() -> None:
    frames, stamps, gyro = flown(0.0)
    with pytest.raises(CalibrationError, match="turn the camera, by"):
        calibrate_in_flight(frames, (CAMERA.width, CAMERA.height), stamps, gyro)


def test_too_few_frames_are_refused() -> None:
    frames, stamps, gyro = flown(0.3)
    with pytest.raises(CalibrationError, match="30 frames at least"):
        calibrate_in_flight(frames[:10], (CAMERA.width, CAMERA.height), stamps, gyro)


@given(st.tuples(*[st.floats(-0.02, 0.02)] * 3))
def test_a_turn_alone_is_found_in_spite_of_near_points(vector: tuple[float, float, float]) -> None:
    random = np.random.default_rng(1)
    turn = np.array(vector)
    before = np.column_stack([random.uniform(-0.7, 0.7, (60, 2)), np.ones(60)])
    after = before @ rotation_vector_to_matrix(turn)
    after[:9] += random.normal(0.0, 0.05, (9, 3))
    # Linear in the turn: what is left is of second order, and a little of the points that move.
    np.testing.assert_allclose(turn_alone(before, after), turn, atol=6e-4)


@settings(max_examples=20)
@given(st.floats(0.0, 1.0), st.tuples(*[st.floats(-0.1, 0.1)] * 3))
def test_attitudes_add_up_rates_less_the_bias(at_s: float, bias: tuple[float, float, float]) -> None:
    t_s = np.arange(0.0, 1.001, 0.005)
    gyro = rates(t_s, 0.5)
    found = Gyroscope([round(t * 1e9) for t in t_s], gyro).attitudes(np.array([at_s]), np.array(bias))[0]
    R, dt = np.eye(3), 1e-4
    for t in np.arange(0.0, at_s - dt / 2, dt):
        R = R @ rotation_vector_to_matrix((rates(np.array([t + dt / 2]), 0.5)[0] - bias) * dt)
    # Rates are held over 5 ms, and the last step of the oracle ends within 0.1 ms.
    assert np.linalg.norm(rotation_vector(found @ R.T)) < 1e-3


def test_the_stretch_that_turns_most_is_taken_whatever_vibrates() -> None:
    t_s = np.arange(0.0, 60.0, 0.005)
    gyro = np.zeros((len(t_s), 3))
    gyro[t_s < 20, 0] = 0.3 * np.sin(2 * np.pi * 40 * t_s[t_s < 20])
    turning = (t_s > 40) & (t_s < 46)
    gyro[turning, 2] = 0.3 * np.sin(t_s[turning])
    begin_ns, end_ns = busiest(np.round(t_s * 1e9).astype(np.int64), gyro)
    assert begin_ns <= 41e9
    assert end_ns >= 45e9


@pytest.mark.slow
def test_the_video_of_a_drone_calibrates_its_camera(real_data: Callable[[str], Path], tmp_path: Path) -> None:
    out = tmp_path / "gopro.toml"
    video = real_data("karma") / "karma.mp4"
    assert main(["calibrate", "flight", f"gopro:{video}", "--out", str(out), "--quiet"]) == 0
    found = read_calibration(out)
    # Towards its end the camera yaws by 12°: far houses then move by 550 px a radian, to 5 % by hand.
    assert found.camera.fx == pytest.approx(550.0, rel=0.05)
    assert found.time_offset_s == pytest.approx(-0.018, abs=0.003)  # as the flow in its images has it
    assert 0 < found.line_time_s < 1 / 30 / 480
    assert found.T_body_cam is not None
    assert np.degrees(rotation_angle(found.T_body_cam.R @ FORWARD.T)) < 6.0  # the camera looks along its own x
