"""Uniform quintic B-splines: four times continuously differentiable, local, with exact derivatives.

Source: K. Qin, General matrix representations for B-splines, The Visual Computer 16 (2000), equation 9.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, factorial

import numpy as np

from common.arrays import F64

DEGREE = 5
ORDERS = 3
"""Value, first and second derivative."""


@dataclass(frozen=True, eq=False)
class Spline:
    """A curve of time from control points (K, C) that are `step_s` apart; the first belongs to the time `first_s`."""

    control: F64
    step_s: float
    first_s: float

    @property
    def begin_s(self) -> float:
        """From when on the curve is defined, s."""
        return self.first_s + DEGREE // 2 * self.step_s

    @property
    def end_s(self) -> float:
        """Until when the curve is defined, s."""
        return self.first_s + (len(self.control) - 1 - DEGREE // 2 - 1) * self.step_s

    def at(self, t_s: F64) -> F64:
        """Value, first and second derivative (N, 3, C) at times (N,) s.

        Raises ValueError for times beyond the curve.
        """
        if t_s.size and not (t_s.min() >= self.begin_s and t_s.max() <= self.end_s):
            raise ValueError(f"the curve reaches from {self.begin_s} to {self.end_s} s")
        x = (t_s - self.begin_s) / self.step_s
        first = np.minimum(np.floor(x).astype(np.int64), len(self.control) - DEGREE - 1)
        powers = (x - first)[:, None] ** np.arange(DEGREE + 1)
        # One small product per time: the result for a time does not depend on the others asked with it.
        weights = (powers[:, None] @ _WEIGHTS).reshape(len(x), ORDERS, DEGREE + 1)
        values = weights @ self.control[first[:, None] + np.arange(DEGREE + 1)]
        return np.asarray(values / self.step_s ** np.arange(float(ORDERS))[:, None])


def _weights() -> F64:
    """Weights of the control points as polynomials: (powers, derivatives times points)."""
    k = DEGREE
    value = np.array(
        [
            [
                comb(k, power)
                * sum((-1) ** (s - j) * comb(k + 1, s - j) * (k - s) ** (k - power) for s in range(j, k + 1))
                for j in range(k + 1)
            ]
            for power in range(k + 1)
        ]
    ) / factorial(k)
    slope = np.diag(np.arange(1.0, k + 1), 1)
    return np.hstack([value, slope @ value, slope @ slope @ value])


_WEIGHTS = _weights()
