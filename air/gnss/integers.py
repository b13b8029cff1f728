"""The integers nearest to real-valued carrier ambiguities: LAMBDA, with the search of MLAMBDA.

Sources: P. Teunissen, J. of Geodesy 70, 1995 (decorrelation) and 72, 1998 (success rate); P. de Jonge and C. Tiberius,
The LAMBDA method, Delft 1996; X.-W. Chang, X. Yang and T. Zhou, J. of Geodesy 79, 2005 (MLAMBDA).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from common.arrays import F64, Bool

_MOST_VALUES, _MOST_SWAPS, _MOST_NODES = 100, 10_000, 2_000
"""Some hundreds of swaps and nodes suffice where the values agree with their covariance."""
_SWAP_GAIN = 0.9
"""What a swap must make of a conditional variance at most: nearer to 1, it takes time and hardly helps the search."""
_CLEAR = 10.0
"""Ratio beyond which the second best is not searched for: that search grows exponentially, and changes no decision."""
_LARGEST, _WORST_CONDITION = 1e11, 1e-15
"""cycles, with 1e-5 cycles left to a double; least conditional variance over the largest variance."""


@dataclass(frozen=True, eq=False)
class Integers:
    """`integers` (N,) cycles, NaN where not `fixed` (N,); their `squared_norm`, that of the `second` best, the `ratio`.

    A squared norm is that of float minus integer values, in the metric of the inverse covariance of those fixed. Where
    `ratio` exceeds 10 (or what the caller asked for, if more), `second` is that of a good candidate and not always the
    second best, whose ratio exceeds 10 too. `success` is the probability that bootstrapping finds the right integers if
    the covariance is true: a lower bound of that of integer least squares.
    """

    integers: F64
    squared_norm: float
    second: float
    ratio: float
    success: float
    fixed: Bool


@dataclass(frozen=True, eq=False)
class _Lattice:
    """Decorrelated `values` (K,), their covariance U diag(d) Uᵀ with unit upper U (K, K), the integers z @ `basis`."""

    values: F64
    U: F64
    d: F64
    basis: F64


def find_integers(
    values: F64, covariance: F64, ratio: float = 3.0, least: int = 4, least_success: float = 0.99
) -> Integers | str:
    """Integers nearest to `values` (N,) cycles with `covariance` (N, N) cycles², or why none are accepted.

    Where the second best integers fit less than `ratio` times worse, or the success rate is below `least_success`, the
    ambiguities of largest variance stay float, one by one, while at least `least` remain; the text tells why the last
    were refused. Bad input is refused too, and the time is bounded. Few integers of a wrong covariance can pass by
    chance: their squared norm then mostly exceeds `chi_square_limit`.
    """
    least = max(least, 1)
    if fault := _fault(values, covariance, least):
        return fault
    order = np.argsort(-np.diagonal(covariance), kind="stable")
    near = np.rint(values)
    lattices = _decorrelate((values - near)[order], covariance[np.ix_(order, order)])
    if isinstance(lattices, str):
        return lattices
    refusal = ""
    for lattice in reversed(lattices[least - 1 :]):
        success = _success_rate(lattice.d)
        if not success >= least_success:
            refusal = f"the success rate is too low: {success:.3g}"
        elif (found := _search(lattice, max(ratio, _CLEAR))) is None:
            refusal = f"no best two integers within {_MOST_NODES} nodes"
        else:
            (best, z), (second, _) = found
            clear = second / best if best > 0.0 else math.inf
            if clear >= ratio:
                chosen = order[-len(z) :]
                integers = np.full(len(values), np.nan)
                integers[chosen] = near[chosen] + z @ lattice.basis
                return Integers(integers, best, second, clear, success, np.isfinite(integers))
            refusal = f"the best two integers fit alike: ratio {clear:.2g}"
    return refusal


def _fault(values: F64, covariance: F64, least: int) -> str:
    """What makes the input unusable, empty if nothing."""
    if values.ndim != 1 or covariance.shape != (len(values), len(values)):
        return f"values {values.shape} and covariance {covariance.shape} do not fit together"
    if not least <= len(values) <= _MOST_VALUES:
        return (
            f"too {'few' if len(values) < least else 'many'} ambiguities: {len(values)}, not {least} … {_MOST_VALUES}"
        )
    if not (np.isfinite(values).all() and np.isfinite(covariance).all()):
        return "values or covariance are not finite"
    if (np.abs(values) > _LARGEST).any():
        return f"an ambiguity exceeds {_LARGEST:.0e} cycles"
    variance = np.diagonal(covariance)
    if not ((variance > 1e-20) & (variance < 1e20)).all():
        return "a variance is not within 1e-20 … 1e20 cycles²"
    bound = np.sqrt(np.outer(variance, variance))
    if (np.abs(covariance) > (1.0 + 1e-6) * bound).any():
        return "the covariance is not positive definite"
    return "the covariance is not symmetric" if (np.abs(covariance - covariance.T) > 1e-6 * bound).any() else ""


def _decorrelate(values: F64, covariance: F64) -> list[_Lattice] | str:
    """Lattices of the last 1, 2, … N of `values` (N,), or why there are none.

    Works from the last to the first, so that the lattice of the last K is complete before the next value joins it.
    Source: de Jonge and Tiberius 1996, sections 3.3 and 3.4, with U = Lᵀ, so that rows lie together in memory.
    """
    try:
        root = np.linalg.cholesky(((covariance + covariance.T) / 2.0)[::-1, ::-1])[::-1, ::-1]
    except np.linalg.LinAlgError:
        return "the covariance is not positive definite"
    d, n = np.diagonal(root) ** 2, len(values)
    if d.min() < _WORST_CONDITION * np.diagonal(covariance).max():
        return "the covariance is too badly conditioned"
    U = np.column_stack([root / np.diagonal(root), values])  # the values take part in all row operations
    basis = np.eye(n)
    lattices: list[_Lattice] = []
    swaps, j = 0, n - 2
    while True:
        if j == n - 2 - len(lattices):
            last = slice(j + 1, n)
            lattices.append(_Lattice(U[last, n].copy(), U[last, last].copy(), d[last].copy(), basis[last, last].copy()))
        if j < 0:
            return lattices
        _subtract(U, basis, j, j + 1)
        swapped = d[j] + U[j, j + 1] ** 2 * d[j + 1]
        if swapped < _SWAP_GAIN * d[j + 1] and swaps < _MOST_SWAPS:
            for i in range(j + 2, n):
                _subtract(U, basis, j, i)
            _swap(U, d, basis, j, swapped)
            swaps, j = swaps + 1, min(j + 1, n - 2)
        else:
            j -= 1


def _subtract(U: F64, basis: F64, j: int, i: int) -> None:
    """Takes from value `j` the multiple of value `i` that decorrelates them best (integer Gauss transformation)."""
    if multiple := round(U[j, i]):
        U[j, i:] -= multiple * U[i, i:]
        basis[i] += multiple * basis[j]


def _swap(U: F64, d: F64, basis: F64, j: int, swapped: float) -> None:
    """Swaps values `j` and `j` + 1; `swapped` is the new conditional variance of the latter."""
    shear, share, new_shear = U[j, j + 1], d[j] / swapped, d[j + 1] * U[j, j + 1] / swapped
    d[j], d[j + 1] = share * d[j + 1], swapped
    before, after = U[:j, j].copy(), U[:j, j + 1].copy()
    U[:j, j], U[:j, j + 1] = after - shear * before, share * before + new_shear * after
    U[j, j + 1] = new_shear
    for rows in (U[j : j + 2, j + 2 :], basis[j : j + 2]):
        rows[:] = rows[::-1].copy()


def _success_rate(d: F64) -> float:
    """Probability that bootstrapping finds the right integers (Teunissen 1998) with conditional variances `d` (K,)."""
    return math.prod(math.erf(1.0 / math.sqrt(8.0 * variance)) for variance in d.tolist())


def _search(lattice: _Lattice, clear: float) -> list[tuple[float, F64]] | None:
    """Squared norm and integers (K,) of the best two points, None where the search takes too long.

    Depth first from the last value to the first, the nearest integers first; the ellipsoid shrinks to the second best
    point, or to `clear` times the best squared norm. Source: Chang, Yang and Zhou 2005, section 4.
    """
    n, d = len(lattice.d), lattice.d.tolist()
    z, step, residuals = np.zeros(n), np.zeros(n), np.zeros(n)
    centre, above = np.zeros(n), [0.0] * n
    best: list[tuple[float, F64]] = []
    radius, level, entered = math.inf, n - 1, True
    for _ in range(_MOST_NODES):
        if entered:
            centre[level] = lattice.values[level] - lattice.U[level, level + 1 :] @ residuals[level + 1 :]
            z[level] = np.rint(centre[level])
            step[level] = math.copysign(1.0, centre[level] - z[level])
        else:
            z[level] += step[level]
            step[level] = -step[level] - math.copysign(1.0, step[level])
        residuals[level] = centre[level] - z[level]
        norm = above[level] + float(residuals[level]) ** 2 / d[level]
        entered = norm < radius and level > 0
        if entered:
            level -= 1
            above[level] = norm
        elif norm < radius:
            best = sorted([*best, (norm, z.copy())], key=lambda point: point[0])[:2]
            radius = min(best[1][0], clear * best[0][0]) if len(best) == 2 else math.inf
        elif (level := level + 1) == n:
            return best
    return None
