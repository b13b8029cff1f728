"""Seeded random textures: fractal noise over a grid, and periodic fine detail."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from common.arrays import F32


def fractal(
    rng: np.random.Generator, shape: tuple[int, int], cell: float, octaves: Sequence[tuple[float, float]]
) -> F32:
    """Smooth noise (h, w) float32 on a grid of `cell` m: the sum of octaves (wavelength m, standard deviation).

    Each octave is white noise on a grid of half its wavelength, interpolated with bicubic splines.
    """
    height, width = shape
    total = np.zeros(shape, np.float32)
    for wavelength, deviation in octaves:
        spacing = wavelength / (2.0 * cell)
        coarse = rng.standard_normal((int(height / spacing) + 5, int(width / spacing) + 5), np.float32)
        # Bicubic interpolation of white noise keeps about 0.75 of its deviation.
        scale = np.array([[1 / spacing, 0, 1.5], [0, 1 / spacing, 1.5]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        total += cv2.warpAffine(coarse, scale, (width, height), flags=flags) * np.float32(deviation / 0.75)
    return total


def periodic_detail(rng: np.random.Generator, size: int, shortest: float, longest: float) -> F32:
    """Periodic noise (size, size) float32 of zero mean and unit deviation, wavelengths in texels, amplitude ∝ 1/f."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    frequency[0, 0] = 1.0
    gain = 1.0 / frequency / (1.0 + (1.0 / (longest * frequency)) ** 4) / (1.0 + (shortest * frequency) ** 6)
    gain[0, 0] = 0.0
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * gain, (size, size))
    return np.asarray((noise - noise.mean()) / noise.std(), np.float32)


def smoothstep(low: float, high: float, x: F32) -> F32:
    """0 below `low`, 1 above `high`, smooth between; same shape as `x`."""
    t = np.clip((x - np.float32(low)) / np.float32(high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)
