"""Beginning at rest and in flight: what the first states are, and when there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odometry_scene import CAMERA, DATUM, START_NS, T_BODY_CAM, Scene

from air.odometry.initial import Initial, KnownSpeed, Refusal, level
from air.odometry.initial_motion import gyro_bias_of, initial_in_motion
from air.odometry.initial_rest import initial_at_rest
from air.odometry.preintegration import ImuBuffer
from air.odometry.settings import ImuSettings, InitializationSettings
from air.odometry.tracker import TrackedFrame
from air.sources.simulated.imu import ImuOptions
from air.sources.simulated.motion.mission import FlightOptions
from common.gravity import normal_gravity
from common.measurements import ImuSample

IMU, SETTINGS = ImuSettings(), InitializationSettings()
PERFECT = replace(ImuOptions.perfect(), earth_rate=0)


def sensed(scene: Scene) -> tuple[ImuBuffer, list[ImuSample], list[TrackedFrame]]:
    buffer, samples, frames = ImuBuffer(IMU), [], []
    for message in scene.sensed():
        if isinstance(message, ImuSample):
            buffer.add(message)
            samples.append(message)
        else:
            frames.append(message)
    return buffer, samples, frames


def tilt_deg(state_up: np.ndarray, true_up: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(state_up @ true_up, -1.0, 1.0))))


@given(st.tuples(*[st.floats(-10.0, 10.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_level_turns_a_direction_up(up: tuple[float, float, float]) -> None:
    R = level(np.array(up))
    np.testing.assert_allclose(R @ np.array(up) / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0


@pytest.mark.parametrize("seed", [1, 2])
def test_at_rest_gravity_and_the_bias_of_the_gyroscope_are_found(seed: int) -> None:
    scene = Scene(seed, 3.0, FlightOptions(mission="stand"), ImuOptions())
    _, samples, frames = sensed(scene)
    initial = initial_at_rest(samples[:300], frames[:12], CAMERA.fx, SETTINGS, IMU)
    assert isinstance(initial, Initial)
    state, truth = initial.states[0], scene.state(initial.states[0].t_ns)
    # The bias of the accelerometer, 3 mg one sigma an axis, cannot be told from tilt: 0.17° each.
    assert tilt_deg(state.T_world_body.R[2], truth.T_world_body.R[2]) < 0.8
    # Noise of 0.01 °/s/√Hz over 1.5 s, the turning earth (0.004 °/s) and scale errors.
    np.testing.assert_allclose(state.gyro_bias, truth.gyro_bias, atol=np.radians(0.03))
    np.testing.assert_array_equal(state.v_world, np.zeros(3))


def test_flight_is_not_taken_for_rest() -> None:
    _, samples, frames = sensed(Scene(1, 3.0, FlightOptions(start="air"), ImuOptions()))
    refusal = initial_at_rest(samples[:300], frames[:12], CAMERA.fx, SETTINGS, IMU)
    assert isinstance(refusal, Refusal)
    assert "the image moves" in refusal.reason


def test_a_shaken_imu_without_an_image_is_not_at_rest() -> None:
    scene = Scene(1, 3.0, FlightOptions(start="air"), ImuOptions())
    _, samples, frames = sensed(scene)
    none = [replace(f, ids=f.ids[:0], rays=f.rays[:0], uv=f.uv[:0]) for f in frames]
    assert isinstance(initial_at_rest(samples[:300], none[:12], CAMERA.fx, SETTINGS, IMU), Refusal)


def test_a_broken_accelerometer_is_not_believed() -> None:
    _, samples, frames = sensed(Scene(1, 3.0, FlightOptions(mission="stand"), ImuOptions()))
    heavy = [replace(s, accel=1.2 * s.accel) for s in samples]
    refusal = initial_at_rest(heavy[:300], frames[:12], CAMERA.fx, SETTINGS, IMU)
    assert isinstance(refusal, Refusal)
    assert "off gravity" in refusal.reason


def test_without_errors_the_closed_form_finds_speed_and_gravity() -> None:
    scene = Scene(2, 6.0, FlightOptions(start="air"), PERFECT, noise_px=0.01)
    buffer, _, frames = sensed(scene)
    exact = replace(IMU, gravity=normal_gravity(DATUM.latitude_deg, DATUM.height))
    initial = initial_in_motion(frames[5:46:4], buffer, T_BODY_CAM, CAMERA.fx, SETTINGS, exact)
    assert isinstance(initial, Initial)
    for state in initial.states:
        truth = scene.state(state.t_ns)
        # A hundredth of a pixel turns the rotations by microradians; what is left is integration.
        assert np.linalg.norm(state.v_world) == pytest.approx(np.linalg.norm(truth.v_world), rel=0.03)
        assert tilt_deg(state.T_world_body.R[2], truth.T_world_body.R[2]) < 0.2


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_known_speed_tells_the_scale_of_steady_flight(seed: int) -> None:
    scene = Scene(seed, 3.0, FlightOptions(start="air"), ImuOptions())
    buffer, _, frames = sensed(scene)
    picked = frames[3:24:2]
    truth = scene.state(picked[0].t_ns)
    speed = KnownSpeed(picked[0].t_ns, float(np.linalg.norm(truth.v_world)), 0.1)
    initial = initial_in_motion(picked, buffer, T_BODY_CAM, CAMERA.fx, SETTINGS, IMU, [speed])
    assert isinstance(initial, Initial)
    last, true_last = initial.states[-1], scene.state(picked[-1].t_ns)
    assert np.linalg.norm(last.v_world) == pytest.approx(np.linalg.norm(true_last.v_world), abs=0.5)
    # Three axes of 3 mg, and an acceleration that the closed form takes 0.1 m/s² wrong over these 2 s.
    assert tilt_deg(last.T_world_body.R[2], true_last.T_world_body.R[2]) < 1.0


def test_a_large_bias_of_the_gyroscope_is_found_from_the_image() -> None:
    scene = Scene(1, 3.0, FlightOptions(start="air"), PERFECT)
    _, samples, frames = sensed(scene)
    bias, buffer = np.array([-0.002, 0.02, 0.077]), ImuBuffer(IMU)
    for sample in samples:
        buffer.add(replace(sample, gyro=sample.gyro + bias))
    found = gyro_bias_of(frames[3:24:2], buffer, T_BODY_CAM.R, CAMERA.fx, IMU)
    # Half a pixel of noise at 900 px over steps of 0.2 s is 2.8e-3 rad/s for a single point.
    np.testing.assert_allclose(found, bias, atol=2e-3)


def test_a_still_image_does_not_begin_in_motion() -> None:
    scene = Scene(1, 4.0, FlightOptions(mission="stand", stand_s=10.0), ImuOptions())
    scene.points[:, 2] -= 40.0  # something to see from where it stands
    buffer, _, frames = sensed(scene)
    refusal = initial_in_motion(frames[3:36:3], buffer, T_BODY_CAM, CAMERA.fx, SETTINGS, IMU)
    assert isinstance(refusal, Refusal)
    assert "moved by" in refusal.reason


def test_it_begins_at_the_time_of_the_last_frame() -> None:
    scene = Scene(1, 2.0, FlightOptions(mission="stand"), ImuOptions())
    _, samples, frames = sensed(scene)
    initial = initial_at_rest(samples[:300], frames[:12], CAMERA.fx, SETTINGS, IMU)
    assert isinstance(initial, Initial)
    assert initial.states[0].t_ns == frames[11].t_ns > START_NS
