"""A small textured site cut into tiles, and an aircraft that sends it: for tests of the ground."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from common.bus import Bus, Subscription
from common.camera import CameraModel
from common.keys import alive_key, all_of, stream_key, tile_key
from common.messages import (
    Datum,
    Health,
    Keyframe,
    Level,
    MapDigest,
    MapTile,
    Mode,
    Pose,
    TileId,
    TileRequest,
)
from common.se3 import SE3
from common.streams import DATUM, DIGEST, HEALTH, KEYFRAME, POSE, TILE, TILE_REQUEST
from common.wire import decode, encode

FLIGHT = "2024-05-01T10:00:00Z"
DATUM_HERE = Datum(FLIGHT, 50.8427, -0.1362, 42.0)
CAMERA = CameraModel(1280, 960, 1000.0, 1000.0, 639.5, 479.5)
ALTITUDE = 45.0


def surface(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Height m, world, of hills with boxes on them."""
    z = 2.5 * np.sin(east / 23) * np.cos(north / 31) + 1.2 * np.sin(north / 11 + east / 17)
    for x, y, side, tall in ((10, 12, 9, 6), (-22, 25, 12, 4), (30, -18, 7, 9), (-35, -30, 15, 5), (4, -40, 10, 3)):
        z = np.where((abs(east - x) < side / 2) & (abs(north - y) < side / 2), tall + 1.0, z)
    return z


def colour(east: np.ndarray, north: np.ndarray, z: np.ndarray) -> np.ndarray:
    """RGB of meadow, roofs, and a road."""
    rng = np.random.default_rng(7)
    noise = sum(
        cv2.resize(rng.normal(size=(s, s)), east.shape[::-1], interpolation=cv2.INTER_CUBIC) for s in (16, 64, 200)
    )
    rgb = np.stack([96 + 12 * noise, 124 + 14 * noise, 70 + 8 * noise], axis=-1)
    rgb[abs(north - 8 * np.sin(east / 30) + 5) < 2.2] = (110, 110, 114)
    ground = 2.5 * np.sin(east / 23) * np.cos(north / 31) + 1.2 * np.sin(north / 11 + east / 17)
    roof = abs(z - ground) > 0.05
    rgb[roof] = np.stack([172 + 8 * noise, 98 + 8 * noise, 80 + 8 * noise], axis=-1)[roof]
    return np.clip(rgb, 0, 255).astype(np.uint8)


def site_tile(x: int, y: int, revision: int = 1, n: int = 256, cell: float = 0.1, flight: str = FLIGHT) -> MapTile:
    """One tile of the site; the corners of the site are seen by one photo only, and a few cells are in dispute."""
    axis = (np.arange(n) + 0.5) * cell
    east, north = np.meshgrid(x * n * cell + axis, y * n * cell + axis)
    z = surface(east, north)
    radius = np.hypot(east, north)
    height = np.where(radius < 62, z, np.nan).astype(np.float32)
    views = np.clip(8 - radius / 10, 1, 7).astype(np.uint8)
    rng = np.random.default_rng([x & 0xFFFF, y & 0xFFFF])
    return MapTile(
        flight=flight,
        id=TileId(0, x, y),
        revision=revision,
        t_ns=revision * 10**9,
        cell=cell,
        height=height,
        sigma=np.where(np.isfinite(height), 0.02 + (radius / 62) ** 3 * 0.3, np.nan).astype(np.float32),
        colour=colour(east, north, z),
        views=np.where(np.isfinite(height), views, 0).astype(np.uint8),
        disputed=(rng.random((n, n)) < 0.01) & np.isfinite(height),
    )


def site_tiles(half: int = 2, revision: int = 1, n: int = 256, cell: float = 0.1) -> list[MapTile]:
    """The (2·half+1)² tiles around the datum."""
    span = range(-half - 1, half + 1) if n * cell < 1 else range(-half, half + 1)
    return [site_tile(x, y, revision, n, cell) for y in span for x in span]


def small_tile(x: int, y: int, revision: int = 1, flight: str = FLIGHT) -> MapTile:
    """A tile of 16 × 16 cells of 1 m: quick to encode."""
    return site_tile(x, y, revision, 16, 1.0, flight)


def nadir(east: float, north: float, yaw: float = 0.0) -> SE3:
    """`T_world_cam` of a camera that looks straight down from the survey's altitude."""
    c, s = np.cos(yaw), np.sin(yaw)
    return SE3(np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]]), np.array([east, north, ALTITUDE]))


