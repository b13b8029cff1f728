"""Sites by name: playground, town, field and forest, made from a seed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np

from air.sources.simulated.camera.camera import daylight
from air.sources.simulated.sites.baking import bake, periodic_textures
from air.sources.simulated.sites.landscape import Landscape, field, forest, town
from air.sources.simulated.sites.layout import Bounds, Box
from air.sources.simulated.sites.noise import periodic_detail
from air.sources.simulated.sites.playground import playground
from air.sources.simulated.sites.scene import PLAIN, Solids
from air.sources.simulated.sites.site import Mover, Site
from air.sources.simulated.sites.solids import CARS, GLASS, box_solid, solid_table
from air.sources.simulated.sites.surface import build_surface, texture_level
from common.config import Range

SITES = {"playground": playground, "town": town, "field": field, "forest": forest}
_PLAN, _TEXTURES, _FINE, _CARS = 20, 21, 22, 23
_TEXELS = 1.0e8
"""As many as the texture may have: a site of 200 m × 200 m at 2 cm."""
_FINE_TEXELS = 1024


@dataclass(frozen=True)
class WorldOptions:
    """What a site has. Lengths m; 0 turns a thing off.

    `texel` is the finest piece of the ground's texture (larger where the site is so large that it would not fit into
    memory); `water` the radius of a pond; `cars` drive at `car_speed` m/s; plants `sway` in the wind.
    """

    site: Literal["playground", "town", "field", "forest"] = "playground"
    texel: Annotated[float, Range(0.01, 1)] = 0.02
    water: Annotated[float, Range(0, 40)] = 0.0
    cars: Annotated[int, Range(0, 30)] = 0
    car_speed: Annotated[float, Range(0, 40)] = 8.0
    sway: Annotated[float, Range(0, 0.5)] = 0.0


def generate_site(options: WorldOptions, seed: int, bounds: Bounds) -> Site:
    """The site of a seed within bounds."""
    light = daylight()
    texel = texel_of(bounds, options.texel)
    land = SITES[options.site](np.random.default_rng([seed, _PLAN]), bounds, texel, options.water)
    textures = periodic_textures(np.random.default_rng([seed, _TEXTURES]))
    moving, movers = _traffic(np.random.default_rng([seed, _CARS]), land, options)
    plants = np.maximum(land.plants.height, 0)
    sway = np.clip(255 * (plants - 0.3) / 3, 0, 255).astype(np.uint8)
    height = land.terrain + plants
    surface = build_surface(
        bounds, height, land.solids, moving, texel, light, land.water, sway, textures
    )  # fmt: skip
    paint = texture_level(surface.colour, surface.colour_at, 0)
    rows, columns = land.paint.shape[:2]
    paint[:rows, :columns], paint[rows:], paint[:, columns:] = land.paint, (98, 108, 66, 58), (98, 108, 66, 58)
    rng = np.random.default_rng([seed, _FINE])
    fine = np.stack([periodic_detail(rng, _FINE_TEXELS, 2.5, 60.0) for _ in range(2)])
    bake(surface, plants, land.plants.leaves, light, fine)
    return Site(bounds, surface, light, land.terrain, movers, options.sway)


def texel_of(bounds: Bounds, wanted: float) -> float:
    """The finest texel m of a texture over bounds that fits into memory."""
    area = (bounds.east - bounds.west) * (bounds.north - bounds.south)
    return max(wanted, float(np.sqrt(area / _TEXELS)))


def _traffic(rng: np.random.Generator, land: Landscape, options: WorldOptions) -> tuple[Solids, tuple[Mover, ...]]:
    """Cars on the lanes of a landscape: their solids, standing on height 0, and their ways."""
    solids, movers, begin = [], [], len(land.solids)
    for n in range(options.cars if land.lanes else 0):
        lane = land.lanes[n % len(land.lanes)]
        colour = CARS[int(rng.integers(len(CARS)))]
        length = float(np.sum(np.linalg.norm(np.diff(lane, axis=0), axis=1)))
        body = Box(0.0, 0.0, 0.0, 2.15, 0.88, 0.85)
        cabin = replace(body, a=1.15, b=0.78, wall_height=1.45)
        solids.append(box_solid(body, 0.0, colour, colour, (PLAIN, PLAIN), 9000 + 2 * n))
        solids.append(box_solid(cabin, 0.0, colour, GLASS, (PLAIN, PLAIN), 9001 + 2 * n))
        speed, start = options.car_speed * rng.uniform(0.7, 1.2), rng.uniform(0, length)
        movers.append(Mover(lane, float(speed), float(start), (begin + 2 * n, begin + 2 * n + 1), (0.0, -0.25)))
    return solid_table(solids), tuple(movers)
