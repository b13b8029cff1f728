"""Simulated clocks, the way of messages, wandering errors and extrinsics."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from air.sources.simulated.clocks import ClockOptions, Device, DeviceClock, TransportDelay
from air.sources.simulated.extrinsics import R_BODY_NADIR, ExtrinsicsOptions, draw_extrinsics
from air.sources.simulated.motion.gauss_markov import GaussMarkov
from common.se3 import rotation_angle


@given(seed=st.integers(0, 2**31 - 1), device=st.sampled_from(Device), wander=st.floats(0, 100))
def test_a_clock_is_inverted_to_a_nanosecond(seed: int, device: Device, wander: float) -> None:
    options = ClockOptions(wander_ppb=wander, drift_ppm=200.0)
    clock = DeviceClock.draw(options, seed, device, 100.0)
    t_s = np.linspace(-1, 101, 997)
    np.testing.assert_allclose(clock.true_s(clock.device_s(t_s)), t_s, rtol=0, atol=1e-9)
    assert (np.diff(clock.device_s(t_s)) > 0).all()


def test_a_clock_runs_by_its_rate_from_its_offset() -> None:
    clock = DeviceClock.draw(ClockOptions(offset_s=50.0, drift_ppm=20.0, wander_ppb=50.0), 3, Device.IMU, 300.0)
    t_s, step_s = np.linspace(0.25, 299.75, 600), 0.01
    gained = (clock.device_s(t_s + step_s) - clock.device_s(t_s - step_s)) / (2 * step_s) - 1
    np.testing.assert_allclose(gained, clock.rate(t_s), atol=2e-11 / step_s * 0.1)  # rounding over the step
    assert 0 < clock.device_s(np.zeros(1))[0] < 50
    assert np.abs(clock.rate(np.zeros(1)))[0] < 21e-6
    assert 1e-7 < np.ptp(clock.rate(t_s)) < 5e-6  # 0.05 ppm · √300


def test_clocks_are_their_own_and_perfect_ones_are_right() -> None:
    t_s = np.linspace(0, 60, 7)
    shown = {tuple(DeviceClock.draw(ClockOptions(), 1, device, 60.0).device_s(t_s)) for device in Device}
    assert len(shown) == len(Device)
    np.testing.assert_array_equal(DeviceClock.draw(ClockOptions.perfect(), 1, Device.GNSS, 60.0).device_s(t_s), t_s)


def test_messages_arrive_late_in_order_and_sometimes_very_late() -> None:
    options = ClockOptions(delay_s=0.002, jitter_s=0.004, outliers=0.01, outlier_s=0.1)
    way, sent = TransportDelay(options, 1, Device.IMU), np.arange(0, 100, 0.2)
    arrived = np.array([way.arrival_s(float(t)) for t in sent])
    late = arrived - sent
    assert all(a <= b for a, b in pairwise(arrived))
    assert 0.002 <= late.min() < 0.0022
    assert 0.1 < late.max() < 0.106
    assert np.mean(late > 0.05) == pytest.approx(0.01, abs=0.015)
    again = TransportDelay(options, 1, Device.IMU)
    assert [again.arrival_s(float(t)) for t in sent] == arrived.tolist()
    right = TransportDelay(ClockOptions.perfect(), 1, Device.IMU)
    assert [right.arrival_s(float(t)) for t in sent] == sent.tolist()


def test_a_wandering_error_has_its_size_and_its_memory() -> None:
    process = GaussMarkov(np.random.default_rng(1), 2.0, 5.0, 20_000.0, 2)
    values = process.at(np.arange(0, 20_000, 1.0))
    assert values.std() == pytest.approx(2.0, rel=0.05)
    kept = np.mean(values[5:] * values[:-5]) / np.mean(values**2)
    assert kept == pytest.approx(np.exp(-1), abs=0.05)


def test_the_calibration_differs_from_the_truth_by_its_errors() -> None:
    options = ExtrinsicsOptions(mount_deg=2.0, camera_deg=0.2, camera_m=0.01, antenna_m=0.02)
    pairs = [draw_extrinsics(options, seed) for seed in range(200)]
    turned = [rotation_angle(true.T_body_cam.R.T @ nominal.T_body_cam.R) for true, nominal in pairs]
    assert np.degrees(np.sqrt(np.mean(np.square(turned)))) == pytest.approx(0.2 * np.sqrt(3), rel=0.15)
    moved = np.array([true.p_body_antenna - nominal.p_body_antenna for true, nominal in pairs])
    assert moved.std() == pytest.approx(0.02, rel=0.15)
    leaning = [rotation_angle(R_BODY_NADIR.T @ nominal.T_body_cam.R) for _, nominal in pairs]
    assert np.degrees(max(leaning)) < 12
    assert np.linalg.det(R_BODY_NADIR) == 1.0
    true, nominal = draw_extrinsics(ExtrinsicsOptions.perfect(), 1)
    np.testing.assert_array_equal(true.T_body_cam.matrix, nominal.T_body_cam.matrix)
    np.testing.assert_array_equal(true.p_body_antenna, nominal.p_body_antenna)
