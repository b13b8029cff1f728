"""The tracker on synthetic images: known motion, exposure, blur, darkness, rows, spread, and what has changed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from air.odometry.settings import TrackerSettings
from air.odometry.tracker import TrackedFrame, Tracker
from common.arrays import F64, U8
from common.camera import CameraModel
from common.se3 import rotation_vector_to_matrix

CAMERA = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5, -0.05, 0.01)


def texture(height: int = 800, width: int = 1000, seed: int = 1) -> U8:
    """Blobs of several sizes."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width), np.float32)
    for sigma in (2, 4, 9):
        image += cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), sigma) * sigma
    image = 128 + 40 * image / image.std()
    return np.clip(image, 0, 255).astype(np.uint8)


GROUND = texture()


def view(shift: tuple[float, float] = (0.0, 0.0), turn: float = 0.0) -> U8:
    """The ground, moved by px and turned about the image's centre by rad."""
    M = cv2.getRotationMatrix2D((500.0, 400.0), np.degrees(turn), 1.0)
    M[:, 2] += np.array([319.5 - 500.0, 239.5 - 400.0]) + shift
    return np.asarray(cv2.warpAffine(GROUND, M, (640, 480), flags=cv2.INTER_CUBIC), np.uint8)


def moved(first: TrackedFrame, second: TrackedFrame) -> tuple[F64, F64]:
    """Places (M, 2) of the common points in both."""
    _, a, b = np.intersect1d(first.ids, second.ids, return_indices=True)
    return first.uv[a], second.uv[b]


def track(*images: U8, settings: TrackerSettings | None = None, line_time_s: float = 0.0) -> list[TrackedFrame]:
    tracker = Tracker(CAMERA, settings)
    return [tracker.track(image, k, np.eye(3), line_time_s) for k, image in enumerate(images)]


@pytest.mark.parametrize("shift", [(3.3, -2.7), (14.25, 8.5), (-30.0, 11.0)])
def test_a_shift_is_found_to_a_fraction_of_a_pixel(shift: tuple[float, float]) -> None:
    first, second = track(view(), view(shift))
    a, b = moved(first, second)
    assert len(a) > 60
    # Interpolation of the warped image, and corners that leave a window at its border.
    assert np.median(np.linalg.norm(b - a - shift, axis=1)) < 0.1


def test_the_gyroscope_helps_where_the_turn_is_large() -> None:
    turn = 0.35
    images = view(), view(turn=turn)
    R_last_now = rotation_vector_to_matrix(np.array([0.0, 0.0, turn]))
    counts = {}
    for name, R in (("with", R_last_now), ("against", R_last_now.T), ("without", np.eye(3))):
        tracker = Tracker(CAMERA)
        first, second = tracker.track(images[0], 0, np.eye(3)), tracker.track(images[1], 1, R)
        counts[name] = len(moved(first, second)[0])
    assert counts["with"] > 30
    assert counts["with"] > 2 * max(counts["without"], counts["against"])


@pytest.mark.parametrize("gain", [0.35, 1.6])
def test_a_change_of_exposure_loses_few_points(gain: float) -> None:
    lit = np.clip(gain * view((4.0, 2.0)).astype(np.float64), 0, 255).astype(np.uint8)
    first, second = track(view(), lit)
    a, b = moved(first, second)
    assert len(a) > 0.5 * len(first.ids)
    assert np.median(np.linalg.norm(b - a - [4.0, 2.0], axis=1)) < 0.2


def test_motion_blur_is_survived() -> None:
    streak = np.zeros((9, 9), np.float32)
    streak[4] = 1 / 9
    blurred = np.asarray(cv2.filter2D(view((5.0, 0.0)), -1, streak), np.uint8)
    first, second = track(view(), blurred)
    a, b = moved(first, second)
    assert len(a) > 30
    assert np.median(np.linalg.norm(b - a - [5.0, 0.0], axis=1)) < 0.5


@pytest.mark.parametrize("image", [np.zeros((480, 640), np.uint8), np.full((480, 640), 255, np.uint8)])
def test_dark_and_dazzled_images_are_blind_and_sight_comes_back(image: U8) -> None:
    seeing, blind, again = track(view(), image, view((1.0, 1.0)))
    assert not seeing.blind
    assert blind.blind
    assert not len(blind.ids)
    assert not again.blind
    assert again.new.all()
    assert not set(again.ids) & set(seeing.ids)  # an id is never used twice


def test_rows_are_exposed_one_after_the_other() -> None:
    (frame,) = track(view(), line_time_s=30e-6)
    np.testing.assert_allclose(frame.row_dt_s, (frame.uv[:, 1] - 239.5) * 30e-6)
    assert frame.row_dt_s.min() < 0 < frame.row_dt_s.max()


def test_rays_are_unit_vectors_that_appear_where_the_points_were_seen() -> None:
    (frame,) = track(view())
    np.testing.assert_allclose(np.linalg.norm(frame.rays, axis=1), 1.0)
    np.testing.assert_allclose(CAMERA.project(frame.rays), frame.uv, atol=1e-3)


def test_points_are_spread_and_no_more_than_asked_for() -> None:
    settings = TrackerSettings(features=50, spacing=60.0)
    for frame in track(view(), view((2.0, 0.0)), settings=settings):
        assert 30 < len(frame.ids) <= 50
        distance = np.linalg.norm(frame.uv[:, None] - frame.uv[None], axis=2) + 1e3 * np.eye(len(frame.uv))
        assert distance.min() > 40.0


def test_points_that_crowd_together_make_room() -> None:
    """As in a climb: each image shows more, and what was seen shrinks to its middle."""
    images = [cv2.resize(GROUND, None, fx=z, fy=z, interpolation=cv2.INTER_AREA) for z in np.linspace(2.0, 0.9, 12)]
    middles = [(im.shape[0] // 2, im.shape[1] // 2) for im in images]
    views = [
        np.ascontiguousarray(im[v - 240 : v + 240, u - 320 : u + 320])
        for im, (v, u) in zip(images, middles, strict=True)
    ]
    last = track(*views)[-1]
    distance = np.linalg.norm(last.uv[:, None] - last.uv[None], axis=2) + 1e3 * np.eye(len(last.uv))
    assert distance.min() > 0.4 * TrackerSettings().spacing
    assert np.ptp(last.uv[:, 0]) > 500
    assert (~last.new).sum() > 20


def test_what_is_covered_by_something_else_is_not_followed() -> None:
    second = view((6.0, 0.0))
    second[160:320, 230:430] = texture(160, 200, seed=9)
    first, after = track(view(), second)
    a, b = moved(first, after)
    assert len(a) > 50
    # A point may by chance lie on its epipolar line; the window finds it.
    assert np.mean(np.linalg.norm(b - a - [6.0, 0.0], axis=1) > 2.0) < 0.05


def test_points_can_be_forgotten() -> None:
    tracker = Tracker(CAMERA)
    first = tracker.track(view(), 0, np.eye(3))
    tracker.forget(first.ids[:20])
    second = tracker.track(view(), 1, np.eye(3))
    assert not set(first.ids[:20].tolist()) & set(second.ids.tolist())


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="other size"):
        Tracker(CAMERA).track(np.zeros((10, 10), np.uint8), 0, np.eye(3))


def test_the_same_images_give_the_same_points() -> None:
    runs = [track(view(), view((3.0, 1.0)), view((7.0, 2.0))) for _ in range(2)]
    for a, b in zip(*runs, strict=True):
        assert a.uv.tobytes() == b.uv.tobytes()
