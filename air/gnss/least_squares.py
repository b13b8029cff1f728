"""Weighted least squares, and what its residuals tell.

Sources: Teunissen and Kleusberg, GPS for Geodesy, chapter 7 (w-test); Wilson and Hilferty, 1931 (χ²).
"""

from __future__ import annotations

import numpy as np

from common.arrays import F64

_NORMAL_QUANTILE = 3.0902
"""That good residuals exceed once in a thousand times."""


def cofactor_of(H: F64, sigma: F64) -> F64:
    """Covariance (U, U) of the unknowns of rows `H` (N, U) with `sigma` (N,).

    Raises LinAlgError where the rows do not determine the unknowns.
    """
    return np.asarray(np.linalg.inv(H.T @ (H / sigma[:, None] ** 2)), np.float64)


def worst_residual(v: F64, sigma: F64, H: F64, cofactor: F64) -> int | None:
    """Index of the residual whose removal lowers χ² most (w-test), None where none can be checked by others."""
    left = sigma**2 - np.einsum("ij,jk,ik->i", H, cofactor, H)
    checked = left > 1e-6 * sigma**2
    if not checked.any():
        return None
    return int(np.argmax(np.where(checked, v**2 / np.where(checked, left, 1.0), -1.0)))


def chi_square_limit(degrees: int) -> float:
    """What χ² exceeds once in a thousand times; within 3 %."""
    spread = 2.0 / (9.0 * degrees)
    return float(degrees * (1.0 - spread + _NORMAL_QUANTILE * np.sqrt(spread)) ** 3)
