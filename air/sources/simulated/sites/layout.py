"""Where things stand in the simulated village: roads, houses, yards, containers, cars and trees on a map."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from common.arrays import F32, F64, U8

OCCUPANCY_CELL = 0.5


@dataclass(frozen=True)
class Bounds:
    """A rectangle in world, m."""

    west: float
    south: float
    east: float
    north: float

    def grid(self, cell: float) -> tuple[int, int]:
        """Rows and columns of a grid of nodes that covers the rectangle."""
        return int(np.ceil((self.north - self.south) / cell)) + 2, int(np.ceil((self.east - self.west) / cell)) + 2

    def pixels(self, xy: F64, cell: float) -> F64:
        """Grid coordinates (..., 2), column first, of points (..., 2) in world."""
        return np.asarray((xy - [self.west, self.south]) / cell)


@dataclass(frozen=True, eq=False)
class Road:
    """A centre line (N, 2) m in world, about a metre between points, and the width of the asphalt, m."""

    line: F64
    width: float


@dataclass(frozen=True)
class Box:
    """A box with its centre, heading from east, half length and half width, wall height and roof slope; m, rad."""

    x: float
    y: float
    heading: float
    a: float
    b: float
    wall_height: float
    slope: float = 0.0

    def corners(self, margin: float = 0.0) -> F64:
        """Footprint (4, 2) in world, m, widened by a margin."""
        u = np.array([-1, 1, 1, -1]) * (self.a + margin)
        v = np.array([-1, -1, 1, 1]) * (self.b + margin)
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.stack([self.x + c * u - s * v, self.y + s * u + c * v], axis=1)


@dataclass(frozen=True)
class House:
    """A house and, across it, perhaps a wing."""

    body: Box
    wing: Box | None = None


@dataclass(frozen=True)
class Car:
    """A parked car: a low box and a higher one."""

    body: Box
    cabin: Box


@dataclass(frozen=True)
class Tree:
    """A tree or bush: centre, crown radius and height above the ground, m."""

    x: float
    y: float
    radius: float
    height: float


@dataclass(eq=False)
class Layout:
    """Everything that stands or lies on the ground; `yards` are paved, `asphalt` are boxes of no height."""

    bounds: Bounds
    roads: list[Road] = field(default_factory=list)
    asphalt: list[Box] = field(default_factory=list)
    yards: list[Box] = field(default_factory=list)
    houses: list[House] = field(default_factory=list)
    containers: list[Box] = field(default_factory=list)
    cars: list[Car] = field(default_factory=list)
    trees: list[Tree] = field(default_factory=list)


def plan_village(rng: np.random.Generator, bounds: Bounds, density: F32, density_cell: float) -> Layout:
    """A random village: two crossing roads, houses along them, a container yard, trees where `density` is high."""
    plan = _Planner(rng, Layout(bounds))
    plan.lay_roads()
    plan.build_yard()
    plan.build_houses()
    plan.park_cars()
    plan.plant_trees(density, density_cell)
    return plan.layout


class _Planner:
    """Places things one after the other, each where the ground is still free."""

    def __init__(self, rng: np.random.Generator, layout: Layout):
        self.rng, self.layout = rng, layout
        self.taken: U8 = np.zeros(layout.bounds.grid(OCCUPANCY_CELL), np.uint8)

    def lay_roads(self) -> None:
        b, rng = self.layout.bounds, self.rng
        x0, y0 = rng.uniform(-15, 15, 2)
        for vertical, offset, width in ((False, y0, 6.5), (True, x0, 5.0)):
            low, high = (b.south, b.north) if vertical else (b.west, b.east)
            s = np.arange(low - 5, high + 5, 1.0)
            bend = (
                rng.uniform(3, 7) * np.sin(s / rng.uniform(28, 45) + rng.uniform(0, 6)) + 0.1 * rng.uniform(-1, 1) * s
            )
            line = np.stack([offset + bend, s] if vertical else [s, offset + bend], axis=1)
            self.layout.roads.append(Road(line, width))
            pixels = np.round(b.pixels(line, OCCUPANCY_CELL)).astype(np.int32)
            cv2.polylines(self.taken, [pixels], False, 255, round((width + 2.5) / OCCUPANCY_CELL))

    def build_yard(self) -> None:
        """An asphalt yard with containers in rows, at the first free place near a road."""
        for place in self._places_beside_roads(60, 17.0):
            yard = Box(*place, 15.0, 10.0, 0.0)
            if not self._take(yard, 0.5):
                continue
            self.layout.asphalt.append(yard)
            for row in (-6.5, -1.0, 6.0):
                for column in np.arange(-11, 12, 7.2):
                    if self.rng.random() < 0.55:
                        stacked = 2 if self.rng.random() < 0.25 else 1
                        turn = yard.heading + self.rng.normal(0, 0.03)
                        x, y = _inside(yard, column, row + self.rng.normal(0, 0.3))
                        self.layout.containers.append(Box(x, y, turn, 3.03, 1.22, 2.59 * stacked))
                    elif self.rng.random() < 0.5:
                        self._park(*_inside(yard, column, row), yard.heading + np.pi / 2)
            return

    def build_houses(self) -> None:
        wanted = (
            (self.layout.bounds.east - self.layout.bounds.west)
            * (self.layout.bounds.north - self.layout.bounds.south)
            / 1300
        )
        for x, y, heading in self._places_beside_roads(int(wanted * 5), 14.0, 40.0):
            if len(self.layout.houses) >= wanted:
                return
            a, b = self.rng.uniform(4.5, 7.5), self.rng.uniform(3.4, 4.8)
            flat = self.rng.random() < 0.3
            slope = 0.0 if flat else self.rng.uniform(0.45, 0.95)
            wall = self.rng.uniform(3.0, 7.5) if flat else self.rng.uniform(2.8, 5.0)
            house = Box(x, y, heading + self.rng.normal(0, 0.06), a, b, wall, slope)
            if not self._take(house, 3.0):
                continue
            wing = Box(*_inside(house, 0.4 * a, b), house.heading + np.pi / 2, b, 0.5 * a, 0.8 * wall, slope)
            winged = self.rng.random() < 0.45
            self.layout.houses.append(House(house, wing if winged else None))
            self.layout.yards.append(Box(*_inside(house, 0.0, -1.0), house.heading, a + 1.2, b + 2.2, 0.0))

    def park_cars(self) -> None:
        for road in self.layout.roads:
            for i in range(5, len(road.line) - 5, 3):
                if self.rng.random() < 0.12:
                    ahead = road.line[i + 1] - road.line[i - 1]
                    heading = float(np.arctan2(ahead[1], ahead[0]))
                    side = self.rng.choice([-1.0, 1.0]) * (road.width / 2 - 1.1)
                    x, y = road.line[i] + side * np.array([-np.sin(heading), np.cos(heading)])
                    self._park(float(x), float(y), heading)

    def plant_trees(self, density: F32, cell: float) -> None:
        b = self.layout.bounds
        count = int((b.east - b.west) * (b.north - b.south) / 22)
        for x, y, chance, size in self.rng.uniform(0, 1, (count, 4)):
            x, y = b.west + x * (b.east - b.west), b.south + y * (b.north - b.south)
            column, row = b.pixels(np.array([x, y]), cell)
            if chance > density[int(row), int(column)]:
                continue
            bush = size < 0.4
            radius = 0.4 + 2.0 * size if bush else 1.4 + 2.2 * (size - 0.4)
            height = radius * (1.6 if bush else 1.5) + (0.0 if bush else 1.8 + 3.0 * (size - 0.4))
            if self._take(Box(x, y, 0.0, 0.7 * radius, 0.7 * radius, 0.0), 0.2):
                self.layout.trees.append(Tree(x, y, radius, height))

    def _park(self, x: float, y: float, heading: float) -> None:
        turn = heading + self.rng.normal(0, 0.05)
        body = Box(x, y, turn, 2.15, 0.88, 0.85)
        if any(np.hypot(x - car.body.x, y - car.body.y) < 5.5 for car in self.layout.cars):
            return
        self.layout.cars.append(Car(body, Box(*_inside(body, -0.25, 0.0), turn, 1.15, 0.78, 1.45)))

    def _places_beside_roads(
        self, count: int, near: float, far: float | None = None
    ) -> list[tuple[float, float, float]]:
        """Random places (x, y, heading along the road) at a distance from a centre line, away from the world's edge."""
        places = []
        for _ in range(count):
            road = self.layout.roads[int(self.rng.integers(len(self.layout.roads)))]
            i = int(self.rng.integers(len(road.line) // 6 + 1, len(road.line) * 5 // 6 - 1))
            ahead = road.line[i + 1] - road.line[i - 1]
            heading = float(np.arctan2(ahead[1], ahead[0]))
            distance = self.rng.choice([-1.0, 1.0]) * self.rng.uniform(near, far or near + 3.0)
            x, y = road.line[i] + distance * np.array([-np.sin(heading), np.cos(heading)])
            places.append((float(x), float(y), heading))
        return places

    def _take(self, box: Box, margin: float) -> bool:
        """Claim the ground of a box with a margin, unless some of it is taken."""
        mask = np.zeros_like(self.taken)
        corners = np.round(self.layout.bounds.pixels(box.corners(margin), OCCUPANCY_CELL)).astype(np.int32)
        (c0, r0), (c1, r1) = np.maximum(corners.min(0), 0), corners.max(0) + 1
        window = (slice(r0, max(r1, r0)), slice(c0, max(c1, c0)))
        cv2.fillConvexPoly(mask, corners, 255)
        if (self.taken[window] & mask[window]).any():
            return False
        self.taken[window] |= mask[window]
        return True


def _inside(box: Box, u: float, v: float) -> tuple[float, float]:
    """World coordinates of a point given along the axes of a box."""
    c, s = np.cos(box.heading), np.sin(box.heading)
    return float(box.x + c * u - s * v), float(box.y + s * u + c * v)
