"""The ground that a simulated flight takes place over, by its name in the URL."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from common.arrays import F64, Bool
from common.messages import Datum

SITES = ("plain",)
_LATITUDE_DEG, _LONGITUDE_DEG, _HEIGHT = 30.5355, 114.3655, 62.0


class Ground(Protocol):
    """What a flight needs of the earth's surface, in its `world`."""

    def height(self, xy: F64) -> F64:
        """Height (N,) m of the surface at points (N, 2) m."""
        ...

    def blocked(self, p_world: F64, directions: F64) -> Bool:
        """Whether the surface hides the sky in directions (S, 3) from a place (3,) m."""
        ...


class Plain:
    """Level ground with nothing on it to see, for flights without a camera."""

    def height(self, xy: F64) -> F64:
        """Height (N,) m of the surface at points (N, 2) m."""
        return np.zeros(len(xy))

    def blocked(self, p_world: F64, directions: F64) -> Bool:
        """Whether the surface hides the sky in directions (S, 3) from a place (3,) m."""
        return np.asarray(directions[:, 2] < 0)


def open_ground(name: str, seed: int) -> tuple[Ground, Datum]:
    """The ground of a name in SITES, and the datum of a flight there."""
    return Plain(), Datum(f"2024-06-01T09-00-00-sim{seed}", _LATITUDE_DEG, _LONGITUDE_DEG, _HEIGHT)