def survey(photos: int = 30) -> list[Keyframe]:
    """Keyframes on parallel lines over the site, with thumbnails of what they see."""
    keyframes = []
    columns = 6
    for index in range(photos):
        line, step = divmod(index, columns)
        east = -50 + 100 * (step if line % 2 == 0 else columns - 1 - step) / (columns - 1)
        north = -45 + 90 * line / max(photos // columns - 1, 1)
        keyframes.append(keyframe(index, east, north))
    return keyframes


def keyframe(index: int, east: float = 0.0, north: float = 0.0, revision: int = 1, flight: str = FLIGHT) -> Keyframe:
    """One keyframe over a place of the site."""
    e, n = np.meshgrid(east + np.linspace(-28, 28, 96), north + np.linspace(21, -21, 72))
    picture = colour(e, n, surface(e, n))
    jpeg = cv2.imencode(".jpg", picture[..., ::-1])[1].tobytes()
    t_ns = (index + 1) * 2 * 10**9
    return Keyframe(
        flight, index, revision, t_ns, f"{index:04d}.jpg", nadir(east, north), CAMERA, np.full(3, 0.05), jpeg
    )


def pose(t_ns: int, east: float, north: float, yaw: float = 0.0, flight: str = FLIGHT) -> Pose:
    """Pose of the aircraft at the survey's altitude, level, heading `yaw` rad from east."""
    T = SE3.from_quaternion([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)], [east, north, ALTITUDE])
    return Pose(flight, t_ns, 0, T, np.array([3.0, 0, 0]), np.full(3, 0.1), Mode.PHOTOGRAMMETRIC)


class FakeAircraft:
    """Publishes encoded messages as the aircraft's uplink does, and sends tiles again when asked."""

    def __init__(self, bus: Bus, vehicle: str = "uav1", datum: Datum = DATUM_HERE) -> None:
        self.bus = bus
        self.vehicle = vehicle
        self.datum = datum
        self.tiles: dict[TileId, MapTile] = {}
        self.keyframes: dict[int, Keyframe] = {}
        self.requests = 0
        self._declared: list[Subscription] = [
            bus.subscribe(all_of(TILE_REQUEST, vehicle), self._send_again),
            bus.serve(all_of(KEYFRAME, vehicle), self._serve_keyframes),
            bus.declare_alive(alive_key(vehicle, "mapper")),
        ]

    def send_tile(self, tile: MapTile, lost: bool = False) -> None:
        """Make a tile part of the aircraft's map and publish it, unless it gets lost on the way."""
        self.tiles[tile.id] = tile
        if not lost:
            self.bus.publish(tile_key(self.vehicle, TILE, tile.id), encode(tile), TILE)

    def send_keyframe(self, kept: Keyframe) -> None:
        """Publish a keyframe."""
        self.keyframes[kept.index] = kept
        self.bus.publish(stream_key(self.vehicle, KEYFRAME, kept.index), encode(kept), KEYFRAME)

    def send_pose(self, where: Pose) -> None:
        """Publish a pose."""
        self.bus.publish(stream_key(self.vehicle, POSE), encode(where), POSE)

    def beat(self, t_ns: int = 0) -> None:
        """Publish what goes out once a second: datum, health, digest."""
        self.bus.publish(stream_key(self.vehicle, DATUM), encode(self.datum), DATUM)
        health = Health(t_ns, "mapper", Level.OK, "", {})
        self.bus.publish(stream_key(self.vehicle, HEALTH, "mapper"), encode(health), HEALTH)
        self.bus.publish(stream_key(self.vehicle, DIGEST), encode(self.digest(t_ns)), DIGEST)

    def digest(self, t_ns: int = 0) -> MapDigest:
        """What the aircraft's map holds."""
        rows = sorted((i.level, i.x, i.y, tile.revision) for i, tile in self.tiles.items())
        return MapDigest(self.datum.flight, t_ns, np.array(rows, np.int32).reshape(-1, 4))

    def close(self) -> None:
        """Fall silent."""
        for declared in self._declared:
            declared.close()

    def _send_again(self, _key: str, payload: bytes) -> None:
        for level, x, y in decode(TileRequest, payload).tiles.tolist():
            self.requests += 1
            tile = self.tiles[TileId(level, x, y)]
            self.bus.publish(tile_key(self.vehicle, TILE, tile.id), encode(tile), TILE)

    def _serve_keyframes(self, _key_expr: str, _payload: bytes) -> Iterable[tuple[str, bytes]]:
        kept = self.keyframes.values()
        return [(stream_key(self.vehicle, KEYFRAME, k.index), encode(k)) for k in kept]
