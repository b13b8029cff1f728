"""What frames see: against gtsam's own projection factors, and derivatives against differences."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from air.odometry.mounting import COLUMNS, MOUNTING, Mounted, Mounting, MountingSettings
from air.odometry.odometry import with_lens
from air.odometry.quadratic import NormalEquations, dimension
from air.odometry.sightings import HUBER, Lens, Seen, Sightings
from common.arrays import F64
from common.camera import CameraModel
from common.se3 import SE3, rotation_vector_to_matrix

FOCAL, SIGMA = 600.0, 1.5
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
NOMINAL = Mounting(SE3(DOWN, np.array([0.1, 0.02, -0.08])))


def scene(seed: int = 1, frames: int = 4, points: int = 12) -> tuple[Sightings, gtsam.Values]:
    """Frames 40 m above points; some observations are missing, one is wild."""
    rng = np.random.default_rng(seed)
    values = gtsam.Values()
    for k in range(frames):
        pose = gtsam.Pose3(gtsam.Rot3.Expmap(0.1 * rng.standard_normal(3)), np.array([3.0 * k, 0.0, 40.0]))
        values.insert(X(k), pose)
    for i in range(points):
        values.insert(L(i), np.append(rng.uniform(-12, 18, 2), rng.uniform(0, 4)))
    values.insert(MOUNTING, np.zeros(COLUMNS))
    pairs = np.array([(k, i) for k in range(frames) for i in range(points) if rng.random() < 0.8 or k < 2])
    exact = Sightings(
        lens=Lens(FOCAL, SIGMA, NOMINAL),
        frames=[X(k) for k in range(frames)],
        points=[L(i) for i in range(points)],
        free=points,
        frame=pairs[:, 0],
        point=pairs[:, 1],
        xy=np.zeros((len(pairs), 2)),
        rate=rng.uniform(-80, 80, (len(pairs), 2)),
        weak=np.zeros(points),
    )
    xy = -exact._projected(values).residual + rng.normal(0, SIGMA, (len(pairs), 2))
    xy[3] += 25.0
    return replace(exact, xy=xy), values


def by_gtsam(sightings: Sightings, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    graph, model = gtsam.NonlinearFactorGraph(), gtsam.noiseModel
    pixel = model.Robust.Create(model.mEstimator.Huber.Create(HUBER), model.Isotropic.Sigma(2, SIGMA))
    camera, T = gtsam.Cal3_S2(FOCAL, FOCAL, 0.0, 0.0, 0.0), NOMINAL.T_body_cam
    for k, i, xy in zip(sightings.frame, sightings.point, sightings.xy, strict=True):
        pose = gtsam.Pose3(gtsam.Rot3(T.R), T.t)
        graph.add(gtsam.GenericProjectionFactorCal3_S2(xy, pixel, X(k), L(i), camera, False, False, pose))
    return graph


def test_error_and_equations_are_those_of_gtsam() -> None:
    sightings, values = scene()
    graph = by_gtsam(sightings, values)
    assert sightings.error(values) == pytest.approx(graph.error(values), rel=1e-9)
    points = gtsam.Ordering(list(sightings.points))
    rest = graph.linearize(values).eliminatePartialSequential(points)[1]
    expected, right = rest.hessian(gtsam.Ordering(list(sightings.frames)))
    seen, size = sightings.linearised(values), 6 * len(sightings.frames)
    np.testing.assert_allclose(seen.G[:size, :size], expected, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(seen.g[:size], right, atol=1e-8 * np.abs(right).max())


def test_points_kept_or_eliminated_give_the_same_solution() -> None:
    sightings, values = scene(2)
    sightings = replace(sightings, weak=np.full(12, 1e-4))
    solutions = []
    for free in (12, 7, 0):
        seen = replace(sightings, free=free).linearised(values)
        equations = NormalEquations({key: dimension(values, key) for key in seen.keys})
        equations.add(seen.keys, seen.G, seen.g)
        size = 6 * len(sightings.frames) + COLUMNS
        equations.add([*sightings.frames, MOUNTING], np.eye(size), np.zeros(size))
        change, _ = equations.solve([X(0)])
        solutions.append(change | seen.points(change))
    for key in (*sightings.frames, MOUNTING, *sightings.points):
        np.testing.assert_allclose(solutions[1][key], solutions[0][key], atol=1e-9)
        np.testing.assert_allclose(solutions[2][key], solutions[0][key], atol=1e-9)


def residuals(sightings: Sightings, values: gtsam.Values, key: int, delta: F64) -> F64:
    step = gtsam.VectorValues()
    step.insert(key, delta)
    return sightings._projected(values.retract(step)).residual


def test_derivatives_are_those_of_differences() -> None:
    sightings, values = scene(3)
    values.update(MOUNTING, np.array([0.01, -0.02, 0.005, 0.01, 0.02, 0.03, 0.004, 0.1, 0.1, 0.1, 3.0, 2.0, -1.0]))
    by_pose, by_mounting, by_point = sightings._derivatives(sightings._projected(values))
    for key, mine, J in (
        (X(1), sightings.frame == 1, by_pose),
        (L(2), sightings.point == 2, by_point),
        (MOUNTING, np.ones(len(sightings.frame), bool), by_mounting),
    ):
        for column in range(J.shape[2]):
            delta = np.zeros(J.shape[2])
            delta[column] = 1e-6
            ahead, back = (residuals(sightings, values, key, sign * delta) for sign in (1, -1))
            expected = -(ahead - back)[mine] / 2e-6
            # A turn is added on the left of one that is not small: to first order in it.
            np.testing.assert_allclose(J[mine][:, :, column], expected, rtol=0.03, atol=0.02 * np.abs(J).max())


def test_what_is_behind_the_camera_counts_for_nothing_but_costs_much() -> None:
    sightings, values = scene(4)
    sightings = replace(sightings, weak=np.full(12, 1e-6))
    others = replace(
        sightings,
        **{name: getattr(sightings, name)[sightings.point != 0] for name in ("frame", "point", "xy", "rate")},
    )
    values.update(L(0), np.array([0.0, 0.0, 90.0]))
    np.testing.assert_allclose(sightings.linearised(values).G, others.linearised(values).G, atol=1e-6)
    assert sightings.error(values) > others.error(values) + 500


def test_a_correction_counts_once_the_flight_knows_it_better() -> None:
    mounted = Mounted.beforehand(NOMINAL, MountingSettings(antenna_m=0.0))
    assert mounted.held == list(range(COLUMNS))
    sigma = mounted.sigma.copy()
    sigma[[1, 6]] *= 0.3
    told = mounted.told(np.zeros(COLUMNS), np.diag(sigma**2))
    assert np.flatnonzero(told.learnt).tolist() == [1, 6]
    again = told.told(np.zeros(COLUMNS), np.diag(mounted.sigma**2))
    assert np.flatnonzero(again.learnt).tolist() == [1, 6]  # for good
    exact = mounted.told(np.zeros(COLUMNS), np.diag((0.01 * mounted.sigma) ** 2))
    assert not exact.learnt[7:10].any()  # what is exact never moves


def test_corrections_turn_the_camera_about_its_own_axes_and_shift_along_the_bodys() -> None:
    u = np.array([0.0, 0.0, 0.1, 0.01, 0.0, 0.0, 0.002, 0.0, 0.0, 0.05, 2.0, 1.0, -1.0])
    now = NOMINAL.corrected(u)
    np.testing.assert_allclose(now.T_body_cam.R, DOWN @ rotation_vector_to_matrix(np.array([0, 0, 0.1])), atol=1e-12)
    np.testing.assert_allclose(now.T_body_cam.t, NOMINAL.T_body_cam.t + [0.01, 0, 0])
    np.testing.assert_allclose(now.p_body_antenna, [0, 0, 0.05])
    assert now.delay_s == 0.002
    np.testing.assert_array_equal(now.lens, [2.0, 1.0, -1.0])


def test_points_of_a_corrected_lens_are_where_a_calibrated_one_would_show_them() -> None:
    p, delay_s, lens = np.array([[0.3, -0.2], [-0.6, 0.4]]), 0.004, np.array([5.0, -2.0, 1.5])
    rate = np.array([[30.0, -50.0], [10.0, 20.0]])
    seen = Seen(np.arange(2), (640.0 + lens[0]) * p + lens[1:] - delay_s * rate, rate)
    corrected = seen.corrected(Mounting(delay_s=delay_s, lens=lens), 640.0)
    np.testing.assert_allclose(corrected, 640.0 * p, atol=1e-9)


def test_the_corrected_camera_shows_points_where_the_calibrated_one_with_corrections_does() -> None:
    camera, lens = CameraModel(1280, 720, 640.0, 650.0, 639.5, 359.5), np.array([5.0, -2.0, 1.5])
    rays = np.array([[0.3, -0.2, 1.0], [-0.6, 0.4, 1.0]])
    told = camera.rays(with_lens(camera, lens).project(rays))
    seen = Seen(np.arange(2), camera.fx * told[:, :2] / told[:, 2:], np.zeros((2, 2)))
    np.testing.assert_allclose(seen.corrected(Mounting(lens=lens), camera.fx), camera.fx * rays[:, :2], atol=1e-6)


def test_columns_that_are_held_stay_and_the_others_are_solved_with_them_held() -> None:
    rng = np.random.default_rng(5)
    A = rng.standard_normal((12, 9))
    G, g = A.T @ A, rng.standard_normal(9)
    a, b, c = X(0), X(1), MOUNTING
    equations = NormalEquations({a: 3, b: 3, c: 3})
    equations.add([a, b, c], G, g)
    change, covariance = equations.solve([b, c], first=[a], held=np.array([3, 5]))
    free = [0, 1, 2, 3, 4, 5, 7]
    expected = np.zeros(9)
    expected[free] = np.linalg.solve(G[np.ix_(free, free)], g[free])
    np.testing.assert_allclose(np.concatenate([change[a], change[b], change[c]]), expected, atol=1e-9)
    np.testing.assert_allclose(covariance, np.linalg.inv(G)[3:, 3:], atol=1e-9)
