"""Standard deviations that believe no model: leave a part out, fit again, see how much it matters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TypeVar

import numpy as np

from common.arrays import F64

T = TypeVar("T")


def jackknife(parts: Sequence[T], fit: Callable[[Sequence[T]], F64]) -> F64:
    """Standard deviation (P,) of what `fit` gives (P,), from leaving out one of the parts at a time.

    Errors may be correlated within a part as they like, not between parts. Source: Efron & Tibshirani, An
    Introduction to the Bootstrap, 1993, section 11.2.
    """
    n = len(parts)
    fits = np.array([fit([part for k, part in enumerate(parts) if k != i]) for i in range(n)])
    return np.asarray(np.sqrt((n - 1) / n * np.sum((fits - fits.mean(axis=0)) ** 2, axis=0)))


def groups(items: Sequence[T], count: int) -> list[list[T]]:
    """Items in order, in at most `count` groups of nearly equal size."""
    count = min(count, len(items))
    cuts = [len(items) * i // count for i in range(count + 1)]
    return [list(items[a:b]) for a, b in pairwise(cuts)]
