"""A path known afterwards: against one adjustment of everything at once, over jumps of the world, piece by piece."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X
from odometry_scene import Scene
from test_odometry_window import flown

from air.odometry.preintegration import ImuBuffer, from_pose3
from air.odometry.quadratic import Conditional, NormalEquations
from air.odometry.smoothing import Smoother
from air.odometry.window import Window
from common.arrays import F64
from common.se3 import SE3


def misses(window: Window, scene: Scene, smoother: Smoother) -> tuple[F64, F64]:
    """Distances m of the smoothed keyframes from the truth, and their times s."""
    states = [one.state for one in smoother.path()]
    t_ns = np.array([state.t_ns for state in states])
    truth = [scene.state(int(t)).T_world_body.t for t in t_ns]
    return np.linalg.norm([s.T_world_body.t - p for s, p in zip(states, truth, strict=True)], axis=1), t_ns * 1e-9


def test_what_left_a_chain_is_what_an_adjustment_of_all_of_it_finds() -> None:
    """Poses one after the other, measured twice: eliminated in turn, then substituted back."""
    rng = np.random.default_rng(1)
    n, size = 6, 6
    A = np.zeros(((2 * n - 1) * size, n * size))  # each pose, and each with the next
    for k in range(n):
        A[k * size : (k + 1) * size, k * size : (k + 1) * size] = rng.standard_normal((size, size))
    for k in range(n - 1):
        A[(n + k) * size : (n + k + 1) * size, k * size : (k + 2) * size] = rng.standard_normal((size, 2 * size))
    G, g = A.T @ A, A.T @ rng.standard_normal(len(A))
    keys, values = [X(k) for k in range(n)], gtsam.Values()
    for key in keys:
        values.insert(key, gtsam.Pose3())
    expected = np.linalg.solve(G, g).reshape(n, size)
    conditionals: list[Conditional] = []
    equations = NormalEquations(dict.fromkeys(keys, size))
    equations.add(keys, G, g)
    for k in range(n - 1):
        prior, conditional = equations.without([keys[k]], values)
        conditionals.append(conditional)
        equations = NormalEquations(dict.fromkeys(keys[k + 1 :], size))
        equations.add(prior.point, prior.G, prior.g)
    found = {keys[-1]: np.linalg.solve(equations.G, equations.g)}
    for conditional in reversed(conditionals):
        step = np.concatenate([found[key] for key in conditional.left])
        found |= dict.fromkeys(conditional.gone, conditional.shift - conditional.by @ step)
    np.testing.assert_allclose([found[key] for key in keys], expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("seed", [1, 2])
def test_afterwards_the_path_is_known_better_than_on_the_way(seed: int) -> None:
    smoothers: list[Smoother] = []

    def remember(window: Window, buffer: ImuBuffer) -> None:
        smoothers.append(Smoother(buffer))
        window.history = smoothers[0]

    window, scene, estimate, truth = flown(seed, 14.0, prepared=remember)
    smoothers[0].ended(window)
    missed, t_s = misses(window, scene, smoothers[0])
    assert (np.diff(t_s) > 0).all()
    assert len(missed) > 12
    assert t_s[-1] == window.state().t_ns * 1e-9
    np.testing.assert_allclose(missed[-1], np.linalg.norm(estimate[-1] - truth[-1]), atol=1e-9)
    # The start's velocity was known within 5 cm/s: what came after tells it.
    assert np.sqrt(np.mean(missed**2)) < np.sqrt(np.mean(np.sum((estimate - truth) ** 2, axis=1)))


def test_a_jump_of_the_world_moves_what_came_before_along() -> None:
    T = SE3(np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]), np.array([100.0, -50.0, 7.0]))
    smoothers: list[Smoother] = []
    windows: list[Window] = []

    def remember(window: Window, buffer: ImuBuffer) -> None:
        smoothers.append(Smoother(buffer))
        windows.append(window)
        window.history = smoothers[-1]

    def jump(number: int) -> None:
        if number == 60:
            windows[-1].move(T, np.eye(4) * 1e-12)

    still, _, _, _ = flown(1, 12.0, prepared=remember)
    moved, _, _, _ = flown(1, 12.0, prepared=remember, meanwhile=jump)
    for smoother, window in zip(smoothers, (still, moved), strict=True):
        smoother.ended(window)
    one, other = (smoother.path() for smoother in smoothers)
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        there = T @ a.state.T_world_body
        # Which world it was makes no difference but for where steps of the adjustment end.
        np.testing.assert_allclose(b.state.T_world_body.t, there.t, atol=0.03)
        np.testing.assert_allclose(b.state.T_world_body.R, there.R, atol=2e-3)
        np.testing.assert_allclose(b.state.v_world, T.R @ a.state.v_world, atol=0.03)


def test_between_keyframes_the_path_follows_the_imu_and_meets_each_of_them() -> None:
    smoothers: list[Smoother] = []

    def remember(window: Window, buffer: ImuBuffer) -> None:
        smoothers.append(Smoother(buffer))
        window.history = smoothers[0]

    window, scene, _, _ = flown(3, 8.0, prepared=remember)
    smoothers[0].ended(window)
    path, states = smoothers[0].path(), list(smoothers[0].states())
    assert (np.diff([s.t_ns for s in states]) > 0).all()
    assert np.diff([s.t_ns for s in states]).max() <= 5_100_000
    at = {s.t_ns: s.T_world_body for s in states}
    for one in path:
        np.testing.assert_allclose(at[one.state.t_ns].t, one.state.T_world_body.t, atol=1e-9)
    steps = np.diff([s.T_world_body.t for s in states], axis=0)
    expected = np.diff([scene.state(s.t_ns).T_world_body.t for s in states], axis=0)
    assert np.abs(steps - expected).max() < 2e-3
    assert from_pose3(window.values.atPose3(X(window.frames[-1].k))).t == pytest.approx(path[-1].state.T_world_body.t)
