"""Normal equations on ground that is bent: every patch of it may be off by a plane of its own.

A photogrammetric map is bent by centimetres to decimetres over tens of metres, so the residuals of one patch go up
and down together. Counted as independent they would outweigh, by their number, the edges and bumps that tell where
the map lies and how large it is: the fit would shrink or turn a map to make room for its bends.
"""

from __future__ import annotations

import numpy as np

from common.arrays import F64, I64, AnyFloat

PATCH = 10.0
"""Side of a patch, m: shorter than the bends of a block, longer than what stands on the ground."""
_MIN_WEIGHT = 30.0
_TO_SIGMA = 1.4826


def normal_equations(J: F64, residual: F64, weight: F64, xy: F64) -> tuple[F64, F64]:
    """Matrix (K, K) and right-hand side (K,) for the update that the residuals ask for, patches' planes eliminated.

    `J` (N, K) is the derivative of `residual` (N,) m at the places `xy` (N, 2) m, `weight` (N,) from 0 to 1. The
    model is `residual = −J δ + A b + noise` with a plane `b` for each patch; noise and planes get the spread that the
    residuals show. On ground without bends the planes' spread is zero and this is ordinary least squares.
    Source: Laird and Ware, Random-effects models for longitudinal data, Biometrics 38(4), 1982.
    """
    patch, A = _patches(xy)
    wA = weight[:, None] * A
    AtA = _sum_by(patch, wA[:, :, None] * A[:, None, :])
    AtJ = _sum_by(patch, wA[:, :, None] * np.column_stack([J, residual])[:, None, :])
    plane = np.linalg.solve(AtA + 1e-3 * np.eye(3), AtJ[:, :, -1:])[:, :, 0]
    filled = AtA[:, 0, 0] > _MIN_WEIGHT
    noise = _spread((residual - np.einsum("ni,ni->n", A, plane[patch]))[weight > 0])
    bend = _spread(plane[filled]) if filled.any() else np.zeros(3)
    gain = np.linalg.inv(AtA + np.diag(noise**2 / np.maximum(bend, 1e-4) ** 2))
    Jw = np.column_stack([J, residual]) * weight[:, None]
    total = Jw.T @ np.column_stack([J, residual]) - np.einsum("gai,gab,gbj->ij", AtJ, gain, AtJ)
    return total[:-1, :-1], -total[:-1, -1]


def _patches(xy: F64) -> tuple[I64, F64]:
    """The patch of each place (N,) and the basis of its planes there (N, 3): one, and −1 to 1 across the patch."""
    corner = np.floor(xy / PATCH)
    _, patch = np.unique(corner @ np.array([2.0**26, 1.0]), return_inverse=True)
    return patch.astype(np.int64), np.column_stack([np.ones(len(xy)), 2.0 * (xy / PATCH - corner) - 1.0])


def _sum_by(patch: I64, values: AnyFloat) -> F64:
    """Sums (G, …) of values (N, …) over each patch."""
    columns = values.reshape(len(values), -1).T
    sums: F64 = np.stack([np.bincount(patch, column) for column in columns], axis=1)
    return sums.reshape(-1, *values.shape[1:])


def _spread(values: AnyFloat) -> F64:
    """Standard deviation around zero of values (N, …) with outliers, by column."""
    return np.asarray(_TO_SIGMA * np.median(np.abs(values), axis=0))
