"""Two-view geometry, resection and triangulation against exact scenes."""

import numpy as np
import pytest
from alignment_scene import CAMERA, DOWN_CAM, scene
from hypothesis import given
from hypothesis import strategies as st

from air.alignment.geometry import PairPrior, relative_pose, resect, triangulate, triangulate_pair
from common.se3 import SE3, rotation_angle, rotation_vector_to_matrix


def shared(s, a, b):
    ja, jb = s.point[s.photo == a], s.point[s.photo == b]
    both = np.intersect1d(ja, jb)
    uv_a = s.uv[s.photo == a][np.searchsorted(ja, both)]
    uv_b = s.uv[s.photo == b][np.searchsorted(jb, both)]
    return uv_a, uv_b, both


@pytest.mark.parametrize("relief", [0.0, 8.0])
@pytest.mark.parametrize("pair", [(0, 1), (1, 2), (2, 3), (0, 9), (4, 5)])
def test_relative_pose_is_right_on_flat_and_on_rough_ground(relief, pair):
    s = scene(relief=relief)
    a, b = pair
    uv_a, uv_b, _ = shared(s, a, b)
    truth = s.poses[a].inverse() @ s.poses[b]
    step = s.poses[b].t - s.poses[a].t
    prior = PairPrior(DOWN_CAM, DOWN_CAM, np.radians(21), -step[2] / np.linalg.norm(step), 0.5)
    T, mask = relative_pose(CAMERA, CAMERA, uv_a, uv_b, 2.0, prior)
    assert mask.mean() > 0.95
    assert np.degrees(rotation_angle(T.R.T @ truth.R)) < 1.0
    assert np.degrees(np.arccos(T.t @ truth.t / np.linalg.norm(truth.t))) < 5.0


def test_resection_finds_the_pose_among_wrong_matches():
    s = scene()
    mine = s.photo == 7
    p, uv = s.points[s.point[mine]], s.uv[mine].copy()
    wrong = np.arange(0, len(uv), 4)
    uv[wrong] += np.random.default_rng(1).uniform(30, 200, (len(wrong), 2))
    T, mask = resect(CAMERA, p, uv, 4.0)
    assert np.linalg.norm(T.t - s.poses[7].t) < 0.05
    assert not mask[wrong].any()
    assert np.delete(mask, wrong).all()


@given(st.integers(0, 10_000))
def test_triangulation_meets_where_the_rays_meet(seed):
    rng = np.random.default_rng(seed)
    count, views = 5, 4
    points = rng.uniform(-20, 20, (count, 3))
    centres = rng.uniform(-10, 10, (views, 3)) + [0, 0, 60]
    point = np.repeat(np.arange(count), views)
    where = np.tile(centres, (count, 1))
    rays = points[point] - where
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found, angle = triangulate(rays, where, point, count)
    assert np.allclose(found, points, atol=1e-6)
    widest = [np.arccos(np.clip((rays[point == j] @ rays[point == j].T).min(), -1, 1)) for j in range(count)]
    assert (angle >= np.array(widest) - 1e-6).all()


def test_parallel_rays_give_no_point():
    up = np.array([[0.0, 0, 1], [0, 0, 1]])
    found, angle = triangulate(up, np.array([[0.0, 0, 0], [1, 0, 0]]), np.zeros(2, int), 1)
    assert np.isnan(found).all()
    assert angle[0] == 0
    found, _ = triangulate_pair(SE3(np.eye(3), np.array([1.0, 0, 0])), up, up)
    assert np.isnan(found).all()


@given(st.integers(0, 10_000))
def test_pair_triangulation_is_exact(seed):
    rng = np.random.default_rng(seed)
    T_a_b = SE3(rotation_vector_to_matrix(rng.normal(0, 0.2, 3)), rng.uniform(-1, 1, 3) + [3, 0, 0])
    p_a = rng.uniform([-5, -5, 20], [5, 5, 60], (20, 3))
    found, _ = triangulate_pair(T_a_b, p_a, T_a_b.inverse().apply(p_a))
    assert np.allclose(found, p_a, atol=1e-6)
