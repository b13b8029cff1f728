"""One browser: its camera, its panel and its drawings."""

from __future__ import annotations

import time
from collections.abc import Callable

import viser

from common.arrays import F64
from ground.viewer.aircraft import AircraftDrawing
from ground.viewer.levels import LevelCache
from ground.viewer.panel import Panel
from ground.viewer.scene import Scene
from ground.viewer.steering import Steering
from ground.viewer.tiles import TileDrawing, TileShown, height_range, map_box

PANEL_EVERY_S = 0.5


class ClientView:
    """Keeps one browser equal to the scene; called from one thread."""

    def __init__(
        self,
        client: viser.ClientHandle,
        station: str,
        min_views: int,
        budget: int,
        levels: LevelCache,
        on_tile: Callable[[TileShown], None],
    ) -> None:
        self._client = client
        self._steering = Steering(client.camera)
        self._panel = Panel(client.gui, station, min_views, self._steering.go_home)
        self._tiles = TileDrawing(client, levels, budget, on_tile)
        self._aircraft = AircraftDrawing(client.scene)
        self._z_range = (0.0, 0.0)
        self._panel_due = 0.0

    def update(self, scene: Scene) -> None:
        """Bring the browser up to date with a scene, within what one update may send."""
        self._z_range = height_range(scene, self._z_range)
        style = self._panel.style(self._z_range)
        with self._client.atomic():
            self._steering.update(map_box(scene), _p_aircraft(scene) if self._panel.follow else None)
            self._tiles.update(scene, self._steering.view, style, self._panel.point_size)
            self._aircraft.update(scene, self._steering.view.p_scene, self._panel.photos)
            if time.monotonic() >= self._panel_due:
                self._panel_due = time.monotonic() + PANEL_EVERY_S
                self._panel.update(scene, style, self._tiles.points)


def _p_aircraft(scene: Scene) -> F64 | None:
    """Position (3,) m in the scene of the aircraft heard last; None when there is none that can be placed."""
    for aircraft in sorted(scene.aircraft, key=lambda a: a.pose_age_s):
        T_scene_world = scene.T_scene_world(aircraft.flight)
        if T_scene_world is not None:
            return T_scene_world.apply(aircraft.pose.T_world_body.t)
    return None
