"""A small map with a known surface, and what it should become in the georeferenced products."""

from collections.abc import Callable

import numpy as np

from common.camera import CameraModel
from common.messages import Datum, Keyframe, MapTile, TileId
from common.se3 import SE3

N = 32
HeightOf = Callable[[np.ndarray, np.ndarray], np.ndarray]

TILTED = Datum("2024-05-01T10:00:00", 48.9, -123.2, 50.0)


def plane(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    return 3.0 + 0.2 * east - 0.1 * north


def colour_of(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Colours that change slowly, so that resampling by a fraction of a cell hardly alters them."""
    return np.stack([128 + 2 * east, 128 + 2 * north, 128 + east - north], axis=-1).clip(0, 255).astype(np.uint8)


def tile(x: int, y: int, height_of: HeightOf = plane, cell: float = 0.25, revision: int = 1) -> MapTile:
    centres = np.arange(N) + 0.5
    east, north = np.meshgrid((x * N + centres) * cell, (y * N + centres) * cell)
    return MapTile(
        flight=TILTED.flight,
        id=TileId(0, x, y),
        revision=revision,
        t_ns=0,
        cell=cell,
        height=height_of(east, north).astype(np.float32),
        sigma=np.full((N, N), 0.05, np.float32),
        colour=colour_of(east, north),
        views=np.full((N, N), 3, np.uint8),
        disputed=np.zeros((N, N), np.bool_),
    )


def tiles(height_of: HeightOf = plane, cell: float = 0.25, radius: int = 2) -> list[MapTile]:
    places = range(-radius, radius)
    return [tile(x, y, height_of, cell) for x in places for y in places]


def keyframes(count: int = 5) -> list[Keyframe]:
    camera = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)
    down = np.diag([1.0, -1.0, -1.0])
    return [
        Keyframe(
            flight=TILTED.flight,
            index=i,
            revision=0,
            t_ns=1_700_000_000_123_456_789 + i * 2_000_000_000,
            name=f"photo_{i}.jpg",
            T_world_cam=SE3(down, np.array([3.0 * i, -1.5 * i, 40.0 + 0.1 * i])),
            camera=camera,
            sigma=np.array([0.1, 0.1, 0.2]),
            thumbnail=b"",
        )
        for i in range(count)
    ]
