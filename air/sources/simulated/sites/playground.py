"""An abandoned sports ground: a running track, a worn pitch, a cracked court, stands, walls, trees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from air.sources.simulated.sites.landscape import Landscape, at, ground
from air.sources.simulated.sites.layout import Bounds, Box, Layout, Tree
from air.sources.simulated.sites.paint import ASPHALT, CRACK, GRASS, SOIL, Canvas, meadow
from air.sources.simulated.sites.plants import Plants, scatter_trees
from air.sources.simulated.sites.scene import CONCRETE, FACADE, PLAIN, PLASTER, RIBS
from air.sources.simulated.sites.solids import CARS, CONTAINERS, GLASS, Solid, box_solid, solid_table
from common.arrays import F64

Colour = tuple[int, int, int]
Build = Callable[[Box, Colour, Colour, tuple[int, int]], None]
"""Puts up a box with the colours and the patterns of its roof and its walls."""
_STRAIGHT, _RADIUS, _LANE, _LANES = 84.39, 36.5, 1.22, 6
"""Of a standard track, m: the straight, the inner radius, the width of a lane."""
_TRACK, _TRACK_WORN, _CHALK = (146, 82, 66, 34), (122, 92, 80, 40), (206, 202, 192, 22)
_CONCRETE = (164, 160, 150, 26)
_SEATS = [(150, 148, 142), (158, 154, 148), (92, 120, 150), (158, 92, 78), (146, 144, 136)]
_EDGE = 46.0
"""From the middle of the ground to the outer edge of its track, m."""


def playground(rng: np.random.Generator, bounds: Bounds, texel: float, pond: float) -> Landscape:
    """The sports ground around the origin, its long side to the north."""
    terrain, water = ground(rng, bounds, ((120.0, 0.25), (35.0, 0.08), (9.0, 0.02)), pond)
    layout = Layout(bounds)
    canvas = Canvas(layout, texel, meadow(rng, layout, texel))
    canvas.scatter_stones(rng)
    _paint_track(rng, canvas)
    _paint_pitch(rng, canvas)
    _paint_court(rng, canvas)
    solids: list[Solid] = []

    def build(box: Box, roof: Colour, wall: Colour, patterns: tuple[int, int]) -> None:
        solids.append(box_solid(box, at(bounds, terrain, box.x, box.y), roof, wall, patterns, len(solids)))

    _build_stands(rng, build)
    _build_houses(rng, build)
    _build_walls(rng, build)
    for x in (-3.66, 3.66):
        for y in (-48.0, 48.0):
            build(Box(x, y, 0.0, 0.06, 0.06, 2.44), (225, 225, 222), (225, 225, 222), (PLAIN, PLAIN))
    plants = Plants(rng, bounds)
    boxes = [(solid.x, solid.y, float(np.hypot(solid.a, solid.b))) for solid in solids]
    for tree in scatter_trees(rng, bounds, 7.0, (1.2, 3.8), 1.2):
        if _may_grow(rng, tree, boxes):
            plants.grow(tree)
    for bush in scatter_trees(rng, bounds, 9.0, (0.3, 0.9), 0.6):
        if _outside_track(bush.x, bush.y) > 0.5 or rng.random() < 0.12:
            plants.grow(bush)
    lane = _oval(_RADIUS + 2.5 * _LANE)
    return Landscape(terrain, canvas.image, solid_table(solids), plants, [lane, lane[::-1]], water)


def _oval(radius: float, spacing: float = 1.0) -> F64:
    """A closed line (N, 2) m around the ground, two straights and two half circles, anticlockwise."""
    half, bend = _STRAIGHT / 2, np.arange(0.0, np.pi, spacing / radius)
    up = np.arange(-half, half, spacing)
    right = np.column_stack([np.full_like(up, radius), up])
    top = np.column_stack([radius * np.cos(bend), half + radius * np.sin(bend)])
    line = np.concatenate([right, top, -right, -top])
    return np.concatenate([line, line[:2]])


def _outside_track(x: float, y: float) -> float:
    """How far, m, a place is outside the track's outer edge; negative within."""
    return float(np.hypot(x, max(abs(y) - _STRAIGHT / 2, 0.0)) - (_RADIUS + _LANES * _LANE))


