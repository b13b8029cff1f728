"""The poses of a whole flight in little memory: 128 bytes each, where messages take a kilobyte."""

from __future__ import annotations

from array import array
from collections.abc import Iterator

import numpy as np

from common.arrays import F64, I64
from common.se3 import SE3

WIDTH = 15
"""Numbers of a pose: rotation matrix, position, sigma."""


class PoseLog:
    """Poses in the order in which they were added."""

    def __init__(self) -> None:
        self._t_ns, self._numbers = array("q"), array("d")

    def add(self, t_ns: int, T: SE3, sigma: F64) -> None:
        """Keep a pose with the sigma (3,) m of its position."""
        self._t_ns.append(t_ns)
        for part in (T.R.ravel(), T.t, sigma):
            self._numbers.extend(part.tolist())

    def __len__(self) -> int:
        return len(self._t_ns)

    def __iter__(self) -> Iterator[SE3]:
        for row in range(0, len(self._numbers), WIDTH):
            numbers = np.array(self._numbers[row : row + WIDTH])
            yield SE3(numbers[:9].reshape(3, 3), numbers[9:12])

    @property
    def t_ns(self) -> I64:
        """Times (N,) int64."""
        return np.array(self._t_ns, np.int64)

    @property
    def positions(self) -> F64:
        """Positions (N, 3) m."""
        return self._columns(9)

    @property
    def sigmas(self) -> F64:
        """One sigma of the positions (N, 3) m."""
        return self._columns(12)

    def _columns(self, first: int) -> F64:
        # A copy: what is looked at cannot grow.
        return np.frombuffer(self._numbers).reshape(-1, WIDTH)[:, first : first + 3].copy()
