"""Inner loops of matching, compiled: they read one image along its rows at fractional positions."""

from __future__ import annotations

import numpy as np
from numba import njit

from common.arrays import F32

# Where the right image ends there is nothing to compare with: as bad as two unrelated windows.
OUTSIDE = np.float32(2.0)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def squared_difference(left: F32, right: F32, disparity: F32) -> F32:
    """(L(u, v) − R(u − d(u, v), v))² as (h, w) float32, R interpolated linearly."""
    h, w = left.shape
    out = np.empty((h, w), np.float32)
    for v in range(h):
        for u in range(w):
            x = np.float32(u) - disparity[v, u]
            i = int(np.floor(x))
            if i < 0 or i >= w - 1:
                out[v, u] = OUTSIDE
                continue
            t = x - np.float32(i)
            r = left[v, u] - (right[v, i] + t * (right[v, i + 1] - right[v, i]))
            out[v, u] = r * r
    return out


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def normal_equations(left: F32, right: F32, disparity: F32) -> tuple[F32, F32, F32]:
    """g², g·r and r² as (h, w) float32: residual r = L − R(u − d) and its derivative g by d, R interpolated cubically.

    Catmull–Rom, so that value and derivative belong to one smooth function and no disparity is preferred.
    """
    h, w = left.shape
    gg = np.zeros((h, w), np.float32)
    gr = np.zeros((h, w), np.float32)
    rr = np.full((h, w), OUTSIDE, np.float32)
    half = np.float32(0.5)
    for v in range(h):
        for u in range(w):
            x = np.float32(u) - disparity[v, u]
            i = int(np.floor(x))
            if i < 1 or i >= w - 2:
                continue
            t = x - np.float32(i)
            a, b, c, d = right[v, i - 1], right[v, i], right[v, i + 1], right[v, i + 2]
            k1 = half * (c - a)
            k2 = a - np.float32(2.5) * b + np.float32(2.0) * c - half * d
            k3 = half * (d - a) + np.float32(1.5) * (b - c)
            r = left[v, u] - (b + t * (k1 + t * (k2 + t * k3)))
            g = k1 + t * (np.float32(2.0) * k2 + np.float32(3.0) * t * k3)
            gg[v, u] = g * g
            gr[v, u] = g * r
            rr[v, u] = r * r
    return gg, gr, rr
