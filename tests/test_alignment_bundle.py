"""Bundle adjustment and georeferencing against exact scenes."""

from dataclasses import replace

import numpy as np
import pytest
from alignment_scene import CAMERA, camera_prior, pose_prior, scene

from air.alignment.bundle import BundleProblem, adjust
from air.alignment.georeference import georeference
from common.se3 import SE3, rotation_vector_to_matrix


def disturbed(s, fixes, calibrate=True, final=True, focal=1.03, outliers=0.0):
    rng = np.random.default_rng(5)
    guess = replace(CAMERA, fx=focal * 1000, fy=focal * 1000, cx=639.5, cy=479.5, k1=0.0, k2=0.0)
    poses = [SE3(T.R @ rotation_vector_to_matrix(rng.normal(0, 0.01, 3)), T.t + rng.normal(0, 0.5, 3)) for T in s.poses]
    uv = s.uv.copy()
    wrong = rng.random(len(uv)) < outliers
    uv[wrong] += rng.uniform(-60, 60, (wrong.sum(), 2))
    return BundleProblem(
        cameras=[guess],
        camera_priors=[camera_prior(guess)],
        camera_of=[0] * len(poses),
        poses=poses,
        pose_priors=[pose_prior(p, 0.05) for p in fixes],
        fixed=np.zeros(len(poses), bool),
        points=s.points + rng.normal(0, 0.3, s.points.shape),
        photo=s.photo,
        point=s.point,
        uv=uv,
        pixel_sigma=0.3,
        calibrate=calibrate,
        final=final,
    )


def test_adjustment_recovers_poses_points_and_intrinsics():
    s = scene()
    rng = np.random.default_rng(2)
    fixes = [T.t + rng.normal(0, 0.05, 3) for T in s.poses]
    solution = adjust(disturbed(s, fixes))
    camera = solution.cameras[0]
    assert camera.fx == pytest.approx(1000.0, rel=5e-3)
    assert camera.fy == pytest.approx(camera.fx, rel=1e-5)
    assert [camera.cx, camera.cy] == pytest.approx([642.0, 475.0], abs=1.5)
    assert [camera.k1, camera.k2] == pytest.approx([-0.05, 0.03], abs=0.01)
    error = np.array([T.t - truth.t for T, truth in zip(solution.poses, s.poses, strict=True)])
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.05
    assert solution.sigma is not None
    # The stated sigmas are neither vain nor useless: the errors stay within four of them.
    assert (np.abs(error) < 4 * solution.sigma).mean() > 0.97
    assert solution.sigma.max() < 0.15


def test_adjustment_survives_wrong_matches():
    s = scene()
    solution = adjust(disturbed(s, [T.t for T in s.poses], final=False, outliers=0.05))
    error = np.array([T.t - truth.t for T, truth in zip(solution.poses, s.poses, strict=True)])
    assert np.sqrt((error**2).mean()) < 0.08


def test_intrinsics_stay_unless_they_are_calibrated():
    s = scene(lines=1)
    problem = disturbed(s, [T.t for T in s.poses], calibrate=False, final=False, focal=1.0)
    assert adjust(problem).cameras == problem.cameras


def freed(poses, seed=3):
    rng = np.random.default_rng(seed)
    R, t, scale = rotation_vector_to_matrix(rng.normal(0, 1.5, 3)), rng.normal(0, 20, 3), 0.07
    return [SE3(R @ T.R, scale * (R @ T.t) + t) for T in poses]


def misplaced(similarity, free, poses):
    return np.array([similarity.pose(f).t - T.t for f, T in zip(free, poses, strict=True)])


def test_a_free_block_comes_to_its_fixes():
    s = scene(lines=3)
    free = freed(s.poses)
    found = georeference(free, [pose_prior(T.t) for T in s.poses])
    # The cameras lean by 2° and are taken to look down: that tilts the block by millimetres.
    assert np.abs(misplaced(found.similarity, free, s.poses)).max() < 0.03
    assert found.horizontal_factor == found.vertical_factor == 1.0


def test_one_straight_strip_is_still_upright():
    poses = [SE3(T.R, np.array([T.t[0], 0.0, 40.0])) for T in scene(lines=1, per_line=6).poses]
    free = freed(poses)
    found = georeference(free, [pose_prior(T.t) for T in poses])
    down = np.mean([found.similarity.pose(f).R[:, 2] for f in free], axis=0)
    assert np.degrees(np.arccos(-down[2] / np.linalg.norm(down))) < 2.0
    assert np.abs(misplaced(found.similarity, free, poses)).max() < 0.1


def test_a_drifting_height_is_recognised_and_does_not_tilt_the_block():
    s = scene(lines=4, per_line=6)
    free = freed(s.poses)
    drift = np.linspace(0, 80, len(s.poses))
    found = georeference(free, [pose_prior(T.t + [0, 0, d]) for T, d in zip(s.poses, drift, strict=True)])
    error = misplaced(found.similarity, free, s.poses)
    assert found.vertical_factor > 5
    assert np.abs(error[:, :2]).max() < 1.5
    assert np.ptp(error[:, 2]) < 12  # of 80 m of drift


def test_some_wild_fixes_do_not_move_the_block():
    s = scene(lines=4, per_line=6)
    free = freed(s.poses)
    fixes = [T.t.copy() for T in s.poses]
    for i in (3, 11, 17):
        fixes[i] += [300.0, -200.0, 50.0]
    found = georeference(free, [pose_prior(p) for p in fixes])
    assert np.linalg.norm(misplaced(found.similarity, free, s.poses), axis=1).max() < 2.0


def test_one_fix_is_not_enough():
    poses = scene(lines=1).poses
    priors = [pose_prior(poses[0].t), *(pose_prior(None) for _ in poses[1:])]
    assert georeference(poses, priors) is None
