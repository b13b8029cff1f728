"""What the simulated video camera draws, measured in its images against the projection of known points."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from video_scene import Gliding, camera, fiducial_site, project

from air.sources.simulated.camera.video import CameraOptions, Exposure
from air.sources.simulated.clocks import ClockOptions
from air.sources.simulated.sites.layout import Box
from common.measurements import Encoding

PERFECT = CameraOptions.perfect()
FAST = Gliding(np.array([1.0, -2.0, 40.0]), np.array([4.0, 1.5, -0.5]), np.array([0.25, -0.3, 0.4]))
"""Three times as fast as a survey with gusts."""
BLOBS = np.stack(np.meshgrid(np.arange(-44.0, 45.0, 8.8), np.arange(-24.0, 25.0, 6.1)), axis=-1).reshape(-1, 2)
WINDOW = 9


@pytest.fixture(scope="module")
def ground():
    """Rolling ground with fiducials off the raster of texels."""
    return fiducial_site(BLOBS + np.random.default_rng(5).uniform(-1.5, 1.5, BLOBS.shape))


@pytest.fixture(scope="module")
def blobs():
    """Where the fiducials are."""
    return BLOBS + np.random.default_rng(5).uniform(-1.5, 1.5, BLOBS.shape)


def offsets(light: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """How far (N, 2) px the centroids of bright spots lie from where they are expected."""
    found = []
    for u, v in expected:
        column, row = round(u), round(v)
        part = light[row - WINDOW : row + WINDOW + 1, column - WINDOW : column + WINDOW + 1].astype(float)
        weight = np.clip(part - np.quantile(part, 0.3), 0, None) ** 2
        y, x = np.mgrid[-WINDOW : WINDOW + 1, -WINDOW : WINDOW + 1]
        found.append([column + np.average(x, weights=weight) - u, row + np.average(y, weights=weight) - v])
    return np.array(found)


def inside(model, pixels: np.ndarray) -> np.ndarray:
    margin = 2 * WINDOW
    return np.all((pixels > margin) & (pixels < [model.width - margin, model.height - margin]), axis=1)


@pytest.mark.parametrize(
    ("shutter", "exposure_ms"),
    [(0.0, 0.0), (30.0, 0.0), (0.0, 12.0), (30.0, 12.0)],
    ids=["still", "rolling", "blurred", "both"],
)
def test_surface_points_appear_where_the_pose_of_their_row_projects_them(ground, blobs, shutter, exposure_ms) -> None:
    options = replace(
        PERFECT, rolling_shutter=shutter, motion_blur=float(exposure_ms > 0), exposure_ms=exposure_ms or 4.0
    )
    cam = camera(ground, FAST, options)
    poses = cam.poses(0.7)
    image, *_ = cam.expose(0.7, Exposure(options), np.random.default_rng(0))
    p_world = np.column_stack([blobs, ground.height(blobs)])
    pixels = project(cam.model, poses, p_world)
    pixels = pixels[inside(cam.model, pixels)]
    assert len(pixels) > 40
    off = offsets((image[..., 1] / 255.0) ** 2, pixels)
    # A slope of a few degrees under a spot two pixels wide moves its centroid by some hundredths of a pixel.
    assert np.abs(off.mean(axis=0)).max() < 0.03
    assert np.sqrt(np.mean(off**2)) < 0.05
    assert np.linalg.norm(off, axis=1).max() < 0.1
    if shutter:
        # Without the poses of the rows the same points would lie pixels off.
        still = camera(ground, FAST, replace(options, rolling_shutter=0.0))
        assert np.abs(project(cam.model, still.poses(0.7), p_world) - project(cam.model, poses, p_world)).max() > 1.0


def test_motion_blur_is_the_mean_of_the_images_within_the_exposure(ground) -> None:
    options = replace(PERFECT, motion_blur=1.0, exposure_ms=12.0, rolling_shutter=20.0)
    cam = camera(ground, FAST, options)
    blurred, *_ = cam.expose(0.7, Exposure(options), np.random.default_rng(0))
    t_s = 0.7 + 0.012 * ((np.arange(12) + 0.5) / 12 - 0.5)
    mean = np.mean([cam.look(cam.poses(t)).copy() for t in t_s], axis=0) * (207.0 * 0.012)
    inner = (slice(20, -20), slice(20, -20))
    difference = 255 * np.sqrt(np.clip(mean, 0, 1)) - blurred
    # The camera interpolates in one image where the oracle renders twelve: a few grey values on the edges of spots.
    assert np.sqrt(np.mean(difference[inner] ** 2)) < 1.0
    assert np.abs(difference[inner]).max() < 14


def test_the_outline_of_a_roof_is_where_its_corners_project() -> None:
    box = Box(6.0, 3.0, 0.4, 7.0, 4.0, 8.0)
    site = fiducial_site(np.zeros((0, 2)), relief=0.0, boxes=(box,))
    cam = camera(site, FAST, replace(PERFECT, rolling_shutter=30.0))
    poses = cam.poses(0.5)
    light = cam.look(poses)[..., 1]
    corners = np.column_stack([box.corners(), np.full(4, 8.0)])
    edge = np.concatenate(
        [a + np.linspace(0, 1, 40)[:, None] * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)]
    )
    outline = project(cam.model, poses, edge)
    roof = np.zeros((light.shape[0] * 8, light.shape[1] * 8), np.uint8)
    cv2.fillPoly(roof, [np.round((outline + 0.5) * 8 - 0.5).astype(np.int32)], 255)
    expected = cv2.resize(roof, light.shape[::-1], interpolation=cv2.INTER_AREA) / 255.0
    centre = np.round(outline.mean(axis=0)).astype(int)
    drawn = light / light[centre[1], centre[0]]
    near = cv2.dilate(roof[::8, ::8], np.ones((5, 5)))
    # Four rays a pixel know its share of the roof to an eighth; walls, which are as white, are darker or behind.
    wrong = (np.abs(drawn - expected) > 0.4) & (near > 0) & (expected > 0.5)
    assert wrong.sum() < 0.02 * len(np.argwhere((expected > 0) & (expected < 1)))


@pytest.mark.parametrize("height", [12.0, 60.0, 180.0])
def test_from_any_height_each_pixel_meets_what_its_own_ray_meets(height) -> None:
    # So few pixels that the beam of a block is metres wide, far wider than a cell of the index.
    places = np.random.default_rng(3).uniform(-28, 28, (40, 2))
    boxes = tuple(Box(x, y, 0.3 * n, 1.5, 1.5, 2.0 + 0.2 * n) for n, (x, y) in enumerate(places))
    site = fiducial_site(np.zeros((0, 2)), boxes=boxes)
    above = Gliding(np.array([3.0, -2.0, height]), np.zeros(3), np.zeros(3))
    cam = camera(site, above, replace(PERFECT, width=128, height=72))
    poses = cam.poses(0.5)
    cam.look(poses)
    R, p = poses.R_world_cam[36], poses.p_world[36]
    rays = np.concatenate([cam._rays, np.ones((72, 128, 1))], axis=-1).reshape(-1, 3) @ R.T
    met, solid = site.intersect(p, rays)
    assert np.count_nonzero(solid >= 0) > 3
    assert np.array_equal(cam._what.ravel() >> 4, solid)
    assert np.abs(cam._depth.ravel() - (met - p) @ R[:, 2]).max() < 1e-3 * height


def test_the_same_frames_come_every_time(ground) -> None:
    options = CameraOptions(rate_hz=4.0, width=320, height=180)
    first, again = (list(camera(ground, FAST, options).frames()) for _ in range(2))
    assert first == again
    assert [frame.index for _, frame in first] == list(range(8))
    assert first != list(camera(ground, FAST, options, seed=2).frames())


def test_frames_are_stamped_by_the_cameras_own_clock_and_leave_it_after_the_last_row(ground) -> None:
    options = CameraOptions(rate_hz=4.0, width=320, height=180, dropped=0.5, encoding="bgr8")
    cam = camera(ground, FAST, options, clocks=ClockOptions())
    frames = list(cam.frames())
    assert 0 < len(frames) < 8
    assert [frame.index for _, frame in frames] == sorted({frame.index for _, frame in frames})
    for sent_s, frame in frames:
        middle_s = cam._clock.true_s(np.array([frame.t_ns * 1e-9]))[0]
        assert 0.0 < sent_s - middle_s < 0.05
        assert frame.encoding is Encoding.BGR8
        assert len(frame.data) == 320 * 180 * 3
        assert frame.line_time_s == pytest.approx(20e-6)


def test_noise_grows_with_the_root_of_light_and_with_gain(ground) -> None:
    options = replace(PERFECT, shot_noise=1.0, read_noise=6.0, exposure_ms=8.0)
    still = Gliding(FAST.p, np.zeros(3), np.zeros(3))
    cam = camera(ground, still, options)
    images = [cam.expose(0.5, Exposure(options), np.random.default_rng(n))[0].astype(float) for n in range(8)]
    clean = cam.look(cam.poses(0.5)) * (207.0 * 0.008)
    linear = np.stack([(image / 255) ** 2 for image in images])
    for low, high in ((0.03, 0.06), (0.2, 0.5)):
        chosen = (clean > low) & (clean < high)
        # By gamma a grey value is 2 √x / 255 wide, and rounding adds a twelfth of its square.
        expected = np.sqrt(clean[chosen] / 9000 + (6 / 9000) ** 2 + clean[chosen] * 4 / 255**2 / 12).mean()
        assert linear.std(axis=0, ddof=1)[chosen].mean() == pytest.approx(expected, rel=0.08)


def test_the_exposure_follows_a_change_of_light_with_its_lag() -> None:
    options = CameraOptions(rate_hz=10.0, auto_exposure=0.5)
    exposure = Exposure(options)
    settled, _ = exposure.settings(0.4)
    for _ in range(5):
        exposure.learn(0.2)
    # After one time constant 63 % of the way, in the logarithm.
    assert exposure.settings(0.2)[0] / settled == pytest.approx(2 ** (1 - np.exp(-1)), rel=1e-6)
    for _ in range(100):
        exposure.learn(0.01)
    longest, gain = exposure.settings(0.01)
    assert longest == pytest.approx(options.longest_ms * 1e-3)
    assert gain == pytest.approx(settled * 40 / longest, rel=1e-3)


def test_corners_are_darker_by_the_vignetting(ground) -> None:
    bright, dark = (camera(ground, FAST, replace(PERFECT, vignetting=v)) for v in (0.0, 0.4))
    ratio = dark._transmission[0, 0, 0] / bright._transmission[0, 0, 0]
    assert ratio == pytest.approx(0.6)
