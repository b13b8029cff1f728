"""Registration against known transformations, on synthetic ground and on a real cloud."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evaluation_ground import bent, degraded, distortion, ground, meadow
from evo.core.geometry import umeyama_alignment
from hypothesis import given
from hypothesis import strategies as st

from common.errors import EvaluationError
from ground.evaluation.clouds import read_cloud
from ground.evaluation.registration import register
from ground.evaluation.similarity import Similarity, umeyama


def assert_undone(T: Similarity, applied: Similarity, where: np.ndarray, position: float, scale: float) -> None:
    """The registration undoes what was applied: where the cloud is (m), by angle (0.01°) and by scale."""
    left = T @ applied
    assert np.linalg.norm(left.apply(where) - where) < position
    assert left.rotation_deg < 0.01
    assert abs(left.scale - 1.0) < scale


@pytest.mark.parametrize("seed", range(3))
def test_rigid_registration_finds_the_truth_despite_outliers_and_partial_overlap(seed: int) -> None:
    target = ground(150_000, seed=100)
    source = ground(60_000, seed=seed)
    source = source[source[:, 0] < 30.0]
    applied = distortion(seed)
    T = register(degraded(applied.apply(source), seed), target[target[:, 0] > -50.0], with_scale=False)
    assert_undone(T, applied, source.mean(axis=0), position=0.005, scale=1e-12)


@pytest.mark.parametrize(("seed", "scale"), [(3, 0.95), (4, 1.05), (5, 1.0)])
def test_similarity_registration_finds_the_scale_too(seed: int, scale: float) -> None:
    target = ground(150_000, seed=100)
    source = ground(60_000, seed=seed)
    source = source[source[:, 0] < 30.0]
    applied = distortion(seed, scale)
    T = register(degraded(applied.apply(source), seed), target[target[:, 0] > -50.0], with_scale=True)
    assert_undone(T, applied, source.mean(axis=0), position=0.005, scale=2e-4)


@pytest.mark.parametrize(("scale", "amplitude"), [(0.97, 0.3), (1.0, 0.3), (1.04, -0.3)])
def test_bends_of_a_flat_site_are_not_mistaken_for_a_scale(scale: float, amplitude: float) -> None:
    """Shrinking or shifting a slope evens out its bends, but only its clods, kerbs and rims tell where it lies."""
    target = meadow(60_000, seed=100, trees=False)
    source = bent(meadow(40_000, seed=1), amplitude)
    source = source[source[:, 0] < 40.0]
    applied = distortion(3, scale)
    cloud = degraded(applied.apply(source), 1, outliers=0.05)
    for with_scale in (True, False) if scale == 1.0 else (True,):
        T = register(cloud, target, with_scale)
        left = T @ applied
        moved = left.apply(source.mean(axis=0)) - source.mean(axis=0)
        assert np.linalg.norm(moved[:2]) < 0.06
        # The bends themselves have a mean of 4 cm and a tilt of less than 0.1° on the part that is left.
        assert abs(moved[2]) < 0.08
        assert left.rotation_deg < 0.15
        assert abs(left.scale - 1.0) < 2e-3


def test_utm_coordinates_cost_no_accuracy() -> None:
    far = np.array([576_700.0, 5_188_000.0, 160.0])
    source = ground(60_000, seed=1) + far
    applied = distortion(1, about=far)
    T = register(applied.apply(source), ground(150_000, seed=100) + far, with_scale=False)
    assert_undone(T, applied, source.mean(axis=0), position=0.005, scale=1e-12)


def test_offset_in_height_between_ellipsoid_and_geoid_is_found() -> None:
    source = ground(40_000, seed=1)
    applied = Similarity.translation(np.array([4.0, -3.0, 33.0]))
    T = register(applied.apply(source), ground(100_000, seed=100), with_scale=False)
    assert_undone(T, applied, source.mean(axis=0), position=0.005, scale=1e-12)


def test_registration_is_deterministic() -> None:
    source, target = degraded(ground(20_000, seed=1), 1), ground(50_000, seed=2)
    first, second = (register(source, target, with_scale=True) for _ in range(2))
    assert (first.scale, first.R.tolist(), first.t.tolist()) == (second.scale, second.R.tolist(), second.t.tolist())


def test_clouds_of_different_places_are_refused() -> None:
    source = ground(5_000)
    with pytest.raises(EvaluationError, match="same place"):
        register(source + np.array([1000.0, 0.0, 0.0]), source, with_scale=False)


@pytest.mark.parametrize("scale", [1.0, 1.03])
def test_real_cloud_is_laid_back_on_itself(real_data: Callable[[str], Path], scale: float) -> None:
    target = read_cloud(real_data("brighton_beach") / "model.laz").points
    west = target[(target[:, 0] < np.quantile(target[:, 0], 0.8)) & (np.arange(len(target)) % 3 == 0)]
    applied = distortion(7, scale, about=target.mean(axis=0))
    T = register(degraded(applied.apply(west), 7), target, with_scale=scale != 1.0)
    # The stones of the beach are finer than the points: noise finds a nearer neighbour on them than its own.
    assert_undone(T, applied, west.mean(axis=0), position=0.008, scale=3e-4)


points = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).normal(scale=50.0, size=(30, 3)))


@given(points, st.integers(0, 1000), st.floats(0.5, 2.0), st.booleans())
def test_umeyama_agrees_with_evo(source: np.ndarray, seed: int, scale: float, with_scale: bool) -> None:
    noise = np.random.default_rng(seed).normal(size=source.shape)
    target = distortion(seed, scale).apply(source) + noise
    T = umeyama(source, target, with_scale)
    R, t, c = umeyama_alignment(source.T, target.T, with_scale)
    assert pytest.approx(R, abs=1e-9) == T.R
    assert pytest.approx(t, abs=1e-9) == T.t
    assert pytest.approx(c, abs=1e-9) == T.scale


@given(points, st.integers(0, 1000), st.floats(0.5, 2.0))
def test_similarity_inverse_undoes(source: np.ndarray, seed: int, scale: float) -> None:
    T = distortion(seed, scale)
    assert T.inverse().apply(T.apply(source)) == pytest.approx(source, abs=1e-9)
    assert (T.inverse() @ T).apply(source) == pytest.approx(source, abs=1e-9)
