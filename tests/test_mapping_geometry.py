"""Choice of pairs, rectification and triangulation against the camera model and least squares."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scene import CAMERA, keyframe

from air.mapping.matching import DisparityMap
from air.mapping.pairs import choose_partners, pair_geometry
from air.mapping.rectification import rectify, resample
from air.mapping.settings import MappingSettings
from air.mapping.triangulation import Correspondences, largest_move, triangulate
from common.errors import ConfigError
from common.se3 import SE3, rotation_vector_to_matrix

SETTINGS = MappingSettings()
H = 20.0


def test_partner_ahead_and_partner_behind_at_the_best_baseline_come_first():
    frames = [keyframe(i, [0.0, 1.7 * i, H]) for i in range(-6, 7)]
    centre = next(k for k in frames if k.index == 0)
    chosen = choose_partners(centre, frames, 0.0, MappingSettings(partners=2))
    # 0.25 of the height is three steps of 1.7 m; one of two steps overlaps more.
    assert {abs(k.index) for k in chosen} <= {2, 3}
    assert sorted(np.sign(k.index) for k in chosen) == [-1, 1]


def test_neighbour_strip_flown_the_other_way_is_a_partner():
    assert pair_geometry(keyframe(0, [0, 0, H]), keyframe(1, [6.0, 1.0, H], 180.0), 0.0, SETTINGS) is not None


@pytest.mark.parametrize(
    "other",
    [
        keyframe(1, [0, 0, H]),
        keyframe(1, [0.5, 0, H]),
        keyframe(1, [60.0, 0, H]),
        keyframe(1, [3.0, 0, 3 * H]),
        keyframe(1, [3.0, 0, -5.0]),
        keyframe(1, [4.0, 0, H], tilt=(0.6, 0.0)),
        keyframe(1, [4.0, 0, H], tilt=(np.pi, 0.0)),
        keyframe(1, [np.nan, 0, H]),
    ],
    ids=[
        "same place",
        "tiny baseline",
        "far away",
        "much higher",
        "below ground",
        "oblique",
        "upwards",
        "not a number",
    ],
)
def test_useless_pairs_are_refused(other):
    assert pair_geometry(keyframe(0, [0, 0, H]), other, 0.0, SETTINGS) is None


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 180.0, 33.0])
@pytest.mark.parametrize("direction", [(4.0, 0.0), (0.0, -4.0), (-3.0, 3.0)])
def test_points_lie_on_the_same_row_at_the_predicted_disparity(yaw_deg, direction):
    left = keyframe(0, [500.0, -300.0, H], 20.0, (0.03, -0.02))
    right = keyframe(1, [500.0 + direction[0], -300.0 + direction[1], H + 0.5], 20.0 + yaw_deg, (-0.02, 0.04))
    r = rectify(left, right, 0.0, 0.05, 1_000_000)
    assert r is not None
    rng = np.random.default_rng(0)
    centre = (left.T_world_cam.t + right.T_world_cam.t)[:2] / 2
    p_world = np.column_stack([centre + rng.uniform(-4, 4, (50, 2)), rng.uniform(-1, 3, 50)])
    pixels = []
    for view, frame in ((r.left, left), (r.right, right)):
        p_rect = frame.T_world_cam.inverse().apply(p_world) @ view.R_rect_cam.T
        pixels.append(np.column_stack([p_rect[:, 0], p_rect[:, 1]]) / p_rect[:, 2:] * r.focal + [view.cx, r.cy])
        depth = p_rect[:, 2]
    np.testing.assert_allclose(pixels[0][:, 1], pixels[1][:, 1], atol=1e-6)
    expected = [r.disparity(z) for z in depth]
    np.testing.assert_allclose(pixels[0][:, 0] - pixels[1][:, 0], expected, atol=1e-6)
    # The canvas holds what both see, and the assumed ground has a disparity near zero.
    assert pixels[0].min() > -1
    assert abs(r.disparity(H)) < 12


def test_resampling_follows_the_camera_model():
    left, right = keyframe(0, [0, 0, H], 10.0, (0.05, 0.02)), keyframe(1, [4.0, 1.0, H], 190.0)
    r = rectify(left, right, 0.0, 0.06, 1_000_000)
    assert r is not None
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ramp = np.stack([u / 2, v / 2, u * 0], axis=-1).astype(np.uint8)
    images = resample(r, ramp, ramp)
    rows, columns = np.nonzero(images.left_valid)
    d_rect = np.column_stack([(columns - r.left.cx) / r.focal, (rows - r.cy) / r.focal, np.ones(len(rows))])
    uv = CAMERA.project(d_rect @ r.left.R_rect_cam)
    error = images.colour[rows, columns, :2] * 2.0 - uv
    # uint8 holds half pixels rounded down.
    assert np.abs(np.median(error + 1, axis=0)).max() < 1.0
    assert np.quantile(np.abs(error), 0.99) < 3.0


def exact_correspondences(left, right, height):
    """Disparities of the plane z = `height` for a pair, by intersecting each left ray with it."""
    r = rectify(left, right, 0.0, 0.06, 1_000_000)
    v, u = np.mgrid[: r.height, : r.width].astype(float)
    d_rect = np.stack([(u - r.left.cx) / r.focal, (v - r.cy) / r.focal, np.ones_like(u)], axis=-1)
    d_world = d_rect @ r.left.R_rect_cam @ left.T_world_cam.R.T
    s = (height - left.T_world_cam.t[2]) / d_world[..., 2]
    p_world = left.T_world_cam.t + s[..., None] * d_world
    p_rect = right.T_world_cam.inverse().apply(p_world) @ r.right.R_rect_cam.T
    disparity = u - (p_rect[..., 0] / p_rect[..., 2] * r.focal + r.right.cx)
    result = DisparityMap(disparity.astype(np.float32), np.full(disparity.shape, 0.1, np.float32))
    return Correspondences.of(r, result, np.zeros((*disparity.shape, 3), np.uint8)), p_world


def test_triangulation_returns_the_surface_far_from_the_datum():
    left = keyframe(0, [8000.0, -5000.0, H], 20.0, (0.02, 0.01))
    right = keyframe(1, [8004.0, -4998.0, H + 0.3], 200.0)
    matches, truth = exact_correspondences(left, right, 0.7)
    points = triangulate(matches, left, right)
    known = np.isfinite(points.p_origin[..., 2])
    assert known.mean() > 0.8
    # 1/64 px of quantised disparity is 2 mm at this height and baseline.
    error = np.abs((points.p_origin + points.origin)[known] - truth[known])
    assert error.max() < 5e-3
    assert np.median(error) < 2e-3
    assert largest_move(points, points) == 0.0


def test_new_poses_and_intrinsics_put_points_between_the_rays_of_the_same_pixels():
    left, right = keyframe(0, [0, 0, H], 5.0), keyframe(1, [4.0, 1.0, H], 180.0)
    matches, truth = exact_correspondences(left, right, 0.7)
    better = replace(CAMERA, fx=CAMERA.fx * 1.02, fy=CAMERA.fy * 1.02, k1=-0.02)
    turn = rotation_vector_to_matrix(np.array([0.001, -0.0005, 0.002]))
    moved = SE3(right.T_world_cam.R @ turn, right.T_world_cam.t + np.array([0.05, -0.02, 0.1]))
    new_left = replace(left, camera=better)
    new_right = replace(right, camera=better, T_world_cam=moved)
    points = triangulate(matches, new_left, new_right, 16)
    p_world = points.p_origin + points.origin
    known = np.isfinite(p_world[..., 2])
    truth = truth[::16, ::16][known]
    uv = [k.camera.project(k.T_world_cam.inverse().apply(truth)) for k in (left, right)]
    expected = []
    for ray_left, ray_right in zip(*(better.rays(px) for px in uv), strict=True):
        a, b = new_left.T_world_cam.R @ ray_left, moved.R @ ray_right
        baseline = moved.t - new_left.T_world_cam.t
        (s, t), *_ = np.linalg.lstsq(np.column_stack([a, -b]), baseline, rcond=None)
        expected.append(new_left.T_world_cam.t + (s * a + baseline + t * b) / 2)
    np.testing.assert_allclose(p_world[known], expected, atol=0.01)
    assert np.abs(expected - truth).max() > 0.2


def test_settings_refuse_the_impossible():
    with pytest.raises(ConfigError, match=r"mapping\.cell"):
        MappingSettings(cell=0.0)
    with pytest.raises(ConfigError, match=r"mapping\.method"):
        MappingSettings(method="magic")
