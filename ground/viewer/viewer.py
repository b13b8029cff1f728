"""The web server that shows the scene to every browser."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
import threading
from collections.abc import Callable

import numpy as np
import viser

from common.errors import ConfigError
from ground.config import ViewerConfig
from ground.viewer.client import ClientView
from ground.viewer.levels import LevelCache
from ground.viewer.scene import SceneSource
from ground.viewer.tiles import TileShown

log = logging.getLogger(__name__)

UPDATE_EVERY_S = 0.1
_SKY = ((38, 50, 64), (148, 163, 177))


class Viewer:
    """Serves a page that follows the scene; each browser has its own camera, choices and level of detail."""

    def __init__(self, config: ViewerConfig, station: str, min_views: int, scene: SceneSource) -> None:
        """Start serving. Raises ConfigError, which names host and port, when the port is taken."""
        _require_free(config.host, config.port)
        self._config = config
        self._station = station
        self._min_views = min_views
        self._scene = scene
        self._levels = LevelCache(min_views)
        self._views: dict[int, ClientView] = {}
        self._on_tile: list[Callable[[TileShown], None]] = []
        self._stopped = threading.Event()
        # A browser that goes away during its handshake is no error of ours, yet it would be logged with a trace.
        logging.getLogger("websockets").setLevel(logging.CRITICAL)
        with _silence():
            self._server = viser.ViserServer(config.host, config.port, label="Luojia", verbose=False)
        if self._server.get_port() != config.port:
            self._server.stop()
            raise _port_taken(config.host, config.port)
        self._dress()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return f"http://{self._config.host}:{self._config.port}"

    def on_tile_shown(self, callback: Callable[[TileShown], None]) -> None:
        """Have `callback` called, on the viewer's thread, whenever a revision of a tile is handed to a browser."""
        self._on_tile.append(callback)

    def close(self) -> None:
        """Stop serving."""
        self._stopped.set()
        self._thread.join(timeout=5.0)
        with _silence():
            self._server.stop()

    def _dress(self) -> None:
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(28, 126, 214))
        self._server.scene.set_up_direction("+z")
        self._server.scene.set_background_image(_sky())
        self._server.initial_camera.position = (0.0, -60.0, 50.0)
        self._server.initial_camera.look_at = (0.0, 0.0, 0.0)

    def _run(self) -> None:
        while not self._stopped.wait(UPDATE_EVERY_S):
            clients = self._server.get_clients()
            for gone in self._views.keys() - clients.keys():
                del self._views[gone]
            scene = self._scene()
            for number, client in clients.items():
                try:
                    self._view(number, client).update(scene)
                except Exception:
                    # A browser that leaves in the middle of an update must not end the others.
                    if number in self._server.get_clients():
                        log.exception("browser %d could not be updated", number)

    def _view(self, number: int, client: viser.ClientHandle) -> ClientView:
        if number not in self._views:
            self._views[number] = ClientView(
                client, self._station, self._min_views, self._config.point_budget, self._levels, self._tile_shown
            )
        return self._views[number]

    def _tile_shown(self, shown: TileShown) -> None:
        for callback in self._on_tile:
            callback(shown)


def _silence() -> contextlib.redirect_stdout[io.StringIO]:
    """viser prints a banner and a farewell, whatever `verbose` says."""
    return contextlib.redirect_stdout(io.StringIO())


def _sky() -> np.ndarray:
    share = np.linspace(0, 1, 256)[:, None, None]
    return np.repeat(np.asarray(_SKY[0]) * (1 - share) + np.asarray(_SKY[1]) * share, 4, axis=1).astype(np.uint8)


def _require_free(host: str, port: int) -> None:
    """Raises ConfigError when nobody can listen there: viser would silently take the next port."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise _port_taken(host, port) from error


def _port_taken(host: str, port: int) -> ConfigError:
    return ConfigError(
        f"viewer.host, viewer.port: {host}:{port} is taken or not an address of this machine; set a free one"
    )
