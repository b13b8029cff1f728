"""What a site is made of before light falls on it, and three kinds of it: town, field and forest."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as default
from itertools import pairwise

import cv2
import numpy as np

from air.sources.simulated.sites.layout import Bounds, Box, Layout, Road, Tree, plan_village
from air.sources.simulated.sites.noise import fractal, smoothstep
from air.sources.simulated.sites.paint import SOIL, Canvas, meadow, paint_ground
from air.sources.simulated.sites.plants import Plants, scatter_trees
from air.sources.simulated.sites.scene import FACADE, PLASTER, TILES, Solids
from air.sources.simulated.sites.solids import ROOFS, box_solid, build_solids, solid_table
from air.sources.simulated.sites.surface import CELL
from common.arrays import F32, F64, U8

TERRAIN_CELL = 1.0
_STRIP = 512
"""Rows of paint that are made at once."""


@dataclass(frozen=True, eq=False)
class Landscape:
    """Bare ground (h, w) m and plants on the raster of a surface; paint (H, W, 4) uint8 of the ground, RGB (gamma 2)
    and strength of detail; solids; `lanes` (N, 2) m for cars; height of the `water`, −inf without."""

    terrain: F32
    paint: U8
    solids: Solids
    plants: Plants
    lanes: list[F64] = default(default_factory=list)
    water: float = -np.inf


def town(rng: np.random.Generator, bounds: Bounds, texel: float, pond: float) -> Landscape:
    """Houses along crossing roads, yards, containers, parked cars, gardens with trees."""
    terrain, water = ground(rng, bounds, ((110.0, 1.2), (45.0, 0.4), (16.0, 0.08)), pond)
    density = fractal(rng, bounds.grid(TERRAIN_CELL), TERRAIN_CELL, ((40.0, 0.8), (12.0, 0.6)))
    layout = plan_village(rng, bounds, np.asarray(0.05 + 0.6 * smoothstep(0.2, 1.6, density), np.float32), TERRAIN_CELL)
    plants = Plants(rng, bounds)
    for tree in layout.trees:
        plants.grow(tree)
    for road in layout.roads:
        plants.clear(road.line, road.width / 2)
    paint = paint_ground(rng, layout, texel)
    layout.trees.clear()
    solids = build_solids(rng, layout, lambda x, y: at(bounds, terrain, x, y))
    solids["wall_pattern"][solids["wall_pattern"] == PLASTER] = FACADE
    return Landscape(terrain, paint, solids, plants, [lane for road in layout.roads for lane in lanes(road)], water)


def field(rng: np.random.Generator, bounds: Bounds, texel: float, pond: float) -> Landscape:
    """Rows of young crop with tramlines, a hedge, a shed: weak and repetitive texture."""
    terrain, water = ground(rng, bounds, ((150.0, 1.2), (60.0, 0.3)), pond)
    canvas = Canvas(Layout(bounds), texel, meadow(rng, Layout(bounds), texel))
    turn = rng.uniform(0.1, 0.5)
    _sow(rng, canvas.image, texel, turn)
    plants, centre = Plants(rng, bounds), np.array([bounds.west + bounds.east, bounds.south + bounds.north]) / 2
    along, across = np.array([-np.sin(turn), np.cos(turn)]), np.array([np.cos(turn), np.sin(turn)])
    reach = np.hypot(bounds.east - bounds.west, bounds.north - bounds.south)
    track = centre + 45.0 * across + np.linspace(-reach, reach, 200)[:, None] * along
    canvas.line(track, 3.2, (122, 108, 82, 46))
    for side in (-0.8, 0.8):
        canvas.line(track + side * across, 0.55, tuple(int(c) for c in SOIL))
    hedge = centre + 50.0 * across
    for s in np.arange(-reach, reach, 1.3):
        x, y = hedge + s * along + rng.normal(0, 0.4, 2)
        plants.grow(Tree(float(x), float(y), float(rng.uniform(0.8, 1.6)), float(rng.uniform(1.2, 2.8))))
        if rng.random() < 0.06:
            plants.grow(Tree(float(x), float(y), float(rng.uniform(2.5, 4.0)), float(rng.uniform(6, 10))))
    x, y = (float(c) for c in centre + 41.0 * across + 12.0 * along)
    shed = Box(x, y, turn, 5.0, 3.5, 3.2, 0.4)
    roof = ROOFS[int(rng.integers(len(ROOFS)))]
    solid = box_solid(shed, at(bounds, terrain, shed.x, shed.y), roof, (150, 128, 98), (TILES, PLASTER), 1)
    return Landscape(terrain, canvas.image, solid_table([solid]), plants, [track], water)


def forest(rng: np.random.Generator, bounds: Bounds, texel: float, pond: float) -> Landscape:
    """Broad-leaved trees and conifers, clearings, a path."""
    terrain, water = ground(rng, bounds, ((120.0, 3.0), (45.0, 0.8), (16.0, 0.2), (5.0, 0.04)), pond)
    layout = Layout(bounds)
    canvas = Canvas(layout, texel, meadow(rng, layout, texel))
    s = np.arange(bounds.south - 5, bounds.north + 5, 1.0)
    path = np.stack([(bounds.west + bounds.east) / 2 + 9 * np.sin(s / 33) + 0.15 * s, s], axis=1)
    canvas.line(path, 2.8, (126, 112, 88, 50))
    canvas.scatter_stones(rng)
    open_ground = fractal(rng, bounds.grid(TERRAIN_CELL), TERRAIN_CELL, ((60.0, 0.8), (20.0, 0.5)))
    conifers = fractal(rng, bounds.grid(TERRAIN_CELL), TERRAIN_CELL, ((50.0, 1.0),))
    plants = Plants(rng, bounds)
    for tree in scatter_trees(rng, bounds, 4.6, (1.6, 3.6), 1.6):
        column, row = (int(c) for c in bounds.pixels(np.array([tree.x, tree.y]), TERRAIN_CELL))
        clearing = open_ground[row, column]
        if clearing < 0.55 and np.hypot(*(path - [tree.x, tree.y]).T).min() > 1.6 + 0.5 * tree.radius:
            plants.grow(tree, bool(conifers[row, column] + rng.normal(0, 0.5) > 0.4))
        elif clearing > 0.55 and rng.random() < 0.25:
            plants.grow(Tree(tree.x, tree.y, 0.3 * tree.radius, 0.4 * tree.radius))
    return Landscape(terrain, canvas.image, solid_table([]), plants, [path], water)


def ground(
    rng: np.random.Generator, bounds: Bounds, relief: tuple[tuple[float, float], ...], pond: float
) -> tuple[F32, float]:
    """Bare ground (h, w) m of octaves (wavelength m, standard deviation m) on a surface's raster, about 0 on average
    and bilinear between nodes a metre apart; and the height of the water in a hollow, the radius of `pond` m."""
    coarse = fractal(rng, bounds.grid(TERRAIN_CELL), TERRAIN_CELL, relief)
    coarse -= coarse.mean()
    water, place = -np.inf, rng.uniform(-1, 1, 2)
    if pond > 0.0:
        row, column = np.mgrid[: coarse.shape[0], : coarse.shape[1]]
        x, y = bounds.west + column * TERRAIN_CELL, bounds.south + row * TERRAIN_CELL
        centre = np.array([bounds.west + bounds.east, bounds.south + bounds.north]) / 2 + 25 * place
        q = np.hypot(x - centre[0], (y - centre[1]) * 1.3) / pond
        inside = q < 1.6
        water = float(coarse[inside].min()) - 0.3
        bank = np.asarray(np.clip((1.6 - q) / 0.6, 0, 1), np.float32)
        bed = np.asarray(water - 1.2 + 1.5 * np.clip(q, 0, 1.2) ** 4, np.float32)
        coarse += (np.minimum(bed, coarse) - coarse) * bank * bank * (3 - 2 * bank)
    rows, columns = bounds.grid(CELL)
    enlarge = np.array([[CELL / TERRAIN_CELL, 0, 0], [0, CELL / TERRAIN_CELL, 0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    fine = cv2.warpAffine(coarse, enlarge, (columns, rows), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(fine, np.float32), water


def at(bounds: Bounds, terrain: F32, x: float, y: float) -> float:
    """Height m of a raster's node nearest to a place."""
    column, row = np.round(bounds.pixels(np.array([x, y]), CELL)).astype(int)
    rows, columns = terrain.shape
    return float(terrain[int(np.clip(row, 0, rows - 1)), int(np.clip(column, 0, columns - 1))])


