"""The colours of the ground: meadow, bare soil, asphalt with its repairs and markings, paving, stones."""

from __future__ import annotations

import cv2
import numpy as np

from air.sources.simulated.sites.layout import Box, Layout, Road
from air.sources.simulated.sites.noise import fractal, smoothstep
from common.arrays import F64, I32, U8

COARSE_CELL = 0.2
"""Meadow and soil vary slowly: they are painted on a coarser grid, m, and enlarged."""
_SHIFT = 4

# RGB (gamma 2) and strength of the fine detail, 255 = 100 %.
GRASS = np.array([98, 108, 66, 58], np.float32)
LUSH = np.array([72, 92, 50, 62], np.float32)
DRY = np.array([146, 138, 100, 48], np.float32)
SOIL = np.array([138, 116, 94, 40], np.float32)
ASPHALT = (98, 99, 102, 16)
ASPHALT_NEW = (76, 77, 80, 12)
CRACK = (58, 58, 58, 12)
MARKING = (214, 214, 208, 10)
KERB = (150, 147, 140, 20)
PAVING = (158, 148, 136, 24)


def paint_ground(rng: np.random.Generator, layout: Layout, cell: float) -> U8:
    """Colour and detail strength (H, W, 4) uint8 of the ground on a grid of `cell` m over the layout's bounds."""
    canvas = Canvas(layout, cell, meadow(rng, layout, cell))
    canvas.scatter_stones(rng)
    for yard in layout.yards:
        canvas.pave(rng, yard)
    for box in layout.asphalt:
        canvas.polygon(box.corners(0.25), KERB)
        canvas.polygon(box.corners(), ASPHALT)
        canvas.repair(rng, box.corners()[[0, 1, 2, 3]].mean(0), box.heading, 10, box.a, box.b)
    for road in layout.roads:
        canvas.line(road.line, road.width + 1.0, tuple(int(c) for c in SOIL))
        canvas.line(road.line, road.width, ASPHALT)
    for road in layout.roads:
        canvas.finish_road(rng, road)
    return canvas.image


