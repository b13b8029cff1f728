"""What a standing receiver makes of its carriers: smooth codes, and the drift of Dopplers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from air.gnss.atmosphere import L1_HZ
from air.odometry.carrier_rates import LEAST_S, MEAN_S, CarrierRates
from air.odometry.code_smoothing import LONGEST_ALONE_S, CodeSmoother
from air.odometry.gnss_corrections import Signals
from common.arrays import F64, I64

L5_HZ = 1176.45e6
BEND = np.array([1.0, (L1_HZ / L5_HZ) ** 2])
AIR = 3.0


def signals(code: F64, carrier: F64, satellites: tuple[str, ...], first: list[bool], bend: F64) -> Signals:
    m = len(code)
    nothing, p = np.zeros(m), np.zeros((m, 3))
    return Signals(
        row=np.arange(m),
        satellites=satellites,
        clocks=("G",) * m,
        first=np.array(first),
        p_satellite=p,
        v_satellite=p,
        code=code,
        carrier=carrier,
        rate=nothing,
        frequency=L1_HZ / np.sqrt(bend),
        bend=bend,
        slant=np.ones(m),
        elevation=np.ones(m),
        told=np.ones(m, bool),
        issue=np.zeros(m, np.int64),
        renewed=nothing,
    )


def two_bands(t_s: float, noise: F64) -> Signals:
    """One satellite whose ionosphere grows by a millimetre a second, and whose range by ten metres."""
    distance, air = 2e7 + 10.0 * t_s, AIR + 0.001 * t_s
    code, carrier = distance + air * BEND + noise, distance - air * BEND + [7.0, -11.0]
    return signals(code, carrier, ("G05", "G05"), [True, False], BEND)


def truth(t_s: float) -> F64:
    return 2e7 + 10.0 * t_s + (AIR + 0.001 * t_s) * BEND


def test_codes_of_two_bands_lose_their_noise_whatever_the_ionosphere_does() -> None:
    smoother, rng = CodeSmoother(), np.random.default_rng(1)
    for t_s in range(401):
        code, over_s = smoother.step(float(t_s), two_bands(t_s, rng.normal(0.0, 0.5, 2)), np.array([1, 2]))
    np.testing.assert_allclose(code, truth(400.0), atol=4 * 0.5 / np.sqrt(400))
    np.testing.assert_array_equal(over_s, 400.0)


def test_a_band_alone_is_averaged_no_longer_than_the_ionosphere_allows() -> None:
    smoother = CodeSmoother()
    for t_s in range(1001):
        both = two_bands(t_s, np.zeros(2))
        one = signals(both.code[:1], both.carrier[:1], ("G05",), [True], BEND[:1])
        code, over_s = smoother.step(float(t_s), one, np.array([1]))
    # The carrier runs away from the code by twice a millimetre a second, half of whose mean time is late.
    assert abs(code[0] - truth(1000.0)[0]) < 0.002 * LONGEST_ALONE_S
    assert over_s[0] == LONGEST_ALONE_S


@pytest.mark.parametrize("arcs", [np.array([1, -1]), np.array([-1, -1])])
def test_codes_without_a_carrier_stay_as_they_are(arcs: I64) -> None:
    smoother = CodeSmoother()
    for t_s in range(10):
        epoch = two_bands(t_s, np.array([0.3, 0.4]) * (-1) ** t_s)
        code, over_s = smoother.step(float(t_s), epoch, arcs)
    assert code[1] == epoch.code[1]
    assert over_s[1] == 0.0


def test_a_broken_carrier_begins_the_mean_anew() -> None:
    smoother = CodeSmoother()
    for t_s in range(20):
        smoother.step(float(t_s), two_bands(t_s, np.zeros(2)), np.array([1, 2]))
    slipped = two_bands(20.0, np.zeros(2))
    slipped = replace(slipped, carrier=slipped.carrier + [50.0, 0.0])
    code, over_s = smoother.step(20.0, slipped, np.array([3, 2]))
    np.testing.assert_allclose(code, truth(20.0), atol=1e-6)
    np.testing.assert_array_equal(over_s, 0.0)


def test_another_model_of_the_ionosphere_changes_the_codes_by_what_it_says() -> None:
    smoother = CodeSmoother()
    for t_s in range(20):
        smoother.step(float(t_s), two_bands(t_s, np.zeros(2)), np.array([1, 2]))
    epoch = two_bands(20.0, np.zeros(2))
    epoch = replace(epoch, code=epoch.code - 2.0 * BEND, renewed=2.0 * BEND)
    code, _ = smoother.step(20.0, epoch, np.array([1, 2]))
    np.testing.assert_allclose(code, truth(20.0) - 2.0 * BEND, atol=1e-6)


def test_rates_are_those_of_the_satellites_without_the_receivers_clock() -> None:
    rates, rng = CarrierRates(), np.random.default_rng(2)
    true = np.array([0.0, 0.001, -0.0005, 0.0, 0.0002])
    names, arcs = tuple(f"G{i:02d}" for i in range(1, 6)), np.arange(5)
    clock = 0.0
    for t_s in range(round(MEAN_S) + 1):
        clock += 0.3 * rng.standard_normal()
        left = true * t_s + clock + 0.002 * rng.standard_normal(5)
        epoch = signals(np.zeros(5), left, names, [True] * 5, np.ones(5))
        found = rates.step(float(t_s), epoch, left, arcs)
        assert np.isnan(found).all() == (t_s < LEAST_S)
    np.testing.assert_allclose(found - np.median(found), true - np.median(true), atol=4 * 0.003 / MEAN_S)
    broken = rates.step(MEAN_S + 1.0, epoch, left, np.array([0, 1, 2, 3, 9]))
    assert np.isnan(broken[4])
    assert np.isfinite(broken[:4]).all()