def _paint_track(rng: np.random.Generator, canvas: Canvas) -> None:
    outer = _RADIUS + _LANES * _LANE
    canvas.line(_oval(_RADIUS - 0.25, 0.5), 0.5, _CONCRETE)
    canvas.line(_oval((_RADIUS + outer) / 2, 0.5), outer - _RADIUS, _TRACK)
    line = _oval((_RADIUS + outer) / 2, 0.5)
    for _ in range(420):
        at_s, side = int(rng.integers(len(line))), rng.uniform(-1, 1) * (outer - _RADIUS) / 2
        centre = line[at_s] + side * _outwards(line[at_s])
        colour = [_TRACK_WORN, tuple(int(c) for c in GRASS), tuple(int(c) for c in SOIL), ASPHALT][
            int(rng.choice(4, p=[0.55, 0.2, 0.15, 0.1]))
        ]
        canvas.polygon(_blot(rng, centre, 0.15 + 1.6 * rng.random() ** 3), colour)
    for n in range(_LANES + 1):
        _chalk(rng, canvas, _oval(_RADIUS + n * _LANE, 0.4), 0.05, 0.78)
    for y in (-_STRAIGHT / 2, _STRAIGHT / 2 - 10.0):
        _chalk(rng, canvas, np.array([[x, y] for x in np.arange(_RADIUS, outer, 0.4)]), 0.05, 0.9)
    for _ in range(160):
        at_s = int(rng.integers(len(line)))
        start = line[at_s] + rng.uniform(-1, 1) * (outer - _RADIUS) / 2 * _outwards(line[at_s])
        _crack(rng, canvas, start, 0.03 + 0.05 * rng.random())


def _paint_pitch(rng: np.random.Generator, canvas: Canvas) -> None:
    """The faded lines of a football pitch, and bare soil where players ran."""
    for east, north, size in ((0, 46, 3.0), (0, -46, 3.0), (0, 0, 2.2), (12, 20, 1.6), (-9, -24, 1.8), (20, -5, 1.2)):
        for _ in range(14):
            spot = np.array([east, north]) + rng.normal(0, 0.6 * size, 2)
            canvas.polygon(_blot(rng, spot, size * rng.uniform(0.15, 0.6)), tuple(int(c) for c in SOIL))
    for a, b, y in (
        (30.0, 48.0, 0.0),
        (20.15, 8.25, 39.75),
        (20.15, 8.25, -39.75),
        (9.16, 2.75, 45.25),
        (9.16, 2.75, -45.25),
    ):
        corners = np.array([[-a, -b], [a, -b], [a, b], [-a, b], [-a, -b]]) + [0.0, y]
        for begin, end in pairwise(corners):
            s = np.linspace(0, 1, int(np.linalg.norm(end - begin) / 0.4) + 2)[:, None]
            _chalk(rng, canvas, begin + s * (end - begin), 0.11, 0.62)
    _chalk(rng, canvas, np.array([[x, 0.0] for x in np.arange(-30, 30.2, 0.4)]), 0.11, 0.62)
    bend = np.linspace(0, 2 * np.pi, 150)
    _chalk(rng, canvas, 9.15 * np.column_stack([np.cos(bend), np.sin(bend)]), 0.11, 0.62)


