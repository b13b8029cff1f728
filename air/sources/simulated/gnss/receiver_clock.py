"""The clock of a simulated GNSS receiver: a small oscillator, corrected by whole milliseconds."""

from __future__ import annotations

import numpy as np

from common.arrays import F64

_WALK = 3e-10
"""Random walk of the oscillator's relative frequency in a second; that of a TCXO, some 0.1 m/s (Misra and Enge)."""
_BLOCK = 64


class ReceiverClock:
    """How far a receiver's oscillator is ahead of GPST: `bias` s and `drift` s/s at any times (N,) s.

    Its frequency is linear between seconds, where a random walk sets it, so that the bias is exact and smooth. One
    number a second is kept.
    """

    def __init__(self, walk: float, drift_ppm: float, seed: int, part: int):
        self._key = (seed, part)
        self._walk = walk * _WALK
        first = np.random.default_rng([seed, part, 0])
        on = walk > 0 or drift_ppm > 0
        self._bias = np.array([on * first.uniform(-3e-4, 3e-4)])
        self._drift = np.array([first.uniform(-1e-6, 1e-6) * drift_ppm])

    def at(self, t_s: F64) -> tuple[F64, F64]:
        """Bias (N,) s and drift (N,) s/s at times (N,) s, from −1 s on."""
        j = np.maximum(np.floor(t_s).astype(int), 0)
        while len(self._bias) < j.max(initial=0) + 2:
            self._extend()
        x = t_s - j
        f0, f1 = self._drift[j], self._drift[j + 1]
        return self._bias[j] + x * f0 + 0.5 * x**2 * (f1 - f0), f0 + x * (f1 - f0)

    def time_of(self, shown_s: F64) -> F64:
        """GPST (N,) s at which the uncorrected clock shows these times."""
        t = shown_s
        for _ in range(4):
            t = shown_s - self.at(t)[0]
        return t

    def _extend(self) -> None:
        rng = np.random.default_rng([*self._key, 1 + len(self._bias) // _BLOCK])
        drift = self._drift[-1] + np.cumsum(self._walk * rng.standard_normal(_BLOCK))
        before = np.concatenate([self._drift[-1:], drift[:-1]])
        self._bias = np.concatenate([self._bias, self._bias[-1] + np.cumsum(0.5 * (before + drift))])
        self._drift = np.concatenate([self._drift, drift])
