"""The camera against OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.camera import CameraModel

cameras = st.builds(
    CameraModel,
    width=st.just(1600),
    height=st.just(1200),
    fx=st.floats(900.0, 2500.0),
    fy=st.floats(900.0, 2500.0),
    cx=st.floats(700.0, 900.0),
    cy=st.floats(500.0, 700.0),
    k1=st.floats(-0.1, 0.1),
    k2=st.floats(-0.03, 0.03),
    p1=st.floats(-0.005, 0.005),
    p2=st.floats(-0.005, 0.005),
)


def points_in_view(seed: int = 0, count: int = 40) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = rng.uniform(2.0, 100.0, count)
    return np.stack([rng.uniform(-0.6, 0.6, count) * z, rng.uniform(-0.5, 0.5, count) * z, z], axis=1)


@given(cameras)
def test_projection_agrees_with_opencv(camera: CameraModel) -> None:
    p_cam = points_in_view()
    oracle, _ = cv2.projectPoints(p_cam, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
    assert camera.project(p_cam) == pytest.approx(oracle[:, 0], abs=1e-8)


@given(cameras)
def test_rays_lead_back_to_their_pixels(camera: CameraModel) -> None:
    p_cam = points_in_view(1)
    rays = camera.rays(camera.project(p_cam))
    # Eight fixed-point iterations leave some thousandths of a pixel at the corner of a strongly distorted image.
    assert camera.project(rays) == pytest.approx(camera.project(p_cam), abs=0.05)


def test_points_behind_the_camera_have_no_pixel() -> None:
    camera = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5)
    uv = camera.project(np.array([[0.0, 0.0, -1.0], [1.0, 1.0, 0.0], [0.0, 0.0, 2.0]]))
    assert np.isnan(uv[:2]).all()
    assert uv[2] == pytest.approx([319.5, 239.5])


@pytest.mark.parametrize("factor", [0.5, 0.25, 2.0])
def test_scaled_camera_sees_what_a_resized_image_shows(factor: float) -> None:
    camera = CameraModel(640, 480, 500.0, 510.0, 310.0, 250.0, k1=-0.05)
    small = camera.scaled(factor)
    uv, uv_small = camera.project(points_in_view()), small.project(points_in_view())
    # Pixel areas scale about the corner (−0.5, −0.5) of the image.
    assert uv_small == pytest.approx((uv + 0.5) * factor - 0.5, abs=1e-9)
    assert (small.width, small.height) == (round(640 * factor), round(480 * factor))
