"""Drawing of the map's tiles in one browser: each at the level its camera needs, only what changed sent again."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import viser

from common.arrays import F64, I64
from common.errors import WireError
from common.messages import TileId
from common.se3 import SE3
from ground.cloud import FlightId, HeldTile
from ground.viewer.detail import View, choose_levels
from ground.viewer.levels import LevelCache
from ground.viewer.points import Colouring, Style, tile_points
from ground.viewer.scene import PlacedTile, Scene, node_name

TILES_PER_UPDATE = 24
HIDDEN = -1


@dataclass(frozen=True)
class TileShown:
    """A revision of a tile was handed to the web server for a browser; `monotonic_ns` as of `time.monotonic_ns`."""

    client: int
    flight: FlightId
    id: TileId
    revision: int
    level: int
    monotonic_ns: int


@dataclass(frozen=True, eq=False)
class _Sent:
    """What a browser shows of a tile: the same again need not be sent."""

    revision: int
    level: int
    style: Style
    points: int
    centre: F64
    node: viser.PointCloudHandle


class TileDrawing:
    """Keeps the point clouds of one browser equal to the scene."""

    def __init__(
        self, client: viser.ClientHandle, levels: LevelCache, budget: int, on_tile: Callable[[TileShown], None]
    ) -> None:
        self._client = client
        self._levels = levels
        self._budget = budget
        self._on_tile = on_tile
        self._sent: dict[tuple[FlightId, TileId], _Sent] = {}

    @property
    def points(self) -> int:
        """Points that the browser draws."""
        return sum(sent.points for sent in self._sent.values())

    def update(self, scene: Scene, view: View, style: Style, point_size: float) -> None:
        """Send what changed for a camera and a style, within what one update may send; `point_size` in cells."""
        places = scene.placed
        self._remove_others({(place.held.flight, place.held.id) for place in places})
        levels, distance = self._choose(scene, view)
        due = [i for i, place in enumerate(places) if self._differs(place.held, int(levels[i]), style)]
        # What is new on the ground comes before what is merely finer, and the near before the far.
        due.sort(key=lambda i: (not self._outdated(places[i].held), distance[i]))
        for i in due[:TILES_PER_UPDATE]:
            self._send(places[i], int(levels[i]), style, point_size)
        self._resize({(place.held.flight, place.held.id): place.held.cell for place in places}, point_size)

    def _choose(self, scene: Scene, view: View) -> tuple[I64, F64]:
        """Level (M,) of each placed tile for the camera, and its distance (M,) m."""
        tiles = [placed.held for placed in scene.placed]
        cell = np.array([held.cell for held in tiles])
        side = cell * np.array([held.cells for held in tiles])
        relief = np.array([held.z_high - held.z_low for held in tiles])
        known = np.array([held.known for held in tiles], float)
        previous = np.array([self._level(held) for held in tiles], np.int64)
        radius = np.hypot(side * 0.71, relief / 2)
        levels = choose_levels(view, scene.centres, radius, cell, known, self._budget, previous)
        return levels, np.linalg.norm(scene.centres - view.p_scene, axis=1)

    def _send(self, place: PlacedTile, level: int, style: Style, point_size: float) -> None:
        held, sent = place.held, self._sent.get((place.held.flight, place.held.id))
        # The browser may apply a new position of a node before or after its new points: it must not change.
        centre = held.centre if sent is None else sent.centre
        try:
            tile = self._levels.level(held, level)
        except WireError:
            return
        points, colours = tile_points(tile, centre, _in_world(style, place.T_scene_world))
        node = self._client.scene.add_point_cloud(
            f"/map/{node_name(held.flight)}/{held.id.level}_{held.id.x}_{held.id.y}",
            points,
            colours,
            point_size=point_size * tile.cell,
            point_shape="circle",
            point_shading="flat",
            position=tuple(place.T_scene_world.apply(centre)),
            wxyz=tuple(place.T_scene_world.wxyz),
        )
        new = self._outdated(held)
        self._sent[held.flight, held.id] = _Sent(held.revision, level, style, len(points), centre, node)
        if new:
            now_ns = time.monotonic_ns()
            self._on_tile(TileShown(self._client.client_id, held.flight, held.id, held.revision, level, now_ns))

    def _remove_others(self, wanted: set[tuple[FlightId, TileId]]) -> None:
        for place in self._sent.keys() - wanted:
            self._sent.pop(place).node.remove()

    def _resize(self, cells: dict[tuple[FlightId, TileId], float], point_size: float) -> None:
        for place, sent in self._sent.items():
            size = point_size * cells[place] * 2**sent.level
            if abs(sent.node.point_size - size) > 1e-6:
                sent.node.point_size = size

    def _differs(self, held: HeldTile, level: int, style: Style) -> bool:
        sent = self._sent.get((held.flight, held.id))
        return sent is None or (sent.revision, sent.level, sent.style) != (held.revision, level, style)

    def _outdated(self, held: HeldTile) -> bool:
        sent = self._sent.get((held.flight, held.id))
        return sent is None or sent.revision != held.revision

    def _level(self, held: HeldTile) -> int:
        sent = self._sent.get((held.flight, held.id))
        return HIDDEN if sent is None else sent.level


def height_range(scene: Scene, previous: tuple[float, float]) -> tuple[float, float]:
    """Heights m in the scene that span the colours; the previous ones while they are within a tenth of the span."""
    tiles = scene.placed
    if not tiles:
        return previous
    low = float(np.quantile([place.held.z_low + place.T_scene_world.t[2] for place in tiles], 0.1))
    high = float(np.quantile([place.held.z_high + place.T_scene_world.t[2] for place in tiles], 0.9))
    tolerance = 0.1 * max(high - low, 1.0)
    near = abs(low - previous[0]) <= tolerance and abs(high - previous[1]) <= tolerance
    return previous if near else (low, high)


def map_box(scene: Scene) -> tuple[F64, F64] | None:
    """Corners (3,) and (3,) m in the scene of the box around the tiles of the newest flight; None without tiles."""
    if not scene.placed:
        return None
    flights = [placed.held.flight.flight for placed in scene.placed]
    newest = np.array(flights) == max(flights)
    centres = scene.centres[newest]
    sides = np.array([placed.held.cell * placed.held.cells for placed in scene.placed])[newest]
    half = sides.max() / 2 * np.array([1.0, 1.0, 0.0])
    return centres.min(axis=0) - half, centres.max(axis=0) + half


def _in_world(style: Style, T_scene_world: SE3) -> Style:
    """The style with the heights of its colours in the world of a flight."""
    if style.colouring is not Colouring.HEIGHT:
        return style
    low, high = style.z_range
    return replace(style, z_range=(low - float(T_scene_world.t[2]), high - float(T_scene_world.t[2])))
