"""The map of a flight while it grows: what is new comes first, and every photo is accounted for."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from mapping_scene import BOXES, Scene, block

from air.alignment.prepare import prepare
from air.alignment.settings import AlignmentSettings
from air.config import AirConfig
from air.live import T_CAM_BODY, LiveMap
from air.mapping.mapper import Mapper
from air.mapping.settings import MappingSettings
from air.sources.source import Problem
from common.messages import GnssFix, Level, Photo
from common.se3 import SE3

FLIGHT = "2024-05-01T10:00:00Z"
SCENE = Scene(BOXES)
FRAMES = block(2, 3)


@pytest.fixture(scope="module")
def images() -> dict[int, np.ndarray]:
    return {k.index: SCENE.photo(k.camera, k.T_world_cam, k.index) for k in FRAMES}


def tiles_after(images: dict[int, np.ndarray], moves: int | None) -> tuple[list, list]:  # type: ignore[type-arg]
    """What one more photo gives when it moves all others by two metres, and the map in the end."""
    lift = SE3(np.eye(3), np.array([0.3, 0.2, -2.0]))
    mapper = Mapper(MappingSettings(threads=1))
    for index, image in images.items():
        mapper.add_image(index, image)
    mapper.update(FLIGHT, [replace(k, T_world_cam=lift @ k.T_world_cam) for k in FRAMES[:-1]])
    first = mapper.update(FLIGHT, [*(replace(k, revision=2) for k in FRAMES[:-1]), FRAMES[-1]], moves=moves)
    while mapper.update(FLIGHT, [], moves=1):
        pass
    return first, mapper.tiles()


def test_what_is_new_need_not_wait_for_what_moved_and_the_map_ends_the_same(images: dict[int, np.ndarray]) -> None:
    all_at_once, expected = tiles_after(images, None)
    new_first, tiles = tiles_after(images, 0)
    assert 0 < len(new_first) <= len(all_at_once)
    assert [t.id for t in tiles] == [t.id for t in expected]
    for tile, other in zip(tiles, expected, strict=True):
        np.testing.assert_array_equal(tile.height, other.height)
        np.testing.assert_array_equal(tile.views, other.views)


def test_the_body_of_a_camera_that_looks_down_is_level_with_the_top_of_the_image_ahead() -> None:
    azimuth = np.radians(30.0)  # of the top of the image, from north, clockwise
    ahead = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    right = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    T_world_cam = SE3(np.stack([right, -ahead, [0.0, 0.0, -1.0]], axis=1), np.array([1.0, 2.0, 3.0]))
    T_world_body = T_world_cam @ T_CAM_BODY
    np.testing.assert_allclose(T_world_body.R, np.stack([ahead, -right, [0.0, 0.0, 1.0]], axis=1), atol=1e-12)
    np.testing.assert_allclose(T_world_body.t, [1.0, 2.0, 3.0])


def photo(name: str, image: np.ndarray, t_ns: int) -> Photo:
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    return Photo(t_ns, name, jpeg, None, GnssFix(50.0, 0.0, 40.0, 1.5, 3.0))


def test_every_photo_is_accounted_for_with_the_last_problem() -> None:
    live = LiveMap(FLIGHT, AirConfig())
    assert live.condition([]).text == "0 read"
    rng = np.random.default_rng(1)
    black = np.zeros((480, 640, 3), np.uint8)
    others = [cv2.resize(rng.integers(0, 255, (120, 160, 3), np.uint8), (640, 480)) for _ in range(2)]
    for number, image in enumerate([others[0], black, others[1]]):
        prepared = prepare(photo(f"{number}.jpg", image, number), AlignmentSettings())
        growth = live.grow(live.align(prepared))
        assert (growth.keyframes, growth.tiles, growth.poses) == ([], [], [])
    condition = live.condition([Problem("0.jpg", "has no clock time"), Problem("9.jpg", "has no GPS position")])
    assert condition.text.startswith("3 read, 2 waiting, 1 rejected; 2.jpg: matches no photo")
    assert condition.counts == {"read": 3, "placed": 0, "waiting": 2, "rejected": 1, "problems": 4}
    assert condition.level is Level.DEGRADED
    assert condition.datum is None
