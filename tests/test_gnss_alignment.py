"""The odometry's own frame is placed on the earth: yaw from Doppler, the anchor from all ranges."""

from __future__ import annotations

import numpy as np
import pytest
from gnss_scene import DATUM
from hypothesis import given
from hypothesis import strategies as st
from test_gnss_factors import epoch_at

from air.odometry.gnss_alignment import Anchor, YawAlignment, align_yaw, find_anchor
from common.arrays import F64
from common.geo import T_ecef_enu

MOST = np.radians(2.0)


def turned(v: F64, yaw: float) -> F64:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(v @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T)


@given(st.floats(-np.pi, np.pi), st.integers(0, 1000))
def test_yaw_comes_back_within_its_sigma(yaw: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    local = rng.normal(0, 1, 3) + rng.normal(0, 0.5, (30, 3))
    sigma = np.full(30, 0.05)
    found = align_yaw(local, turned(local, yaw) + 0.05 * rng.standard_normal((30, 3)), sigma, MOST)
    assert isinstance(found, YawAlignment)
    error = (found.yaw - yaw + np.pi) % (2 * np.pi) - np.pi
    assert abs(error) < 5 * found.sigma  # five sigmas: once in two million


def test_yaw_is_refused_when_it_cannot_be_known() -> None:
    rng = np.random.default_rng(0)
    still = 0.01 * rng.standard_normal((20, 3))
    assert "moving" in str(align_yaw(still, 0.1 * rng.standard_normal((20, 3)), np.full(20, 0.1), MOST))
    flying = rng.normal(0, 3, (20, 3))
    assert "contradict" in str(align_yaw(flying, turned(flying, 1.0) * 1.5, np.full(20, 0.05), MOST))
    assert "too few" in str(align_yaw(flying[:2], flying[:2], np.full(2, 0.05), MOST))
    assert "stands" in str(align_yaw(np.zeros((20, 3)), np.zeros((20, 3)), np.full(20, 0.05), MOST))


def test_four_velocities_of_one_second_each_suffice() -> None:
    """At 1 Hz, 3 m/s and 5 cm/s of noise the yaw is good to a degree after four epochs."""
    rng = np.random.default_rng(1)
    local = np.array([[3.0, 0.1, 0.0]] * 4)
    found = align_yaw(local, turned(local, 2.0) + 0.05 * rng.standard_normal((4, 3)), np.full(4, 0.05), MOST)
    assert isinstance(found, YawAlignment)
    assert abs(found.yaw - 2.0) < np.radians(2.0)


def test_the_anchor_makes_all_ranges_fit() -> None:
    rng = np.random.default_rng(2)
    origin, yaw = np.array([12.0, -7.0, 3.0]), 0.8
    p_odom = np.cumsum(rng.normal(0, 1, (10, 3)), axis=0)
    p_world = origin + turned(p_odom, yaw)
    epochs = [epoch_at(p, np.zeros(3), rng.normal(0, 100), 0.0, np.zeros(8)) for p in p_world]
    near = T_ecef_enu(DATUM).apply(p_world.mean(axis=0) + [20.0, -10.0, 30.0])
    found = find_anchor(p_odom, epochs, yaw, near)
    assert isinstance(found, Anchor)
    back = T_ecef_enu(DATUM).inverse() @ found.T_ecef_odom
    # ENU at `near` and at the datum differ by 5 µrad: a tenth of a millimetre over the trajectory.
    assert back.t == pytest.approx(origin, abs=2e-3)
    assert found.misfit < 1e-3
    one = find_anchor(p_odom[:1], epochs[:1], yaw, near)
    assert isinstance(one, Anchor)
    # Multipath does not average out over ten epochs of a trajectory.
    assert np.trace(found.covariance_enu) > 0.3 * np.trace(one.covariance_enu)


def test_no_ranges_no_anchor() -> None:
    assert find_anchor(np.zeros((0, 3)), [], 0.0, T_ecef_enu(DATUM).t) == "no ranges"
