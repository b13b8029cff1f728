"""Dense matching against images whose disparities are known exactly."""

import numpy as np
import pytest

from air.mapping.matching import match

SHAPE = (240, 320)
EVERYWHERE = np.ones(SHAPE, bool)
METHODS = ["block", "semi-global"]


def texture(u, v, seed=0):
    """Gray values of a smooth random texture at any real coordinates: a sum of waves, none shorter than 5 px."""
    rng = np.random.default_rng(seed)
    waves = 2 * np.pi / rng.uniform(5, 40, 60)
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 60))
    total = np.zeros(np.broadcast(u, v).shape)
    for k, a, p in zip(waves, angle, phase, strict=True):
        total += np.sin(k * (np.cos(a) * u + np.sin(a) * v) + p)
    return 128 + 9 * total


def pair(disparity, gain=1.0, offset=0.0):
    """Left and right image of a surface whose disparity (h, w) is given on the pixels of the left one."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    rng = np.random.default_rng(1)
    left = texture(u - disparity, v) + rng.normal(0, 1, SHAPE)
    right = gain * (texture(u, v) + rng.normal(0, 1, SHAPE)) + offset
    return [np.clip(np.rint(i), 0, 255).astype(np.uint8) for i in (left, right)]


def waves():
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    return 4 * np.sin(u / 60) + 3 * np.cos(v / 45) + 0.02 * u


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.7, 25.0)])
def test_smooth_surface_is_matched_to_a_twentieth_of_a_pixel(method, gain, offset):
    truth = waves()
    found = match(*pair(truth, gain, offset), EVERYWHERE, EVERYWHERE, -20, 30, method)
    inner = np.s_[20:-20, 40:-40]
    error = np.abs(found.disparity - truth)[inner]
    assert np.mean(np.isfinite(error)) > 0.97
    assert np.nanmedian(error) < 0.05
    assert np.nanquantile(error, 0.99) < 0.3


def test_predicted_sigma_fits_the_errors():
    truth = waves()
    found = match(*pair(truth), EVERYWHERE, EVERYWHERE, -20, 30)
    ratio = (np.abs(found.disparity - truth) / found.sigma)[20:-20, 40:-40]
    # The median of |normal| is 0.67; the floor of sigma makes the prediction cautious.
    assert 0.1 < np.nanmedian(ratio) < 1.0
    assert np.nanmean(ratio > 3) < 0.02


@pytest.mark.parametrize("method", METHODS)
def test_step_keeps_its_place_and_nothing_floats_between_the_levels(method):
    u = np.broadcast_to(np.arange(SHAPE[1], dtype=float), SHAPE)
    # The left image shows a plateau (nearer, disparity 12) over columns 150 to 230; what it hides is not rendered.
    truth = np.where((u > 150) & (u < 230), 12.0, 0.0)
    found = match(*pair(truth), EVERYWHERE, EVERYWHERE, -10, 25, method)
    error = np.abs(found.disparity - truth)[20:-20, 30:-30]
    near_edge = np.minimum(np.abs(u - 150), np.abs(u - 230))[20:-20, 30:-30] < 5
    known = np.isfinite(error)
    assert known[~near_edge].mean() > 0.85
    assert (error[known & ~near_edge] > 1).mean() < 0.01
    between = (found.disparity > 2) & (found.disparity < 10)
    assert between.mean() < 0.005


@pytest.mark.parametrize("method", METHODS)
def test_images_without_texture_or_without_anything_in_common_give_nothing(method):
    flat = np.full(SHAPE, 90, np.uint8)
    assert not np.isfinite(match(flat, flat, EVERYWHERE, EVERYWHERE, -10, 20, method).disparity).any()
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    one, other = (np.clip(texture(u, v, seed), 0, 255).astype(np.uint8) for seed in (5, 6))
    found = match(one, other, EVERYWHERE, EVERYWHERE, -20, 20, method)
    assert np.isfinite(found.disparity).mean() < 0.03


def test_pixels_that_a_photo_does_not_cover_are_left_out():
    covered = EVERYWHERE.copy()
    covered[:, 200:] = False
    found = match(*pair(waves()), covered, EVERYWHERE, -20, 30)
    assert not np.isfinite(found.disparity[:, 200:]).any()
    assert np.isfinite(found.disparity[30:-30, 60:180]).mean() > 0.95
