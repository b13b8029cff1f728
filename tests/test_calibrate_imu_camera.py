"""Rotation and time offset between camera and IMU: exact turns, rendered motion, and a real recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from air.__main__ import main
from air.calibration.imu_camera import calibrate_imu_camera
from air.calibration.jackknife import groups, jackknife
from air.calibration.rotations import Turn, turn_between
from air.sensors.calibration import read_calibration
from common.arrays import F64
from common.errors import CalibrationError
from common.se3 import rotation_angle, rotation_vector, rotation_vector_to_matrix

R_BODY_CAM = rotation_vector_to_matrix(np.array([-1.2, 0.4, 2.0]))
BIAS = np.array([0.01, -0.02, 0.005])
T0_NS = 1_400_000_000_000_000_000


def rate(t_s: F64, axes: F64) -> F64:
    """Smooth rates (N, 3) rad/s."""
    waves = np.stack([np.sin(2.3 * t_s) + 0.5 * np.sin(5.1 * t_s), np.cos(3.1 * t_s), np.sin(1.7 * t_s + 1)], axis=-1)
    return np.asarray(0.6 * waves * axes)


def motion(
    offset_s: float, axes: F64, seconds: float = 20.0, noise: float = 1e-3, wrong: float = 0.05, seed: int = 1
) -> tuple[list[int], F64, list[Turn]]:
    """IMU stamps and rates, and turns of a camera whose clock is behind by `offset_s`; some turns are wrong."""
    random = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, 0.005)
    gyro = rate(t_s, axes) + BIAS + random.normal(0.0, 1e-3, (len(t_s), 3))
    frames_s = np.arange(1.0, seconds - 1.0, 0.05)
    fine = np.linspace(0.0, 0.05, 11)
    turns = []
    for begin_s in frames_s:
        R = np.eye(3)
        for w in rate(begin_s + (fine[:-1] + fine[1:]) / 2, axes):
            R = R @ rotation_vector_to_matrix(w * 0.005)
        seen = R_BODY_CAM.T @ rotation_vector(R) + random.normal(0.0, noise, 3)
        if random.random() < wrong:
            seen = seen + random.normal(0.0, 0.1, 3)
        begin_ns = T0_NS + round((begin_s - offset_s) * 1e9)
        turns.append(Turn(begin_ns, begin_ns + 50_000_000, seen))
    return [T0_NS + round(t * 1e9) for t in t_s], gyro, turns


@pytest.mark.parametrize("offset_s", [0.0, 0.0371, -0.24])
def test_rotation_offset_and_bias_are_found_in_spite_of_wrong_turns(offset_s: float) -> None:
    found = calibrate_imu_camera(*motion(offset_s, np.ones(3)))
    error = rotation_vector(found.R_body_cam @ R_BODY_CAM.T)
    assert np.degrees(np.linalg.norm(error)) < 0.5
    assert found.time_offset_s == pytest.approx(offset_s, abs=2e-3)
    np.testing.assert_allclose(found.bias, BIAS, atol=3e-3)
    # Four numbers of one draw: within four of their sigmas.
    assert (np.abs(error) < 4 * found.sigma_rotation + 1e-4).all()
    assert abs(found.time_offset_s - offset_s) < 4 * found.sigma_offset_s + 1e-4


def test_sigmas_are_of_the_size_of_the_errors() -> None:
    off = []
    for seed in range(10):
        found = calibrate_imu_camera(*motion(0.02, np.ones(3), seconds=12.0, noise=3e-3, seed=seed))
        error = rotation_vector(found.R_body_cam @ R_BODY_CAM.T) / found.sigma_rotation
        off.append(np.append(error, (found.time_offset_s - 0.02) / found.sigma_offset_s))
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 2.0


def test_turning_about_one_axis_alone_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"turn (it|the camera) about all axes"):
        calibrate_imu_camera(*motion(0.0, np.array([1.0, 0.0, 0.0]), noise=1e-4, wrong=0.0))


def test_standing_still_is_refused() -> None:
    with pytest.raises(CalibrationError, match="about all axes"):
        calibrate_imu_camera(*motion(0.0, np.zeros(3)))


def test_recordings_that_do_not_overlap_are_refused() -> None:
    stamps, gyro, turns = motion(0.0, np.ones(3))
    late = [Turn(t.begin_ns + 10**12, t.end_ns + 10**12, t.rotation) for t in turns]
    with pytest.raises(CalibrationError, match="are both on one clock"):
        calibrate_imu_camera(stamps, gyro, late)


@given(
    turn=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    travel=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    seed=st.integers(0, 1000),
)
def test_a_turn_is_found_with_travel_and_without(turn: tuple[float, ...], travel: tuple[float, ...], seed: int) -> None:
    random = np.random.default_rng(seed)
    p = np.column_stack([random.uniform(-2, 2, (120, 2)), random.uniform(2.5, 8, 120)])
    R, t = rotation_vector_to_matrix(np.array(turn)), np.array(travel)
    q = (p - t) @ R  # p_before = R p_after + t
    p, q = p[q[:, 2] > 1.0], q[q[:, 2] > 1.0]
    noise = 0.1 / 500.0
    before = p / p[:, 2:] + np.column_stack([random.normal(0, noise, (len(p), 2)), np.zeros(len(p))])
    after = q / q[:, 2:] + np.column_stack([random.normal(0, noise, (len(q), 2)), np.zeros(len(q))])
    before[:5, :2] += 0.1  # wrong tracks
    found = turn_between(before, after, 1.0 / 500.0)
    assert found is not None
    # 0.1 px of noise at 500 px of focal length: 0.3 mrad in the middle; a wrong track that fits by chance costs most.
    assert rotation_angle(rotation_vector_to_matrix(found).T @ R) < 1e-2


def test_a_real_camera_is_found_on_its_imu(
    real_data: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """EuRoC V1_01: the vehicle stands for most of these 4.7 s, and the rotation is still found within a degree."""
    folder = real_data("euroc_v101_micro")
    sensor, out = folder / "mav0" / "cam0" / "sensor.yaml", tmp_path / "camera.toml"
    command = ["calibrate", "imu-camera", f"euroc:{folder}", "--calibration", str(sensor), "--out", str(out), "--quiet"]
    assert main(command) == 0
    assert "bias of the gyroscope = -0.002" in capsys.readouterr().out  # Vicon's estimate: -0.0022 rad/s
    found, truth = read_calibration(out), read_calibration(sensor)
    assert found.T_body_cam is not None
    assert truth.T_body_cam is not None
    assert np.degrees(rotation_angle(found.T_body_cam.R.T @ truth.T_body_cam.R)) < 1.0
    assert abs(found.time_offset_s) < 1e-3
    assert found.camera == truth.camera


def test_the_jackknife_of_a_mean_is_the_textbook_formula() -> None:
    values = np.random.default_rng(1).normal(0, 3, 40)
    sigma = jackknife(list(values), lambda kept: np.array([np.mean(kept)]))
    assert sigma[0] == pytest.approx(values.std(ddof=1) / np.sqrt(40))
    assert [len(group) for group in groups(list(values), 12)] == [3, 3, 4] * 4