def _paint_court(rng: np.random.Generator, canvas: Canvas) -> None:
    """A basketball court of concrete slabs, cracked, and an asphalt yard beside it."""
    court, yard = Box(62.0, 22.0, np.pi / 2, 15.0, 8.5, 0.0), Box(64.0, -22.0, np.pi / 2, 18.0, 9.0, 0.0)
    canvas.polygon(yard.corners(0.2), _CONCRETE)
    canvas.polygon(yard.corners(), ASPHALT)
    canvas.repair(rng, np.array([yard.x, yard.y]), yard.heading, 30, yard.a, yard.b)
    canvas.polygon(court.corners(), _CONCRETE)
    for x in np.arange(court.x - court.b, court.x + court.b - 0.1, 3.4):
        for y in np.arange(court.y - court.a, court.y + court.a - 0.1, 3.0):
            tint = rng.normal(1.0, 0.06)
            slab = Box(x + 1.7, y + 1.5, 0.0, 1.68, 1.48, 0.0)
            canvas.polygon(slab.corners(), (*(int(np.clip(c * tint, 0, 255)) for c in _CONCRETE[:3]), 26))
    for _ in range(60):
        start = np.array([court.x, court.y]) + rng.uniform(-1, 1, 2) * [court.b, court.a]
        _crack(rng, canvas, start, 0.02 + 0.05 * rng.random())
    for _ in range(60):
        spot = np.array([court.x, court.y]) + rng.uniform(-1, 1, 2) * [court.b, court.a]
        canvas.polygon(_blot(rng, spot, 0.1 + 0.5 * rng.random() ** 3), tuple(int(c) for c in GRASS))
    edge = replace(court, a=14.0, b=7.5).corners()
    for begin, end in zip(edge, np.roll(edge, -1, axis=0), strict=True):
        _chalk(rng, canvas, begin + np.linspace(0, 1, 60)[:, None] * (end - begin), 0.06, 0.8)
    bend = np.linspace(0, 2 * np.pi, 40)
    _chalk(rng, canvas, [62.0, 22.0] + 1.8 * np.column_stack([np.cos(bend), np.sin(bend)]), 0.06, 0.8)


def _build_stands(rng: np.random.Generator, build: Build) -> None:
    """Nine steps of concrete along the western straight, with what is left of their seats, and the wall behind."""
    for step in range(9):
        x = -_EDGE - 4.0 - 0.85 * step
        for part in range(8):
            if rng.random() < 0.04:
                continue
            colour = _SEATS[int(rng.integers(len(_SEATS)))]
            grey = (154, 151, 144)
            build(
                Box(x, -28.0 + 8.0 * part, np.pi / 2, 3.6, 0.43, 0.5 + 0.42 * step), colour, grey, (CONCRETE, CONCRETE)
            )
    for part in range(8):
        build(
            Box(-_EDGE - 12.2, -28.0 + 8.0 * part, np.pi / 2, 4.0, 0.18, 5.6), (168, 164, 156), (190, 182, 166),
            (CONCRETE, PLASTER),
        )  # fmt: skip


def _build_houses(rng: np.random.Generator, build: Build) -> None:
    """Changing rooms, a shed, containers and parked cars."""
    build(Box(61.0, 62.0, 0.04, 9.0, 4.5, 4.2), (138, 134, 128), (206, 196, 172), (CONCRETE, FACADE))
    build(Box(66.5, 69.0, 0.04, 3.5, 3.0, 6.4), (150, 146, 140), (188, 180, 160), (CONCRETE, FACADE))
    build(Box(-60.0, 58.0, 1.5, 6.0, 3.2, 3.0, 0.55), (150, 84, 64), (196, 182, 150), (1, PLASTER))
    build(Box(58.0, -60.0, 0.1, 7.0, 4.0, 3.4, 0.5), (128, 76, 60), (210, 198, 170), (1, FACADE))
    for x, y, turn in ((60.5, -30.0, 1.5), (60.0, -36.5, 1.62), (69.0, -10.0, 1.57)):
        colour = CONTAINERS[int(rng.integers(len(CONTAINERS)))]
        build(Box(x, y, turn, 3.03, 1.22, 2.59), colour, colour, (RIBS, RIBS))
    for x, y in ((61.0, -12.0), (64.0, -12.3), (67.5, -26.0), (67.2, -29.4)):
        colour, turn = CARS[int(rng.integers(len(CARS)))], np.pi / 2 + rng.normal(0, 0.06)
        build(Box(x, y, turn, 2.15, 0.88, 0.85), colour, colour, (PLAIN, PLAIN))
        build(Box(x, y - 0.25, turn, 1.15, 0.78, 1.45), colour, GLASS, (PLAIN, PLAIN))
    for x, y in ((62.0, 7.9), (62.0, 36.1)):
        build(Box(x, y, 0.0, 0.09, 0.09, 3.3), (120, 122, 126), (120, 122, 126), (PLAIN, PLAIN))
        build(
            Box(x, y + (0.7 if y < 20 else -0.7), 0.0, 0.9, 0.06, 3.6), (214, 212, 206), (214, 212, 206), (PLAIN, PLAIN)
        )


