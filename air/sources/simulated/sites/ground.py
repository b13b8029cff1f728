"""The ground that a simulated flight takes place over, by its name in the URL."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from air.sources.simulated.motion.mission import plan
from air.sources.simulated.options import GEOTIFF, PLAIN, SimulationOptions
from air.sources.simulated.sites.geotiff import read_site
from air.sources.simulated.sites.layout import Bounds
from air.sources.simulated.sites.sites import SITES as WORLDS
from air.sources.simulated.sites.sites import generate_site
from common.arrays import F64, Bool
from common.messages import Datum

SITES = (PLAIN, GEOTIFF, *WORLDS)
_LATITUDE_DEG, _LONGITUDE_DEG, _HEIGHT = 30.5355, 114.3655, 62.0
_MARGIN, _REACH = 25.0, 1.25
"""How far beyond its way an aircraft sees, m, and for each metre that it is high."""
_CELL = 2.0


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


def open_ground(options: SimulationOptions, site: str) -> tuple[Ground, Datum]:
    """The ground of a site, and the datum there. A world takes some seconds to be made, as large as the flight needs.

    Raises SourceError for files of an orthophoto and a surface model that cannot be used.
    """
    flight = f"2024-06-01T09-00-00-sim{options.seed}"
    if site == GEOTIFF:
        return read_site(options.geotiff, options.seed, flight)
    ground = Plain() if site == PLAIN else generate_site(options.world, options.seed, reach_of(options))
    return ground, Datum(flight, _LATITUDE_DEG, _LONGITUDE_DEG, _HEIGHT)


def reach_of(options: SimulationOptions) -> Bounds:
    """Bounds of all that a flight sees, in whole cells."""
    p = plan(options.flight, options.duration).p
    margin = _MARGIN + _REACH * float(p[:, 2].max())
    low, high = p[:, :2].min(axis=0) - margin, p[:, :2].max(axis=0) + margin
    west, south = (float(value) for value in np.floor(low / _CELL) * _CELL)
    east, north = (float(value) for value in np.ceil(high / _CELL) * _CELL)
    return Bounds(west, south, east, north)
