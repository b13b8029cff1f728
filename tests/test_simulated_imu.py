"""The simulated IMU: truth regained from a perfect one, errors as specified, bytes through the real driver."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from air.sensors.imu_xsens import RATE_HZ, TICK_NS, XsensImu
from air.sources.simulated.clocks import ClockOptions, Device, DeviceClock
from air.sources.simulated.imu import G, ImuOptions, SimulatedImu
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.simulated.motion.multirotor import fly
from air.sources.simulated.motion.rotations import exponential, logarithm
from air.sources.simulated.motion.trajectory import Trajectory
from common.arrays import F64
from common.gravity import earth_rate_enu, normal_gravity
from common.measurements import ImuSample
from common.messages import Datum
from common.se3 import quaternion_to_matrix, rotation_angle, rotation_vector, rotation_vector_to_matrix

DATUM = Datum("2024-06-01T09-00-00-test", 30.5355, 114.3655, 62.0)
PERFECT = ImuOptions.perfect()
RIGHT = ClockOptions.perfect()


def flight(duration_s: float, **options: Any) -> Trajectory:
    return fly(FlightOptions(**options), 1, duration_s, np.array([0.0, 0.0, 0.3]))[0]


def simulated(
    trajectory: Trajectory, options: ImuOptions = PERFECT, clock: ClockOptions = RIGHT, seed: int = 5
) -> SimulatedImu:
    right = DeviceClock.draw(clock, seed, Device.IMU, trajectory.duration_s)
    return SimulatedImu(trajectory, DATUM, options, seed, right)


def felt(imu: SimulatedImu) -> tuple[F64, F64, F64]:
    """Stamps s, accelerations and rates of the whole flight."""
    batches = list(imu.batches())
    return (
        np.concatenate([b.t_s for b in batches]),
        np.concatenate([b.accel for b in batches]),
        np.concatenate([b.gyro for b in batches]),
    )


def read(imu: SimulatedImu, driver: XsensImu | None = None) -> list[ImuSample]:
    driver = driver or XsensImu()
    return [s for _, data in imu.packets() for s in driver.feed(data, 0) if isinstance(s, ImuSample)]


# A perfect device


@pytest.mark.parametrize("earth_rate", [0, 1])
def test_a_perfect_imu_integrated_for_a_minute_returns_to_the_truth(earth_rate: int) -> None:
    trajectory = flight(75.0, start="air", length=40.0, spacing=8.0)
    t_s, accel, gyro = felt(simulated(trajectory, replace(PERFECT, earth_rate=earth_rate)))
    first, step_s = 1000, 1 / RATE_HZ
    t_s -= PERFECT.delay_s
    at = trajectory.at(np.array([t_s[first] - step_s / 2]))
    p, v, R = at.p_world[0], at.v_world[0], at.R_world_body[0]
    earth = earth_rate * earth_rate_enu(DATUM.latitude_deg)
    gravity = np.array([0.0, 0.0, -normal_gravity(DATUM.latitude_deg, DATUM.height)])
    for force, omega in zip(accel[first : first + 12_000], gyro[first : first + 12_000], strict=True):
        middle = rotation_vector_to_matrix(-earth * step_s / 2) @ R @ rotation_vector_to_matrix(omega * step_s / 2)
        v_new = v + step_s * (middle @ force + gravity - 2 * np.cross(earth, v))
        p = p + step_s / 2 * (v + v_new)
        v, R = v_new, rotation_vector_to_matrix(-earth * step_s) @ R @ rotation_vector_to_matrix(omega * step_s)
    end = trajectory.at(np.array([t_s[first + 12_000] - step_s / 2]))
    assert np.linalg.norm(p - end.p_world[0]) < 1e-3
    assert np.linalg.norm(v - end.v_world[0]) < 1e-4
    assert rotation_angle(R.T @ end.R_world_body[0]) < 1e-6


def test_at_rest_it_feels_gravity_and_the_turning_earth() -> None:
    trajectory = flight(5.0, mission="stand", heading_deg=0.0)
    _, accel, gyro = felt(simulated(trajectory))
    up = normal_gravity(DATUM.latitude_deg, DATUM.height)
    np.testing.assert_allclose(accel, np.tile([0, 0, up], (len(accel), 1)), atol=1e-9)
    east, north, up = earth_rate_enu(DATUM.latitude_deg)
    np.testing.assert_allclose(gyro, np.tile([north, -east, up], (len(gyro), 1)), atol=1e-9)  # nose to the north


@pytest.mark.parametrize("delay_s", [0.0, 0.0025, 0.01])
def test_a_sample_is_the_motion_at_its_delay_before_the_stamp(delay_s: float) -> None:
    trajectory = flight(20.0, start="air")
    t_s, accel, gyro = felt(simulated(trajectory, replace(PERFECT, delay_s=delay_s, earth_rate=0)))
    motion = trajectory.at(t_s - delay_s)
    gravity = [0, 0, normal_gravity(DATUM.latitude_deg, DATUM.height)]
    force = np.einsum("nji,nj->ni", motion.R_world_body, motion.a_world + gravity)
    # The mean over 5 ms differs from the value in the middle by the second derivative · 25e-6 / 24.
    np.testing.assert_allclose(accel, force, atol=2e-4)
    np.testing.assert_allclose(gyro, motion.omega_body, atol=2e-4)


def test_rotations_are_those_of_se3() -> None:
    vectors = np.random.default_rng(1).uniform(-0.8, 0.8, (50, 3)) * np.geomspace(1e-9, 1, 50)[:, None]
    matrices = exponential(vectors)
    for vector, matrix in zip(vectors, matrices, strict=True):
        np.testing.assert_allclose(matrix, rotation_vector_to_matrix(vector), atol=1e-14)
        np.testing.assert_allclose(rotation_vector(matrix), vector, atol=1e-14)
    np.testing.assert_allclose(logarithm(matrices), vectors, atol=1e-14)


# Errors


def allan(values: F64, steps: int) -> float:
    """Overlapping Allan deviation over `steps` samples, the root mean square of three axes."""
    total = np.cumsum(values, axis=0)
    second = total[2 * steps :] - 2 * total[steps:-steps] + total[: -2 * steps]
    return float(np.sqrt(np.mean(second**2) / 2) / steps)


def gauss_markov_allan(sigma: float, time_s: float, tau_s: float) -> float:
    """Allan deviation of a Gauss–Markov process: IEEE 952, annex C.1.5, with q² = 2σ²/T."""
    x = tau_s / time_s
    return float(np.sqrt(2 * sigma**2 / x * (1 - (3 - 4 * np.exp(-x) + np.exp(-2 * x)) / (2 * x))))


def test_the_allan_deviation_at_rest_is_the_data_sheets() -> None:
    """60 µg/√Hz and 0.01 °/s/√Hz: what ten minutes tell to some percent (3 % at 1 s, 8 % at 10 s)."""
    _, accel, gyro = felt(simulated(flight(600.0, mission="stand"), ImuOptions()))
    for tau_s, tolerance in ((0.05, 0.02), (1.0, 0.05), (10.0, 0.2)):
        steps = round(tau_s * RATE_HZ)
        white = 60e-6 * G / np.sqrt(tau_s), np.radians(0.01) / np.sqrt(tau_s)
        wander = (
            gauss_markov_allan(0.015e-3 * G, 300.0, tau_s),
            gauss_markov_allan(np.radians(10.0) / 3600, 300.0, tau_s),
        )
        for values, noise, bias in zip((accel, gyro), white, wander, strict=True):
            assert allan(values, steps) == pytest.approx(np.hypot(noise, bias), rel=tolerance)


def test_biases_wander_as_specified_and_are_told_as_truth() -> None:
    options = replace(PERFECT, accel_bias_mg=1.0, gyro_bias_deg_h=100.0, bias_time_s=10.0)
    trajectory = flight(600.0, mission="stand")
    imu = simulated(trajectory, options)
    t_s, accel, gyro = felt(imu)
    accel_bias, gyro_bias = imu.biases(t_s)
    _, accel_true, gyro_true = felt(simulated(trajectory))
    np.testing.assert_allclose(accel - accel_true, accel_bias, atol=1e-12)
    np.testing.assert_allclose(gyro - gyro_true, gyro_bias, atol=1e-12)
    # 30 independent values and more on three axes each: a sigma is known to about 10 %.
    assert accel_bias.std() == pytest.approx(1e-3 * G, rel=0.25)
    assert allan(gyro_bias, 2000) == pytest.approx(gauss_markov_allan(np.radians(100) / 3600, 10.0, 10.0), rel=0.25)


def test_scale_misalignment_and_g_sensitivity_act_on_what_is_felt() -> None:
    trajectory = flight(20.0, start="air")
    options = replace(PERFECT, accel_scale=0.01, gyro_scale=0.02, misalignment_deg=1.0)
    imu = simulated(trajectory, options)
    _, accel, gyro = felt(imu)
    _, accel_true, gyro_true = felt(simulated(trajectory))
    np.testing.assert_allclose(accel, accel_true @ imu.scale_accel.T, atol=1e-12)
    np.testing.assert_allclose(gyro, gyro_true @ imu.scale_gyro.T, atol=1e-12)
    assert 0.002 < np.abs(imu.scale_accel - np.eye(3)).max() < 0.08
    _, _, bent = felt(simulated(trajectory, replace(PERFECT, g_sensitivity_deg_s=0.01)))
    assert np.degrees(np.abs(bent - gyro_true)).mean() == pytest.approx(0.01, abs=0.01)


def test_rotors_shake_it_in_flight_alone() -> None:
    trajectory = flight(40.0, stand_s=10.0)
    options = replace(PERFECT, vibration=2.0, vibration_deg_s=1.0, rotor_hz=62.0)
    t_s, accel, gyro = felt(simulated(trajectory, options))
    _, accel_true, gyro_true = felt(simulated(trajectory))
    shaken, turned = accel - accel_true, gyro - gyro_true
    assert not shaken[t_s < 4.5].any()
    flying = t_s > 15.0
    # Averaging over 5 ms leaves sinc(0.31) = 0.85 of the first harmonic, 0.48 of the second.
    assert 0.5 * 2.0 < np.sqrt(np.mean(np.sum(shaken[flying] ** 2, axis=1))) < 2.0
    assert 0.5 < np.degrees(np.sqrt(np.mean(np.sum(turned[flying] ** 2, axis=1)))) < 1.0
    spectrum = np.abs(np.fft.rfft(shaken[flying], axis=0)).sum(axis=1)
    hz = np.fft.rfftfreq(int(flying.sum()), 1 / RATE_HZ)
    near = (np.abs(hz - 62) < 5) | (np.abs(hz - (200 - 124)) < 10) | (np.abs(hz - (200 - 186)) < 14)
    assert np.sum(spectrum[near] ** 2) > 0.9 * np.sum(spectrum**2)  # what is above 100 Hz folds back


def test_what_is_beyond_the_range_is_clipped_and_flagged() -> None:
    trajectory = flight(3.0, start="air")
    samples = read(simulated(trajectory, replace(PERFECT, accel_range_g=0.9)))
    assert all(s.saturated for s in samples)
    assert max(s.accel[2] for s in samples) == pytest.approx(0.9 * G)
    assert not any(s.saturated for s in read(simulated(trajectory, replace(PERFECT, accel_range_g=5.0))))


def test_values_come_in_the_converters_steps() -> None:
    options = replace(PERFECT, accel_range_g=5.0, gyro_range_deg_s=450.0, bits=16)
    _, accel, gyro = felt(simulated(flight(3.0, start="air"), options))
    for values, limit in ((accel, 5 * G), (gyro, np.radians(450))):
        steps = values / (2 * limit / 2**16)
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)


SWITCHES = [f.name for f in fields(ImuOptions) if f.name not in ("bias_time_s", "rotor_hz", "baud", "precision")]


@pytest.mark.parametrize("name", SWITCHES)
def test_every_error_can_be_turned_off(name: str) -> None:
    trajectory = flight(1.5, start="air")
    normal = replace(ImuOptions(), lost=0.1, accel_range_g=1.0)
    assert list(simulated(trajectory, normal).packets()) != list(
        simulated(trajectory, replace(normal, **{name: 0})).packets()
    )


# Bytes


@pytest.mark.parametrize(("precision", "atol"), [("float64", 0), ("fp16.32", 2**-33), ("float32", 2**-21)])
def test_the_driver_reads_what_was_measured(precision: str, atol: float) -> None:
    clock, trajectory = ClockOptions(), flight(4.0, start="air")
    options = replace(ImuOptions(), precision=precision)
    batches, driver = list(simulated(trajectory, options, clock).batches()), XsensImu()
    samples = read(simulated(trajectory, options, clock), driver)
    np.testing.assert_allclose([s.accel for s in samples], np.concatenate([b.accel for b in batches]), 0, atol)
    np.testing.assert_allclose([s.gyro for s in samples], np.concatenate([b.gyro for b in batches]), 0, atol)
    ticks = np.concatenate([b.ticks for b in batches])
    half_ns = 500_000_000 // RATE_HZ  # the middle of the time over which a sample is the mean
    np.testing.assert_array_equal([s.t_ns for s in samples], ticks * TICK_NS - half_ns)
    assert (driver.counts.dropped_bytes, driver.counts.refused, driver.counts.missing) == (0, 0, 0)
    assert not driver.faults


def test_stamps_are_the_devices_own_clock_and_its_counter_wraps() -> None:
    trajectory = flight(4.0, start="air")
    clock = DeviceClock(2**32 * 1e-4 - 2.0, np.full(20, 50e-6))
    imu = SimulatedImu(trajectory, DATUM, PERFECT, 1, clock)
    samples = read(imu)
    assert set(np.diff([s.t_ns for s in samples]).tolist()) == {5_000_000}
    t_s = np.concatenate([b.t_s for b in imu.batches()])
    np.testing.assert_allclose(clock.device_s(t_s), [s.t_ns * 1e-9 for s in samples], atol=1e-7)
    assert np.diff(t_s).mean() == pytest.approx(0.005 / (1 + 50e-6), rel=1e-9)


def test_attitude_and_magnetic_field_come_with_the_samples() -> None:
    trajectory = flight(4.0, start="air")
    imu = simulated(trajectory, replace(PERFECT, tilt_deg=0.3, heading_deg=2.0))
    t_s = np.concatenate([b.t_s for b in imu.batches()])
    R_true = trajectory.at(t_s).R_world_body
    for sample, R in list(zip(read(imu), R_true, strict=True))[::50]:
        assert sample.q_enu_body is not None
        assert np.degrees(rotation_angle(R.T @ quaternion_to_matrix(sample.q_enu_body))) < 8
    fields_seen = [R @ s.magnetic for s, R in zip(read(imu), R_true, strict=True) if s.magnetic is not None]
    np.testing.assert_allclose(fields_seen, np.tile(fields_seen[0], (len(fields_seen), 1)), atol=1e-6)
    assert len(fields_seen) == 400
    assert fields_seen[0][2] < 0 < fields_seen[0][1]  # northwards and down


def test_messages_leave_in_order_after_they_were_sampled_and_are_the_same_each_time() -> None:
    trajectory = flight(4.0, start="air")
    imu = simulated(trajectory, ImuOptions(), ClockOptions())
    packets = list(imu.packets())
    leaving = np.array([t for t, _ in packets])
    t_s = np.concatenate([b.t_s for b in imu.batches()])
    assert (np.diff(leaving) > 0).all()
    assert ((leaving - t_s > 0.0005) & (leaving - t_s < 0.0015)).all()  # some 85 bytes at 921600 baud
    assert packets == list(simulated(trajectory, ImuOptions(), ClockOptions()).packets())
    assert packets != list(simulated(trajectory, ImuOptions(), ClockOptions(), seed=6).packets())


def test_lost_messages_are_missed_by_the_driver() -> None:
    driver = XsensImu()
    samples = read(simulated(flight(4.0, start="air"), replace(PERFECT, lost=0.1)), driver)
    assert len(samples) + driver.counts.missing == pytest.approx(800, abs=3)
    assert 40 < driver.counts.missing < 130
