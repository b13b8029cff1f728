"""Which features of two photos show the same point: descriptors first, then one epipolar geometry for all."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from air.alignment.prepare import Features
from air.alignment.settings import AlignmentSettings
from common.arrays import F32, I64, Bool

USAC_CONFIDENCE = 0.999
USAC_ITERATIONS = 3000
MIN_FOR_GEOMETRY = 8
"""Matches that determine a fundamental matrix."""


def match(a: Features, b: Features, settings: AlignmentSettings, scale: float) -> I64:
    """Verified matches (M, 2) as feature indices of a and b; empty when there are fewer than `settings.min_matches`.

    The strongest features come first; all of them only where those give some, but too few. `scale` is full-image px
    per working px.
    """
    found = _verified(a.strongest(settings.quick_features), b.strongest(settings.quick_features), settings, scale)
    if settings.promising_matches <= len(found) < settings.enough_matches:
        found = _verified(a, b, settings, scale)
    return found if len(found) >= settings.min_matches else found[:0]


def _verified(a: Features, b: Features, settings: AlignmentSettings, scale: float) -> I64:
    candidates = mutual_nearest(a, b, settings.ratio)
    if len(candidates) < MIN_FOR_GEOMETRY:
        return candidates[:0]
    return candidates[_epipolar_inliers(a, b, candidates, settings.verify_px * scale)]


def mutual_nearest(a: Features, b: Features, ratio: float) -> I64:
    """Pairs (M, 2) that are each other's nearest by descriptor and clearly nearer than the second (Lowe's ratio)."""
    if len(a.uv) < 2 or len(b.uv) < 2:
        return np.zeros((0, 2), np.int64)
    nearest, best, second, nearest_back = _nearest(a.descriptors @ b.descriptors.T)
    rows = np.arange(len(a.uv))
    good = np.flatnonzero((1.0 - best < ratio**2 * (1.0 - second)) & (nearest_back[nearest] == rows))
    return np.stack([good, nearest[good]], axis=1)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _nearest(similarity: F32) -> tuple[I64, F32, F32, I64]:
    """Of a matrix (N, M) in one pass: each row's best column, its value and the second best; each column's best row."""
    n, m = similarity.shape
    nearest, nearest_back = np.zeros(n, np.int64), np.zeros(m, np.int64)
    best, second = np.empty(n, np.float32), np.empty(n, np.float32)
    best_back = np.full(m, np.float32(-2.0), np.float32)
    for i in range(n):
        first = next_best = np.float32(-2.0)
        for j in range(m):
            value = similarity[i, j]
            if value > next_best:
                if value > first:
                    next_best, first, nearest[i] = first, value, j
                else:
                    next_best = value
            if value > best_back[j]:
                best_back[j], nearest_back[j] = value, i
        best[i], second[i] = first, next_best
    return nearest, best, second, nearest_back


def _epipolar_inliers(a: Features, b: Features, pairs: I64, threshold_px: float) -> Bool:
    """Mask of the pairs that one fundamental matrix explains. It needs no intrinsics, which are only guessed yet."""
    cv2.setRNGSeed(0)
    _, mask = cv2.findFundamentalMat(
        a.uv[pairs[:, 0]], b.uv[pairs[:, 1]], cv2.USAC_MAGSAC, threshold_px, USAC_CONFIDENCE, USAC_ITERATIONS
    )
    return np.zeros(len(pairs), bool) if mask is None else mask.ravel().astype(bool)
