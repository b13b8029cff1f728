"""A site that the video camera can fly over: a surface with its light, and what is true of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from air.sources.simulated.sites import raycast
from air.sources.simulated.sites.layout import Bounds
from air.sources.simulated.sites.scene import Light
from air.sources.simulated.sites.surface import LIGHT_SCALE, Surface, rasterize, texture_level
from common.arrays import F32, F64, I32, U8, Bool

_DSM_ROWS = 256
_RAISED = 0.02
"""How far above the ground a ray to the sky begins, m."""


@dataclass(frozen=True, eq=False)
class Mover:
    """A car on its way: corner points (N, 2) m in world of a closed or long line, speed m/s, start m along it.

    `solids` are those of the surface that make it up, each `ahead` m of its middle, their tops above the ground.
    """

    line: F64
    speed: float
    start: float
    solids: tuple[int, ...]
    ahead: tuple[float, ...]

    @cached_property
    def _along(self) -> F64:
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.line, axis=0), axis=1))])

    def pose(self, t_s: float) -> tuple[float, float, float]:
        """Place m in world and heading rad from east, at a time s; at its end the line begins anew."""
        s = (self.start + self.speed * t_s) % self._along[-1]
        k = min(int(np.searchsorted(self._along, s, side="right")), len(self.line) - 1)
        ahead = self.line[k] - self.line[k - 1]
        x, y = (float(np.interp(s, self._along, axis)) for axis in self.line.T)
        return x, y, float(np.arctan2(ahead[1], ahead[0]))


@dataclass(frozen=True, eq=False)
class Site:
    """A piece of the earth's surface in `world`. Heights and colours are true but for what moves, which is left out."""

    bounds: Bounds
    surface: Surface
    light: Light
    terrain_raster: F32
    """Bare ground (h, w) m on the surface's raster."""
    movers: tuple[Mover, ...] = ()
    sway: float = 0.0
    """How far plants move in the wind, m."""

    def height(self, xy: npt.ArrayLike) -> F64:
        """Height (N,) m in world of the surface, roofs and crowns included, at points (N, 2) m."""
        points = np.ascontiguousarray(np.atleast_2d(np.asarray(xy, float)))
        z = np.empty(len(points))
        raycast.heights(self.surface, points, z)
        return z

    def terrain(self, xy: npt.ArrayLike) -> F64:
        """Height (N,) m in world of the bare ground at points (N, 2) m."""
        points = np.ascontiguousarray(np.atleast_2d(np.asarray(xy, float)))
        z = np.empty(len(points))
        raycast.raster_heights(self.surface._replace(height=self.terrain_raster), points, z)
        return z

    def intersect(self, origin: F64, directions: F64) -> tuple[F64, I32]:
        """Where descending rays (N, 3) from an origin (3,) meet the surface: points (N, 3) m, and solids (N,).

        −1 is ground or plants, −2 water, −3 the sky, whose points are far away.
        """
        rays = np.ascontiguousarray(directions, float)
        p, solid = np.empty_like(rays), np.empty(len(rays), np.int32)
        raycast.intersections(
            self.still, np.asarray(origin, float), rays, np.empty(raycast.CANDIDATES, np.int32), p, solid
        )
        return p, solid

    def blocked(self, p_world: F64, directions: F64) -> Bool:
        """Whether the surface hides the sky in directions (N, 3) from a place (3,) m, both in world."""
        hidden = np.zeros(len(directions), np.bool_)
        raycast.hidden(
            self.still, np.asarray(p_world, float) + [0, 0, _RAISED], np.ascontiguousarray(directions, float), hidden
        )
        return hidden

    def colour(self, xy: npt.ArrayLike) -> U8:
        """Colour (N, 3) uint8 RGB, as light and shadow leave it, seen from above at points (N, 2) m."""
        points = np.ascontiguousarray(np.atleast_2d(np.asarray(xy, float)))
        rgb = np.empty((len(points), 3))
        raycast.colours(self.still, self.light, points, rgb)
        return np.asarray(np.clip(np.sqrt(rgb) * LIGHT_SCALE, 0, 255), np.uint8)

    def dsm(self) -> F32:
        """Height (h, w) m of the surface on nodes every 0.125 m, row 0 in the south, node [0, 0] in the corner."""
        top = rasterize(self.bounds, self.surface.height, self.still.solids)
        return np.asarray(np.maximum(top, np.float32(self.surface.water)), np.float32)

    def cloud(self, spacing: float = 0.1) -> Iterator[tuple[F64, U8]]:
        """Points (N, 3) m in world on the surface, seen from above, and colours (N, 3) uint8, strip by strip."""
        x = np.arange(self.bounds.west + spacing / 2, self.bounds.east, spacing)
        y = np.arange(self.bounds.south + spacing / 2, self.bounds.north, spacing)
        for part in np.array_split(y, max(1, len(y) // _DSM_ROWS)):
            xy = np.stack(np.meshgrid(x, part), axis=-1).reshape(-1, 2)
            yield np.column_stack([xy, self.height(xy)]), self.colour(xy)

    def orthophoto(self) -> U8:
        """Texture (H, W, 4) of ground and plants, RGB and the strength of detail, row 0 in the south; a view."""
        return texture_level(self.surface.colour, self.surface.colour_at, 0)

    @cached_property
    def still(self) -> Surface:
        """The surface without what moves."""
        return self.surface._replace(solids=self.surface.solids[: self.surface.still])

    def at(self, t_s: float) -> tuple[Surface, F64]:
        """The surface at a time s, and how fast (K, 2) m/s each of its moving solids goes."""
        pace = np.zeros((max(len(self.surface.solids) - self.surface.still, 1), 2))
        if not self.movers:
            return self.surface, pace
        solids = self.surface.solids.copy()
        for mover in self.movers:
            x, y, heading = mover.pose(t_s)
            cos, sin, ground = np.cos(heading), np.sin(heading), float(self.terrain([[x, y]])[0])
            for k, ahead in zip(mover.solids, mover.ahead, strict=True):
                x_k, y_k = x + ahead * cos, y + ahead * sin
                solids["x"][k], solids["y"][k], solids["cos"][k], solids["sin"][k] = x_k, y_k, cos, sin
                solids["top"][k] += ground
                pace[k - self.surface.still] = mover.speed * cos, mover.speed * sin
        return self.surface._replace(solids=solids), pace
