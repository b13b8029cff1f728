"""Errors that change slowly."""

from __future__ import annotations

import numpy as np

from common.arrays import F64


class Swing:
    """An error that swings slowly as a sine, with random period and phase, and `size` as its standard deviation."""

    def __init__(
        self, rng: np.random.Generator, shape: tuple[int, ...], size: float | F64, shortest_s: float, longest_s: float
    ):
        self._omega = 2 * np.pi / rng.uniform(shortest_s, longest_s, shape)
        self._phase = rng.uniform(0.0, 2 * np.pi, shape)
        self._size = size * np.sqrt(2.0)

    def at(self, t_s: F64) -> F64:
        """The error at times (…), of the swing's own shape behind theirs."""
        return np.asarray(self._size * np.sin(np.multiply.outer(t_s, self._omega) + self._phase))

    def rate(self, t_s: F64) -> F64:
        """How fast it changes, a second, at times (…)."""
        return np.asarray(self._size * self._omega * np.cos(np.multiply.outer(t_s, self._omega) + self._phase))
