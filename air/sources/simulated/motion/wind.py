"""Wind near the ground: a mean profile, Dryden turbulence and discrete gusts.

Source: MIL-F-8785C (1980), section 3.7: 3.7.2.2 Dryden spectra, 3.7.3 low altitude, 3.7.2.3 one-minus-cosine gusts.
"""

from __future__ import annotations

import itertools

import numpy as np

from common.arrays import F64

FOOT = 0.3048
ROUGHNESS = 0.15 * FOOT
"""Of ground as in landing and take-off areas, m."""
GUST_EVERY_S = 30.0
GUST_S = (3.0, 8.0)
"""How long a gust lasts."""


def mean_wind(wind: float, height: F64) -> F64:
    """Speed (N,) m/s of the mean wind at heights (N,) m above ground, from that at 20 ft."""
    return np.asarray(wind * np.log(np.maximum(height, 3 * FOOT) / ROUGHNESS) / np.log(20 * FOOT / ROUGHNESS))


def turbulence(rng: np.random.Generator, wind: float, height: float, airspeed: float, step_s: float, count: int) -> F64:
    """Dryden turbulence (N, 3) m/s along the mean wind, to its left and up, as met at a height m and an airspeed m/s.

    `wind` m/s is the mean wind at 20 ft. Height and airspeed shape the spectrum and are taken as constant.
    """
    feet = min(max(height / FOOT, 10.0), 1000.0)
    fraction = 0.177 + 0.000823 * feet
    sigma_w, length_w = 0.1 * wind, feet * FOOT
    sigma_u, length_u = sigma_w / fraction**0.4, length_w / fraction**1.2
    white = rng.standard_normal((count, 3))
    along = _longitudinal(white[:, 0], length_u / airspeed, step_s)
    left = _transverse(white[:, 1], length_u / airspeed, step_s)
    up = _transverse(white[:, 2], length_w / airspeed, step_s)
    return np.stack([sigma_u * along, sigma_u * left, sigma_w * up], axis=1)


def gusts(rng: np.random.Generator, size: float, step_s: float, count: int) -> F64:
    """Gusts (N, 3) m/s of up to `size` in random directions, one after another: one minus cosine, two a minute."""
    t, total = np.arange(count) * step_s, np.zeros((count, 3))
    at = 0.0
    while (at := at + float(rng.exponential(GUST_EVERY_S))) < count * step_s:
        seconds, peak, azimuth = rng.uniform(*GUST_S), size * rng.uniform(0.4, 1.0), rng.uniform(0, 2 * np.pi)
        direction = np.array([np.cos(azimuth), np.sin(azimuth), rng.uniform(-0.3, 0.3)])
        during = (t > at) & (t < at + seconds)
        total[during] = peak / 2 * (1 - np.cos(2 * np.pi * (t[during] - at) / seconds))[:, None] * direction
        at += seconds
    return total


def _longitudinal(white: F64, time_s: float, step_s: float) -> F64:
    """Noise (N,) of unit variance and spectrum 1 / (1 + T²ω²)."""
    a = np.exp(-step_s / time_s)
    drive = np.sqrt(1 - a * a) * white
    drive[0] = white[0]  # in its steady state from the first value on
    return _first_order(a, drive)


def _transverse(white: F64, time_s: float, step_s: float) -> F64:
    """Noise (N,) of unit variance and spectrum (1 + 3T²ω²) / (1 + T²ω²)²."""
    once = _longitudinal(white, time_s, step_s) / np.sqrt(2)
    a = np.exp(-step_s / time_s)
    twice = _first_order(a, (1 - a) * (once + np.concatenate([once[:1], once[:-1]])) / 2)
    return np.asarray(np.sqrt(3) * once + (1 - np.sqrt(3)) * twice)


def _first_order(a: float, drive: F64) -> F64:
    """y[k] = a y[k−1] + drive[k]."""
    return np.fromiter(itertools.accumulate(drive.tolist(), lambda y, x: a * y + x), float, len(drive))