def meadow(rng: np.random.Generator, layout: Layout, cell: float) -> U8:
    """Colour and detail strength (H, W, 4) uint8 of grass, lush and dry, and of bare soil, over a layout's bounds."""
    rows, columns = layout.bounds.grid(cell)
    cells = max(1, round(COARSE_CELL / cell))
    coarse_shape, coarse_cell = (rows // cells + 2, columns // cells + 2), cell * cells

    def mask(low: float, high: float, *octaves: tuple[float, float]) -> np.typing.NDArray[np.float32]:
        return smoothstep(low, high, fractal(rng, coarse_shape, coarse_cell, octaves))[..., None]

    image = np.broadcast_to(GRASS, (*coarse_shape, 4)).astype(np.float32)
    for colour, weight in (
        (LUSH, mask(-0.8, 1.2, (30, 0.7), (6, 0.6), (1.6, 0.5))),
        (DRY, mask(-0.4, 1.8, (45, 0.7), (9, 0.6), (2.2, 0.5), (0.9, 0.4))),
        (SOIL, mask(0.75, 1.5, (25, 0.7), (5, 0.5), (1.2, 0.4))),
    ):
        image += (colour - image) * weight
    image[..., :3] *= 1 + fractal(rng, coarse_shape, coarse_cell, ((8, 0.05), (2, 0.06), (0.8, 0.06)))[..., None]
    small = np.clip(image, 0, 255).astype(np.uint8)
    enlarge = np.array([[1 / cells, 0, 0], [0, 1 / cells, 0]])
    return np.asarray(
        cv2.warpAffine(small, enlarge, (columns, rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP), np.uint8
    )


class Canvas:
    """Draws in world coordinates on the grid of colours."""

    def __init__(self, layout: Layout, cell: float, image: U8):
        self.layout, self.cell, self.image = layout, cell, np.ascontiguousarray(image)

    def pixels(self, xy: F64) -> I32:
        """Points (N, 2) m in world as OpenCV's fixed-point pixels."""
        return np.asarray(np.round(self.layout.bounds.pixels(xy, self.cell) * 2**_SHIFT), np.int32)

    def polygon(self, xy: F64, colour: tuple[int, ...]) -> None:
        """Fill a polygon (N, 2) m in world."""
        cv2.fillPoly(self.image, [self.pixels(xy)], colour, cv2.LINE_AA, _SHIFT)

    def line(self, xy: F64, width: float, colour: tuple[int, ...]) -> None:
        """A band of constant width around a polyline, as one polygon: OpenCV's thick lines are only whole pixels."""
        ahead = np.gradient(xy, axis=0)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) * (width / 2 / np.linalg.norm(ahead, axis=1))[:, None]
        self.polygon(np.concatenate([xy + left, (xy - left)[::-1]]), colour)

    def finish_road(self, rng: np.random.Generator, road: Road) -> None:
        """Repairs, cracks and markings."""
        steps = np.diff(road.line, axis=0)
        for i in range(4, len(steps) - 4, 9):
            heading = float(np.arctan2(steps[i, 1], steps[i, 0]))
            self.repair(rng, road.line[i], heading, 2, 4.0, road.width / 2 - 0.4)
        fine = _resample(road.line, 0.5)
        if road.width > 6:
            for i in range(0, len(fine) - 7, 18):
                self.line(fine[i : i + 7], 0.12, MARKING)
        ahead = np.gradient(fine, axis=0)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1)[:, None]
        for side in (-1.0, 1.0):
            self.line(fine + left * side * (road.width / 2 - 0.3), 0.10, MARKING)

    def repair(
        self, rng: np.random.Generator, centre: F64, heading: float, count: int, along: float, across: float
    ) -> None:
        """Patches of newer asphalt, cracks and stains in a rectangle of half sizes `along` × `across`."""
        for _ in range(count):
            u, v = rng.uniform(-1, 1) * along, rng.uniform(-1, 1) * across
            spot = Box(*_move(centre, heading, u, v), heading, rng.uniform(0.3, 1.8), rng.uniform(0.2, 0.7), 0.0)
            shade = rng.uniform(0.0, 1.0)
            if rng.random() < 0.4:
                self.polygon(spot.corners(), _between(ASPHALT, ASPHALT_NEW, shade))
            walk = np.cumsum(rng.normal(0, 0.22, (int(rng.integers(5, 18)), 2)) + rng.normal(0, 0.12, 2), axis=0)
            start = np.array(_move(centre, heading, v, u * across / along))
            self.line(start + walk, rng.uniform(0.04, 0.08), CRACK)
            x, y = self.pixels(np.array(_move(centre, heading, -u, -v)))
            radius = int(rng.uniform(0.05, 0.3) / self.cell * 2**_SHIFT)
            cv2.circle(self.image, (int(x), int(y)), radius, _between(ASPHALT, CRACK, shade), -1, cv2.LINE_AA, _SHIFT)

    def pave(self, rng: np.random.Generator, yard: Box) -> None:
        """Paving in slabs of irregular size and shade."""
        self.polygon(yard.corners(), PAVING)
        u = -yard.a
        while u < yard.a - 0.3:
            length = min(rng.uniform(0.4, 1.1), yard.a - u)
            v = -yard.b
            while v < yard.b - 0.3:
                width = min(rng.uniform(0.4, 1.1), yard.b - v)
                place = _move(np.array([yard.x, yard.y]), yard.heading, u + length / 2, v + width / 2)
                slab = Box(*place, yard.heading, length / 2 - 0.015, width / 2 - 0.015, 0.0)
                gain = rng.normal(1.0, 0.07)
                self.polygon(slab.corners(), (*(int(np.clip(c * gain, 0, 255)) for c in PAVING[:3]), PAVING[3]))
                v += width
            u += length

    def scatter_stones(self, rng: np.random.Generator) -> None:
        """Stones, molehills and litter: small, irregular, of all shades."""
        bounds = self.layout.bounds
        count = int((bounds.east - bounds.west) * (bounds.north - bounds.south) * 0.15)
        for x, y, size, shade in rng.uniform(0, 1, (count, 4)):
            centre = np.array([bounds.west, bounds.south]) + [x, y] * np.array(
                [bounds.east - bounds.west, bounds.north - bounds.south]
            )
            angle = np.sort(rng.uniform(0, 2 * np.pi, 6))
            radius = (0.04 + 0.22 * size**3) * rng.uniform(0.6, 1.2, 6)
            shape = centre + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            grey = int(60 + 130 * shade)
            self.polygon(shape, (grey, int(0.96 * grey), int(0.88 * grey), 30))


def _resample(line: F64, spacing: float) -> F64:
    """Points (M, 2) every `spacing` m along a polyline (N, 2)."""
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.arange(0.0, s[-1], spacing)
    return np.stack([np.interp(at, s, line[:, 0]), np.interp(at, s, line[:, 1])], axis=1)


def _move(centre: F64, heading: float, u: float, v: float) -> tuple[float, float]:
    c, s = np.cos(heading), np.sin(heading)
    return float(centre[0] + c * u - s * v), float(centre[1] + s * u + c * v)


def _between(first: tuple[int, ...], second: tuple[int, ...], share: float) -> tuple[int, ...]:
    return tuple(round(a + (b - a) * share) for a, b in zip(first, second, strict=True))
