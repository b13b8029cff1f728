"""The simulated world: a village on rolling ground. It knows no camera and no flight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from air.sources.simulated.sites import raytrace
from air.sources.simulated.sites.layout import Bounds, Layout, plan_village
from air.sources.simulated.sites.noise import fractal, periodic_detail, smoothstep
from air.sources.simulated.sites.paint import paint_ground
from air.sources.simulated.sites.scene import Scene
from air.sources.simulated.sites.solids import build_solids, index_solids
from common.arrays import F32, F64, I32, U8

TERRAIN_CELL, PAINT_CELL, INDEX_CELL = 1.0, 0.05, 2.0
RELIEF = ((110.0, 1.6), (45.0, 0.5), (16.0, 0.12), (5.0, 0.03))
"""Wavelength and standard deviation of the terrain's octaves, m."""
DETAIL_TEXELS = 1024


@dataclass(frozen=True, eq=False)
class World:
    """A piece of the earth's surface: all of it a function of the seed and the bounds."""

    bounds: Bounds
    scene: Scene

    def height(self, xy: npt.ArrayLike) -> F64:
        """Height (N,) m in world of the surface, roofs and crowns included, at points (N, 2) m."""
        return self.top(xy)[0]

    def terrain(self, xy: npt.ArrayLike) -> F64:
        """Height (N,) m in world of the bare ground at points (N, 2) m."""
        points = np.ascontiguousarray(np.atleast_2d(np.asarray(xy, float)))
        z = np.empty(len(points))
        raytrace.terrain_heights(self.scene, points, z)
        return z

    def top(self, xy: npt.ArrayLike) -> tuple[F64, I32]:
        """Height (N,) m of the surface and the solid (N,) that forms it (−1: terrain) at points (N, 2) m."""
        points = np.ascontiguousarray(np.atleast_2d(np.asarray(xy, float)))
        z, solid = np.empty(len(points)), np.empty(len(points), np.int32)
        raytrace.heights(self.scene, points, z, solid)
        return z, solid

    def intersect(self, origin: F64, directions: F64) -> tuple[F64, I32]:
        """Where descending rays (N, 3) from an origin (3,) meet the surface: points (N, 3) m and solids (N,)."""
        rays = np.ascontiguousarray(directions, float)
        p, solid = np.empty_like(rays), np.empty(len(rays), np.int32)
        raytrace.intersections(self.scene, np.asarray(origin, float), rays, p, solid)
        return p, solid

    def colour(self, p_world: F64, solid: I32, face: I32) -> U8:
        """Colour (N, 3) uint8 RGB, without light and shadow, of surface points (N, 3) m on solids and faces (N,)."""
        rgb = np.empty((len(p_world), 3))
        raytrace.reflectances(self.scene, np.ascontiguousarray(p_world), solid, face, rgb)
        return np.asarray(np.clip(255 * np.sqrt(rgb), 0, 255), np.uint8)


def generate_world(seed: int, bounds: Bounds) -> World:
    """The world of a seed within bounds."""
    terrain_rng, plan_rng, paint_rng, solid_rng, detail_rng = (np.random.default_rng([seed, part]) for part in range(5))
    terrain = _terrain(terrain_rng, bounds)
    layout = plan_village(plan_rng, bounds, _tree_density(plan_rng, bounds), TERRAIN_CELL)
    detail = np.stack([periodic_detail(detail_rng, DETAIL_TEXELS, 3.0, 60.0) for _ in range(2)])
    return World(
        bounds, _scene(bounds, terrain, paint_ground(paint_rng, layout, PAINT_CELL), detail, layout, solid_rng)
    )


def _scene(bounds: Bounds, terrain: F64, paint: U8, detail: F32, layout: Layout, rng: np.random.Generator) -> Scene:
    def ground(x: float, y: float) -> float:
        column, row = bounds.pixels(np.array([x, y]), TERRAIN_CELL)
        rows, columns = terrain.shape
        return float(terrain[int(np.clip(round(row), 0, rows - 1)), int(np.clip(round(column), 0, columns - 1))])

    solids = build_solids(rng, layout, ground)
    rows, columns = bounds.grid(INDEX_CELL)
    index = index_solids(solids, bounds, INDEX_CELL)
    highest = float(max(terrain.max(), solids["top"].max(initial=-np.inf))) + 0.01
    return Scene(
        bounds.west, bounds.south, terrain, TERRAIN_CELL, paint, PAINT_CELL, detail,
        solids, INDEX_CELL, columns, rows, *index, highest,
    )  # fmt: skip


def _terrain(rng: np.random.Generator, bounds: Bounds) -> F64:
    z = fractal(rng, bounds.grid(TERRAIN_CELL), TERRAIN_CELL, RELIEF).astype(np.float64)
    return np.asarray(z - z.mean())


def _tree_density(rng: np.random.Generator, bounds: Bounds) -> F32:
    """Chance (h, w) that a tree grows, by groves."""
    noise = fractal(rng, bounds.grid(TERRAIN_CELL), TERRAIN_CELL, ((40.0, 0.8), (12.0, 0.6)))
    return np.asarray(0.03 + 0.75 * smoothstep(0.2, 1.6, noise), np.float32)
