"""The simulated flight: its plan, what its photos carry, and the truth beside it."""

import hashlib
import json
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from air.sources.simulated.survey import Survey
from air.sources.source import PhotoSource, open_photos
from common.export.datum import read_datum
from common.export.projection import UtmProjection
from common.export.trajectory import read_tum
from common.geo import geodetic_to_enu
from common.messages import Photo
from common.se3 import SE3, rotation_angle


def survey(query: str) -> Survey:
    source = open_photos(f"sim:survey?{query}")
    assert isinstance(source, Survey)
    return source


@pytest.fixture(scope="module")
def small() -> tuple[Survey, list[Photo]]:
    source = survey("seed=4&photos=6")
    return source, list(source)


def digest(source: PhotoSource) -> str:
    return hashlib.sha256(b"".join(photo.jpeg + repr((photo.fix, photo.t_ns)).encode() for photo in source)).hexdigest()


def test_the_same_url_gives_the_same_bytes() -> None:
    first, again, other = (digest(survey(f"seed={seed}&photos=2")) for seed in (4, 4, 5))
    assert first == again
    assert first != other


def test_photos_are_complete(small: tuple[Survey, list[Photo]]) -> None:
    source, photos = small
    assert len(photos) == len(source) == 6
    assert len({photo.name for photo in photos}) == 6
    stamps = np.array([photo.t_ns for photo in photos])
    assert (np.diff(stamps) >= 2_000_000_000).all()
    for photo in photos:
        image = cv2.imdecode(np.frombuffer(photo.jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (960, 1280, 3)
        assert 60 < image.mean() < 170, "well exposed"
        assert image.std() > 20


def test_neighbouring_photos_show_the_same_ground_where_the_truth_says(small: tuple[Survey, list[Photo]]) -> None:
    """SIFT features of one photo, carried over by pose, surface and lens, are found in the next within a pixel."""
    source, photos = small
    sift = cv2.SIFT_create(2000)
    images = [cv2.imdecode(np.frombuffer(photo.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE) for photo in photos[:2]]
    (points_a, features_a), (points_b, features_b) = (sift.detectAndCompute(image, None) for image in images)
    good = [a for a, b in cv2.BFMatcher().knnMatch(features_a, features_b, k=2) if a.distance < 0.7 * b.distance]
    assert len(good) > 200
    seen_a = np.array([points_a[match.queryIdx].pt for match in good])
    seen_b = np.array([points_b[match.trainIdx].pt for match in good])
    T_a, T_b = source.truth.T_world_cam[:2]
    p_world, _ = source.truth.world.intersect(T_a.t, source.truth.camera.rays(seen_a) @ T_a.R.T)
    expected = source.truth.camera.project(T_b.inverse().apply(p_world))
    error = np.linalg.norm(expected - seen_b, axis=1)
    assert np.median(error) < 0.25
    assert np.mean(error < 1.0) > 0.8


@pytest.mark.parametrize("photos", [2, 3, 7, 20, 60])
def test_the_block_is_square_and_overlaps(photos: int) -> None:
    truth = survey(f"seed=2&photos={photos}").truth
    assert len(truth.T_world_cam) == photos
    p = np.array([pose.t for pose in truth.T_world_cam])
    assert np.abs(p[:, 2] - 40).max() <= 1.0
    tilts = [rotation_angle(_level(pose) @ pose.R.T) for pose in truth.T_world_cam]
    assert np.degrees(max(tilts)) < 4.3, "3° about either axis"
    steps = np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1)
    along = steps[np.diff(truth.t_ns) == 2_000_000_000]
    # The image covers 38.4 m along the flight: 75 to 80 % overlap, give or take the wind.
    assert 1 - np.mean(along) / 38.4 == pytest.approx(0.78, abs=0.015)
    if photos == 60:
        assert 1 - np.max(steps[np.diff(truth.t_ns) > 2_000_000_000]) / 51.2 == pytest.approx(0.67, abs=0.04)
        width, height = np.ptp(p[:, 0]), np.ptp(p[:, 1])
        assert 0.6 < width / height < 1.7


def _level(pose: SE3) -> np.ndarray:
    """The nadir attitude with the same heading of the image's top."""
    up_in_image = -pose.R[:2, 1] / np.linalg.norm(pose.R[:2, 1])
    return np.array([[up_in_image[1], -up_in_image[0], 0], [-up_in_image[0], -up_in_image[1], 0], [0, 0, -1]])


def test_the_image_points_along_the_flight() -> None:
    truth = survey("seed=2&photos=60").truth
    p = np.array([pose.t for pose in truth.T_world_cam])
    for i in np.flatnonzero(np.diff(truth.t_ns) == 2_000_000_000):
        flown = p[i + 1, :2] - p[i, :2]
        top = -truth.T_world_cam[i].R[:2, 1]
        assert flown @ top / np.linalg.norm(flown) > np.cos(np.radians(15))


@pytest.mark.parametrize("noise", [1.5, 0.02])
def test_positions_scatter_as_their_sigma_says(noise: float) -> None:
    source = survey(f"seed=6&photos=200&gps_noise={noise}")
    fixes = [source.fix(i) for i in range(len(source))]
    assert {(fix.sigma_horizontal, fix.sigma_vertical) for fix in fixes} == {(noise, noise)}
    measured = geodetic_to_enu(
        source.truth.datum, *np.array([[f.latitude_deg, f.longitude_deg, f.height] for f in fixes]).T
    )
    errors = (measured - [pose.t for pose in source.truth.T_world_cam]) / noise
    # Four standard errors of mean and deviation of 200 samples.
    assert np.abs(errors.mean(axis=0)).max() < 4 / np.sqrt(200)
    assert np.abs(errors.std(axis=0) - 1).max() < 4 / np.sqrt(2 * 200)
    assert abs(np.corrcoef(errors[:-1, 0], errors[1:, 0])[0, 1]) < 0.28, "white from photo to photo"


def test_the_first_guess_of_the_lens_is_as_wrong_as_asked(small: tuple[Survey, list[Photo]]) -> None:
    source, photos = small
    true, guess = source.truth.camera, photos[0].camera
    assert guess is not None
    assert guess.fx / true.fx == pytest.approx(1.03)
    assert (guess.cx, guess.cy, guess.k1, guess.k2) == (639.5, 479.5, 0.0, 0.0)
    assert (true.k1, true.k2) != (0.0, 0.0)
    exact = next(iter(survey("seed=4&photos=2&focal_error=0"))).camera
    assert exact is not None
    assert exact.fx == true.fx


def test_attitudes_are_noisy_or_absent(small: tuple[Survey, list[Photo]]) -> None:
    source, photos = small
    for photo, pose in zip(photos, source.truth.T_world_cam, strict=True):
        assert photo.R_enu_cam is not None
        assert photo.attitude_sigma == pytest.approx(np.radians(2))
        assert 0 < rotation_angle(photo.R_enu_cam.T @ pose.R) < np.radians(10)
    bare = next(iter(survey("seed=4&photos=2&angles=0")))
    assert (bare.R_enu_cam, bare.attitude_sigma) == (None, 0.0)


def test_the_truth_is_written_as_files(small: tuple[Survey, list[Photo]], tmp_path: Path) -> None:
    truth = small[0].truth
    truth.write(tmp_path / "truth")
    assert json.loads((tmp_path / "truth" / "camera.json").read_text())["k1"] == truth.camera.k1
    assert read_datum(tmp_path / "truth" / "datum.json") == truth.datum
    trajectory = read_tum(tmp_path / "truth" / "trajectory.tum")
    np.testing.assert_allclose(trajectory.positions, [pose.t for pose in truth.T_world_cam], atol=1e-8)
    assert trajectory.t_ns.tolist() == truth.t_ns

    cloud = laspy.read(tmp_path / "truth" / "surface.laz")
    p = UtmProjection(truth.datum).to_world(np.asarray(cloud.xyz))
    # Walls stand between two heights, and coordinates are rounded to a millimetre: look 2 mm around.
    around = np.array([[0, 0], [2, 0], [-2, 0], [0, 2], [0, -2]]) * 1e-3
    heights = np.array([truth.world.height(p[:, :2] + step) for step in around])
    tops = np.abs(heights[0] - p[:, 2]) < 0.01
    assert tops.mean() > 0.6
    # The sharpest corners are narrower than that.
    assert np.mean(p[:, 2] > heights.max(axis=0) + 0.03) < 1e-4, "nothing floats"
    assert np.mean(p[:, 2] < heights.min(axis=0) - 0.03) < 1e-4, "nothing is buried"
    seen = _common_cells(p[tops, :2])
    assert seen == pytest.approx(400, rel=0.02), "one point per 5 cm × 5 cm"


def _common_cells(xy: np.ndarray) -> float:
    """Median number of points per square metre of the inner part."""
    cells = np.unique(np.floor(xy).astype(int), axis=0, return_counts=True)[1]
    return float(np.median(cells))


def test_the_true_surface_holds_the_walls(small: tuple[Survey, list[Photo]]) -> None:
    """Every vertical wall that rays of the camera hit has a point of the true surface within 5 cm."""
    truth = small[0].truth
    p, colour = truth.surface()
    assert colour.shape == p.shape
    west, south, mask = truth.footprint()
    rng = np.random.default_rng(0)
    uv = rng.uniform(0, [1279, 959], (4000, 2))
    pose = truth.T_world_cam[2]
    hits, _ = truth.world.intersect(pose.t, truth.camera.rays(uv) @ pose.R.T)
    row, column = np.floor((hits[:, [1, 0]] - [south, west]) / 0.5).astype(int).T
    hits = hits[mask[row, column]]
    assert len(hits) > 2000
    distance, _ = cKDTree(p).query(hits)
    assert np.quantile(distance, 0.99) < 0.05
    assert distance.max() < 0.3
