"""Integers of carrier ambiguities agree with brute force and with the truth, and doubtful ones are refused."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from air.gnss.integers import Integers, find_integers
from common.arrays import F64

TEXTBOOK_VALUES = np.array([5.450, 3.100, 2.970])
TEXTBOOK_COVARIANCE = np.array([[6.290, 5.978, 0.544], [5.978, 6.292, 2.340], [0.544, 2.340, 6.288]])
WAVELENGTHS = (0.1903, 0.2442)  # m, GPS L1 and L2
MOST_POINTS = 200_000


def squared_norms(values: F64, covariance: F64, points: F64) -> F64:
    residual = values - points
    return np.asarray(np.einsum("ij,ij->i", residual, np.linalg.solve(covariance, residual.T).T), np.float64)


def double_differences(rng: np.random.Generator, satellites: int, sigma_code: float, sigma_phase: float) -> F64:
    """Covariance (N, N) cycles² of the float ambiguities of one epoch on two frequencies, by least squares."""
    azimuth, elevation = rng.uniform(0.0, 2.0 * np.pi, satellites), rng.uniform(0.25, 1.5, satellites)
    lines = np.column_stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)]
    )
    G, m = lines[1:] - lines[0], satellites - 1
    weight = np.linalg.inv(np.eye(m) + 1.0)  # all differences share the first satellite
    normal = np.zeros((3 + 2 * m, 3 + 2 * m))
    for band, wavelength in enumerate(WAVELENGTHS):
        code = np.hstack([G, np.zeros((m, 2 * m))])
        phase = code.copy()
        phase[:, 3 + band * m : 3 + (band + 1) * m] = np.eye(m) * wavelength
        normal += code.T @ weight @ code / sigma_code**2 + phase.T @ weight @ phase / sigma_phase**2
    return np.asarray(np.linalg.inv(normal)[3:, 3:], np.float64)


def flown(seed: int, satellites: int = 11, sigma_code: float = 0.5) -> tuple[F64, F64, F64]:
    """True integers (N,), float values (N,) and their covariance (N, N)."""
    rng = np.random.default_rng(seed)
    covariance = double_differences(rng, satellites, sigma_code, 0.003)
    truth = rng.integers(-(10**8), 10**8, len(covariance)).astype(np.float64)
    return truth, truth + np.linalg.cholesky(covariance) @ rng.standard_normal(len(truth)), covariance


def accepted(found: Integers | str) -> Integers:
    assert isinstance(found, Integers), found
    return found


def refused(found: Integers | str) -> str:
    assert isinstance(found, str), found
    return found


# The nearest integers


def test_the_textbook_example_gives_its_published_integers() -> None:
    found = accepted(find_integers(TEXTBOOK_VALUES, TEXTBOOK_COVARIANCE, ratio=1.0, least=3, least_success=0.0))
    assert found.integers.tolist() == [5.0, 3.0, 4.0]
    assert found.squared_norm == pytest.approx(0.2183310953369106, rel=1e-9)
    assert found.second == pytest.approx(0.3072725757902666, rel=1e-9)
    assert found.ratio == pytest.approx(0.3072725757902666 / 0.2183310953369106, rel=1e-9)
    assert found.fixed.all()


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_no_integers_in_reach_fit_better_than_the_two_found(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 4))
    values = data.draw(arrays(np.float64, n, elements=st.floats(-50.0, 50.0)))
    root = data.draw(arrays(np.float64, (n, n), elements=st.floats(-2.0, 2.0)))
    covariance = root @ root.T + 0.02 * np.eye(n)
    found = accepted(find_integers(values, covariance, ratio=1.0, least=n, least_success=0.0))
    # Whatever fits as well as the second lies within sqrt(second) standard deviations in every coordinate.
    reach = np.sqrt(found.second * np.diagonal(covariance)) + 1e-9
    low, high = np.ceil(values - reach), np.floor(values + reach)
    assume(math.prod(high - low + 1.0) <= MOST_POINTS)
    points = np.array(list(itertools.product(*(np.arange(a, b + 1.0) for a, b in zip(low, high, strict=True)))))
    norms = np.sort(squared_norms(values, covariance, points))
    close = 1e-9 + 1e-7 * found.second  # of the inverse of a covariance whose condition is below 1e5
    assert found.squared_norm == pytest.approx(norms[0], abs=close)
    own = squared_norms(values, covariance, found.integers[None])
    assert own[0] == pytest.approx(found.squared_norm, abs=close)
    if found.ratio < 10.0:
        assert found.second == pytest.approx(norms[1], abs=close)
    else:
        assert norms[1] >= 10.0 * norms[0] - close


@pytest.mark.parametrize("seed", range(20))
def test_true_integers_of_twenty_double_differences_come_back(seed: int) -> None:
    truth, values, covariance = flown(seed)
    assert (np.rint(values) != truth).any(), "rounding would do"
    found = accepted(find_integers(values, covariance))
    assert found.fixed.all()
    assert (found.integers == truth).all()
    assert found.success > 0.99
    # χ² of 20 values: one of a million is beyond 66.
    assert found.squared_norm < 66.0


def test_success_rate_tells_how_often_independent_values_round_rightly() -> None:
    sigma = np.array([0.1, 0.2, 0.3])
    found = accepted(find_integers(np.array([0.01, 3.0, -2.0]), np.diag(sigma**2), least=3, least_success=0.0))
    rng = np.random.default_rng(0)
    right = (np.abs(rng.normal(0.0, sigma, (100_000, 3))) < 0.5).all(axis=1).mean()
    assert found.success == pytest.approx(right, abs=0.004)  # four standard deviations of the draws


def test_whole_values_are_their_own_integers() -> None:
    found = accepted(find_integers(np.array([1.0, -7.0, 12.0, 4e9]), 1e-3 * np.eye(4)))
    assert found.integers.tolist() == [1.0, -7.0, 12.0, 4e9]
    assert (found.squared_norm, found.ratio) == (0.0, math.inf)


# What is not accepted


def test_integers_that_fit_alike_are_refused() -> None:
    why = refused(find_integers(TEXTBOOK_VALUES, TEXTBOOK_COVARIANCE, least=3, least_success=0.0))
    assert why == "the best two integers fit alike: ratio 1.4"


def test_a_large_covariance_is_refused() -> None:
    _, values, covariance = flown(0)
    assert "success rate" in refused(find_integers(values, 1e4 * covariance))


def test_few_integers_are_refused() -> None:
    assert "too few" in refused(find_integers(np.array([0.01, 0.02, 0.0]), 1e-4 * np.eye(3)))
    assert "too few" in refused(find_integers(np.zeros(0), np.zeros((0, 0)), least=0))


def test_the_least_precise_stay_float() -> None:
    truth, values, covariance = flown(3)
    vague = np.diag([0.3, 0.0, 0.2] + [0.0] * 17)
    found = accepted(find_integers(values + 0.5 * np.diagonal(vague), covariance + 1e3 * vague))
    assert np.flatnonzero(~found.fixed).tolist() == [0, 2]
    assert np.isnan(found.integers[[0, 2]]).all()
    assert (found.integers[found.fixed] == truth[found.fixed]).all()


def test_no_fewer_than_the_least_are_fixed() -> None:
    sigma = np.array([0.02, 0.03, 2.0, 3.0, 4.0])
    values = np.array([0.01, 1.02, 2.4, 3.4, 4.6])
    assert accepted(find_integers(values, np.diag(sigma**2), least=2)).fixed.tolist() == [True, True] + [False] * 3
    assert "success rate" in refused(find_integers(values, np.diag(sigma**2), least=3))


# Bad input

SOUND = 0.01 * np.eye(4)


@pytest.mark.parametrize(
    ("values", "covariance", "why"),
    [
        (np.zeros(4), np.zeros((4, 4)), "variance"),
        (np.zeros(4), -SOUND, "variance"),
        (np.zeros(4), np.ones((4, 4)), "positive definite|conditioned"),
        (np.zeros(4), SOUND - 0.009, "positive definite"),
        (np.zeros(4), SOUND + np.diag([1.0, 1.0, 1.0], 1), "positive definite"),
        (np.zeros(4), SOUND + np.diag([1e-3, 0.0, 0.0], 1), "symmetric"),
        (np.zeros(4), np.diag([1e-12, 1.0, 1.0, 1e6]), "conditioned"),
        (np.zeros(4), np.full((4, 4), np.nan), "finite"),
        (np.zeros(4), np.full((4, 4), 1e308), "variance"),
        (np.zeros(4), SOUND + 1e308 * (1.0 - np.eye(4)), "positive definite"),
        (np.array([0.0, np.nan, 0.0, 0.0]), SOUND, "finite"),
        (np.array([0.0, np.inf, 0.0, 0.0]), SOUND, "finite"),
        (np.array([0.0, 1e15, 0.0, 0.0]), SOUND, "exceeds"),
        (np.zeros(5), SOUND, "do not fit together"),
        (np.zeros((2, 2)), SOUND, "do not fit together"),
        (np.zeros(101), np.eye(101), "too many"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_bad_input_is_refused_with_its_reason(values: F64, covariance: F64, why: str) -> None:
    refusal = refused(find_integers(values, covariance))
    assert any(reason in refusal for reason in why.split("|")), refusal


@settings(max_examples=200, deadline=None)
@given(
    arrays(np.float64, 5, elements=st.floats(width=64)),
    arrays(np.float64, (5, 5), elements=st.floats(width=64)),
    st.floats(),
    st.integers(-3, 8),
)
def test_any_numbers_end_in_integers_or_a_reason(values: F64, covariance: F64, ratio: float, least: int) -> None:
    with np.errstate(all="ignore"):
        for matrix in (covariance, covariance + covariance.T):
            assert isinstance(find_integers(values, matrix, ratio, least), Integers | str)


@settings(max_examples=30, deadline=None)
@given(st.floats(-12.0, 12.0), st.integers(0, 10**6))
def test_values_that_contradict_their_covariance_end_soon(exponent: float, seed: int) -> None:
    """A search without a bound would take hours for these."""
    _, values, covariance = flown(seed % 5, satellites=19)
    noise = np.random.default_rng(seed).uniform(-1e6, 1e6, len(values))
    found = find_integers(values + noise, 10.0**exponent * covariance)
    assert isinstance(found, str) or found.fixed.sum() >= 4
