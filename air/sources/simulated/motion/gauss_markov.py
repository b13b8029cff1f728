"""Errors that wander: first-order Gauss–Markov processes."""

from __future__ import annotations

import numpy as np

from common.arrays import F64

_FINE = 10
"""Values per correlation time, at least; between them it is linear."""
_COARSE_S = 1.0
_SPARE_S = 5.0


class GaussMarkov:
    """`width` independent processes with standard deviation `sigma` and correlation time `time_s`, over a flight."""

    def __init__(self, rng: np.random.Generator, sigma: float, time_s: float, duration_s: float, width: int = 1):
        step_s = min(_COARSE_S, time_s / _FINE)
        self._t_s = np.arange(-_SPARE_S, duration_s + _SPARE_S + step_s, step_s)
        white = rng.standard_normal((len(self._t_s), width))
        kept = np.exp(-step_s / time_s)
        values = np.empty_like(white)
        values[0] = white[0]
        for k in range(1, len(values)):
            values[k] = kept * values[k - 1] + np.sqrt(1 - kept**2) * white[k]
        self._values = sigma * values

    def at(self, t_s: F64) -> F64:
        """Values (N, width) at times (N,) s since the flight's start."""
        return np.stack([np.interp(t_s, self._t_s, column) for column in self._values.T], axis=1)