def _build_walls(rng: np.random.Generator, build: Build) -> None:
    """A wall around it all, with gaps where it fell."""
    for x, y, turn, length in (
        *((side * 76.0, y, np.pi / 2, 5.0) for side in (-1, 1) for y in np.arange(-95.0, 96.0, 10.0)),
        *((x, side * 100.0, 0.0, 5.0) for side in (-1, 1) for x in np.arange(-71.0, 72.0, 10.0)),
    ):
        if rng.random() < 0.12:
            continue
        shade = rng.uniform(0.85, 1.1)
        colour = (int(176 * shade), int(164 * shade), int(146 * shade))
        high = 2.2 * rng.uniform(0.8, 1.05)
        build(Box(x, y, turn + rng.normal(0, 0.006), length, 0.14, high), (150, 146, 140), colour, (CONCRETE, PLASTER))


def _may_grow(rng: np.random.Generator, tree: Tree, boxes: list[tuple[float, float, float]]) -> bool:
    """Trees grow outside the track, away from buildings, more where nobody goes."""
    out = _outside_track(tree.x, tree.y) - 0.7 * tree.radius
    if out < 1.5 or (tree.x > 51.0 and abs(tree.y) < 42.0) or (tree.x < -46.0 and abs(tree.y) < 36.0):
        return False
    clear = all(np.hypot(tree.x - x, tree.y - y) > 0.7 * r + tree.radius for x, y, r in boxes)
    return clear and rng.random() < (0.75 if out > 12.0 else 0.4)


def _outwards(p: F64) -> F64:
    """The direction (2,) away from the middle line of the ground."""
    away = np.array([p[0], np.sign(p[1]) * max(abs(p[1]) - _STRAIGHT / 2, 0.0)])
    return np.asarray(away / np.linalg.norm(away))


def _blot(rng: np.random.Generator, centre: F64, size: float) -> F64:
    """An irregular outline (24, 2) m around a place."""
    bearing = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    waves = sum(rng.uniform(0, 0.22) * np.sin(n * bearing + rng.uniform(0, 6)) for n in range(2, 8))
    stretch = rng.uniform(0.6, 1.5)
    out = size * (1 + waves)
    return np.asarray(centre + np.column_stack([out * np.cos(bearing) * stretch, out * np.sin(bearing) / stretch]))


def _chalk(rng: np.random.Generator, canvas: Canvas, line: F64, width: float, kept: float) -> None:
    """A line of which only a share is left, worn in runs of a metre or two."""
    worn = rng.random(len(line) // 4 + 2) > kept
    begin = 0
    for n in range(1, len(line)):
        if worn[n // 4] or n == len(line) - 1:
            if n - begin > 1:
                tint = rng.uniform(0.82, 1.0)
                canvas.line(line[begin : n + 1], width, tuple(int(c * tint) for c in _CHALK))
            begin = n + 1


def _crack(rng: np.random.Generator, canvas: Canvas, start: F64, width: float) -> None:
    """A crack of some metres, grass in the widest."""
    walk = np.cumsum(rng.normal(0, 0.16, (int(rng.integers(8, 40)), 2)) + rng.normal(0, 0.12, 2), axis=0)
    canvas.line(start + walk, width, CRACK if rng.random() < 0.6 else (84, 96, 58, 50))