def lanes(road: Road) -> list[F64]:
    """Both lanes (N, 2) m of a road, each in its direction."""
    ahead = np.gradient(road.line, axis=0)
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1)[:, None]
    return [road.line + road.width / 4 * right, (road.line - road.width / 4 * right)[::-1]]


def _sow(rng: np.random.Generator, image: U8, texel: float, turn: float) -> None:
    """Rows of crop 0.75 m apart on bare soil, and the wheel tracks of a tractor every 18 m, over all of an image."""
    rows, columns = image.shape[:2]
    cells = max(1, round(0.2 / texel))
    vigour = fractal(rng, (rows // cells + 2, columns // cells + 2), texel * cells, ((30, 0.3), (6, 0.2), (1.2, 0.3)))
    soil, crop = np.array([124, 108, 86, 26], np.float32), np.array([92, 112, 62, 46], np.float32)
    x = np.arange(columns, dtype=np.float32) * np.float32(texel * np.cos(turn))
    for begin, end in pairwise([*range(0, rows, _STRIP), rows]):
        y = np.arange(begin, end, dtype=np.float32)[:, None] * np.float32(texel * np.sin(turn))
        across = x + y
        shift = np.array([[1 / cells, 0, 0], [0, 1 / cells, begin / cells]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        much = cv2.warpAffine(vigour, shift, (columns, end - begin), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        phase = across / np.float32(0.75)
        ridge = np.abs(phase - np.round(phase))
        cover = np.clip((0.22 + 0.10 * much - ridge) * 9, 0, 1)
        wheel = across % np.float32(18.0)
        cover[(wheel < 0.45) | (np.abs(wheel - 2.0) < 0.22)] = 0
        for c in range(4):
            image[begin:end, :, c] = soil[c] + (crop[c] - soil[c]) * cover
