"""From the plan of the village to the solids that rays meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from air.sources.simulated.sites.layout import Bounds, Box, Layout, Tree
from air.sources.simulated.sites.scene import DOME, HOUSE, PLAIN, PLASTER, RIBS, SOLID, TILES, Solids
from common.arrays import F64, I32

Ground = Callable[[float, float], float]
Colour = tuple[int, int, int]

ROOFS = [(158, 84, 62), (136, 70, 56), (112, 104, 100), (94, 92, 96), (168, 112, 84)]
FLAT_ROOFS = [(168, 166, 160), (122, 120, 118), (146, 138, 126)]
WALLS = [(226, 218, 202), (206, 190, 164), (188, 186, 182), (214, 202, 150), (166, 110, 88)]
CONTAINERS = [(172, 66, 48), (52, 92, 140), (62, 116, 84), (196, 176, 72), (178, 178, 180), (120, 70, 52)]
CARS = [(198, 200, 202), (60, 62, 66), (138, 30, 32), (44, 66, 120), (228, 228, 226), (110, 114, 116)]
GLASS = (38, 44, 50)
CROWNS = [(74, 98, 46), (62, 86, 44), (88, 108, 52), (98, 102, 56), (54, 78, 46)]


@dataclass(frozen=True)
class Solid:
    """One solid before it becomes a row of `Solids`; colours are RGB with gamma 2."""

    kind: int
    x: float
    y: float
    heading: float
    a: float
    b: float
    top: float
    slope: float
    roof: tuple[float, ...]
    wall: tuple[float, ...]
    roof_pattern: int
    wall_pattern: int
    seed: int


def box_solid(box: Box, ground: float, roof: Colour, wall: Colour, patterns: tuple[int, int], seed: int) -> Solid:
    """The solid of a box that stands on ground of a height m; patterns of its roof and its walls."""
    top = ground + box.wall_height + box.slope * box.b
    return Solid(HOUSE, box.x, box.y, box.heading, box.a, box.b, top, box.slope, roof, wall, *patterns, seed)


def build_solids(rng: np.random.Generator, layout: Layout, ground: Ground) -> Solids:
    """All solids of a layout on the `ground` (height m at x, y)."""

    def pick(colours: list[Colour]) -> Colour:
        return colours[int(rng.integers(len(colours)))]

    solids: list[Solid] = []

    def box(b: Box, roof: Colour, wall: Colour, roof_pattern: int, wall_pattern: int) -> None:
        solids.append(box_solid(b, ground(b.x, b.y), roof, wall, (roof_pattern, wall_pattern), len(solids)))

    for house in layout.houses:
        flat = house.body.slope == 0.0
        roof, wall, pattern = pick(FLAT_ROOFS if flat else ROOFS), pick(WALLS), PLASTER if flat else TILES
        for part in (house.body, house.wing):
            if part is not None:
                box(part, roof, wall, pattern, PLASTER)
    for container in layout.containers:
        colour = pick(CONTAINERS)
        box(container, colour, colour, RIBS, RIBS)
    for car in layout.cars:
        colour = pick(CARS)
        box(car.body, colour, colour, PLAIN, PLAIN)
        box(car.cabin, colour, GLASS, PLAIN, PLAIN)
    for tree in layout.trees:
        solids.extend(_crown(rng, tree, ground(tree.x, tree.y), pick(CROWNS), len(solids)))
    return solid_table(solids)


def _crown(rng: np.random.Generator, tree: Tree, ground: float, colour: Colour, seed: int) -> list[Solid]:
    """A crown: one dome and smaller ones that stick out of it, lighter or darker."""

    def dome(x: float, y: float, r: float, vertical: float, top: float) -> Solid:
        shade = tuple(float(np.clip(c * rng.normal(1.0, 0.07), 10, 250)) for c in colour)
        return Solid(DOME, x, y, 0.0, r, vertical, top, 0.0, shade, shade, PLAIN, PLAIN, seed)

    top, vertical = ground + tree.height, min(1.6 * tree.radius, 0.85 * tree.height)
    crown = [dome(tree.x, tree.y, 0.9 * tree.radius, vertical, top)]
    for _ in range(int(4 + 5 * tree.radius)):
        bearing, out = rng.uniform(0, 2 * np.pi), np.sqrt(rng.uniform(0.02, 0.75))
        r = tree.radius * rng.uniform(0.18, 0.36)
        x, y = tree.x + out * tree.radius * np.cos(bearing), tree.y + out * tree.radius * np.sin(bearing)
        above = top - vertical * (1 - np.sqrt(1 - out**2)) + rng.uniform(0.0, 0.5) * r
        crown.append(dome(x, y, r, r, above))
    return crown


def solid_table(solids: list[Solid]) -> Solids:
    """Records of solids."""
    table = np.zeros(len(solids), SOLID)
    for name in ("kind", "x", "y", "a", "b", "top", "slope", "roof_pattern", "wall_pattern", "seed"):
        table[name] = [getattr(solid, name) for solid in solids]
    for name in ("roof", "wall"):
        table[name] = (np.array([getattr(solid, name) for solid in solids], float).reshape(-1, 3) / 255.0) ** 2
    table["cos"], table["sin"] = (f([solid.heading for solid in solids]) for f in (np.cos, np.sin))
    return table


def index_solids(solids: Solids, bounds: Bounds, cell: float, margin: float = 0.0) -> tuple[I32, I32, F64]:
    """Which solids each cell of a grid may hold: `first` (C + 1,), `listed`, `cell_top` (C,) as `Scene` says.

    A cell also lists the solids that are up to `margin` m away from it.
    """
    rows, columns = bounds.grid(cell)
    members: list[list[int]] = [[] for _ in range(rows * columns)]
    tops = np.full(rows * columns, -np.inf)
    house = solids["kind"] == HOUSE
    reach_x = np.where(house, np.abs(solids["cos"]) * solids["a"] + np.abs(solids["sin"]) * solids["b"], solids["a"])
    reach_y = np.where(house, np.abs(solids["sin"]) * solids["a"] + np.abs(solids["cos"]) * solids["b"], solids["a"])
    reach_x, reach_y = reach_x + margin, reach_y + margin
    j0, j1 = (np.floor((solids["x"] + sign * reach_x - bounds.west) / cell).astype(int) for sign in (-1, 1))
    i0, i1 = (np.floor((solids["y"] + sign * reach_y - bounds.south) / cell).astype(int) for sign in (-1, 1))
    for k in range(len(solids)):
        for i in range(max(i0[k], 0), min(i1[k], rows - 1) + 1):
            for j in range(max(j0[k], 0), min(j1[k], columns - 1) + 1):
                members[i * columns + j].append(k)
                tops[i * columns + j] = max(tops[i * columns + j], solids["top"][k])
    first = np.concatenate([[0], np.cumsum([len(cell_members) for cell_members in members])]).astype(np.int32)
    listed = np.array([k for cell_members in members for k in cell_members], np.int32)
    return first, listed, tops
