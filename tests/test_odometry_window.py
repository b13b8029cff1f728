"""The sliding window over simulated points: drift, outliers, exact marginalization, repairs, the same bits twice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, L, V, X
from odometry_scene import CAMERA, T_BODY_CAM, Scene

from air.odometry.initial_prior import Sigmas
from air.odometry.mounting import Mounted, Mounting, MountingSettings
from air.odometry.preintegration import ImuBuffer
from air.odometry.quadratic import NormalEquations, dimension
from air.odometry.settings import ImuSettings, WindowSettings
from air.odometry.sightings import Seen
from air.odometry.tracker import TrackedFrame
from air.odometry.window import Window
from air.sources.simulated.imu import ImuOptions
from air.sources.simulated.motion.mission import FlightOptions
from common.arrays import F64
from common.measurements import ImuSample

KNOWN = Sigmas(tilt=0.005, yaw=1e-4, position=1e-3, velocity=0.05, accel_bias=0.03, gyro_bias=0.003)
IMU = ImuSettings()
EXACT = Mounted.beforehand(Mounting(T_BODY_CAM), MountingSettings(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def ideal(frame: TrackedFrame) -> Seen:
    order = np.argsort(frame.ids)
    rays = frame.rays[order]
    return Seen(frame.ids[order], CAMERA.fx * rays[:, :2] / rays[:, 2:], np.zeros((len(rays), 2)))


def flown(
    seed: int,
    duration_s: float,
    settings: WindowSettings | None = None,
    spoil: float = 0.0,
    stop_after: int = 10**9,
    prepared: Callable[[Window, ImuBuffer], None] = lambda *_: None,
    meanwhile: Callable[[int], None] = lambda _: None,
) -> tuple[Window, Scene, F64, F64]:
    """A window that flew from a known start, its positions and the true ones (N, 3); `spoil` is the share of wild
    observations. `prepared` is given the window first, `meanwhile` the number of each frame."""
    scene = Scene(seed, duration_s, FlightOptions(start="air"), ImuOptions())
    buffer, rng = ImuBuffer(IMU), np.random.default_rng(seed)
    window = Window(CAMERA.fx, EXACT, buffer, settings or WindowSettings(), IMU)
    estimate, truth, waiting = [], [], []
    prepared(window, buffer)
    for message in scene.sensed():
        if isinstance(message, ImuSample):
            buffer.add(message)
        else:
            waiting.append(message)
        while waiting and buffer.covers(waiting[0].t_ns, waiting[0].t_ns) and len(estimate) < stop_after:
            frame = waiting.pop(0)
            seen = ideal(frame)
            wild = rng.random(len(seen.ids)) < spoil
            seen = replace(seen, xy=seen.xy + wild[:, None] * rng.uniform(-60, 60, seen.xy.shape))
            if not window.frames:
                state = scene.state(frame.t_ns)
                window.begin(state, KNOWN.covariance(state.T_world_body.R), seen)
                continue
            window.add(frame.t_ns, seen)
            assert not window.solve().failed
            estimate.append(window.state().T_world_body.t)
            truth.append(scene.state(frame.t_ns).T_world_body.t)
            window.slide()
            meanwhile(len(estimate))
    return window, scene, np.array(estimate), np.array(truth)


@pytest.mark.parametrize("seed", [1, 2])
def test_at_40_m_and_3_m_s_the_drift_is_half_a_percent_at_most(seed: int) -> None:
    _, _, estimate, truth = flown(seed, 16.0)
    travelled = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert travelled > 30.0
    # The start is known within 5 cm/s; what it is off by costs 0.1 m until parallax has told it.
    assert np.linalg.norm(estimate[-1] - truth[-1]) < 0.005 * travelled + 0.1


def test_wild_observations_do_no_harm() -> None:
    window, _, estimate, truth = flown(1, 10.0, spoil=0.1)
    assert np.linalg.norm(estimate - truth, axis=1).max() < 0.5
    assert len(window.points) > 50


def test_the_same_flight_gives_the_same_bits() -> None:
    first, second = (flown(3, 6.0)[2] for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_the_window_stays_small_and_the_buffer_too() -> None:
    window, _, _, _ = flown(1, 12.0, WindowSettings(keyframes=6))
    assert len(window.frames) <= 7
    keys = {gtsam.Symbol(key).string() for key in window.values.keys()}  # noqa: SIM118
    assert len(keys) == 3 * len(window.frames) + len(window.points) + 1  # and the mounting
    assert window.state(0).t_ns > window.state().t_ns - 10_000_000_000


def test_nothing_seen_leaves_the_imu() -> None:
    window, scene, _, _ = flown(1, 6.0, stop_after=30)
    begin_ns = window.state().t_ns
    for k in range(1, 11):
        window.add(begin_ns + k * 100_000_000, Seen.nothing())
        assert not window.solve().failed
        window.slide()
    truth = scene.state(window.state().t_ns)
    assert np.linalg.norm(window.state().T_world_body.t - truth.T_world_body.t) < 0.6


def test_a_point_without_parallax_is_removed_and_not_the_flight() -> None:
    window, _, _, _ = flown(1, 4.0)
    newest = window.frames[-1]
    lonely = int(newest.seen.ids.max()) + 1
    seen, nothing = newest.seen, np.zeros((1, 2))
    newest.seen = Seen(np.append(seen.ids, lonely), np.vstack([seen.xy, nothing]), np.vstack([seen.rate, nothing]))
    window.values.insert(L(lonely), np.array([1e9, 0.0, 0.0]))
    window.points.add(lonely)  # nothing but its weak prior holds it
    assert not window.solve().failed
    assert lonely not in window.points


def test_a_frame_that_shows_nothing_new_is_dropped_and_its_imu_kept() -> None:
    window, _, _, _ = flown(1, 4.0)
    count, newest_ns = len(window.frames), window.state().t_ns
    seen = window.frames[-1].seen
    for k in (1, 2, 3):
        window.add(newest_ns + k * 20_000_000, seen)
        window.slide()
    assert len(window.frames) <= count + 1
    spans = [f.motion.deltaTij() for f in window.frames[1:]]
    times = np.diff([f.t_ns for f in window.frames]) * 1e-9
    np.testing.assert_allclose(spans, times, atol=1e-9)


def test_moving_the_window_moves_everything_in_it() -> None:
    scene = Scene(1, 3.0, FlightOptions(start="air"), ImuOptions())
    buffer = ImuBuffer(IMU)
    frames = [m for m in scene.sensed() if not isinstance(m, ImuSample) or not buffer.add(m)]
    window = Window(CAMERA.fx, EXACT, buffer, WindowSettings(), IMU)
    first = scene.state(frames[0].t_ns)  # type: ignore[union-attr]
    window.begin(first, KNOWN.covariance(first.T_world_body.R), ideal(frames[0]))  # type: ignore[arg-type]
    for frame in frames[4:24:4]:
        window.add(frame.t_ns, ideal(frame), scene.state(frame.t_ns))  # type: ignore[union-attr, arg-type]
    error = window.settle().rms_px
    before = window.state()
    c, s = np.cos(0.7), np.sin(0.7)
    T = type(before.T_world_body)(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([5.0, -3.0, 2.0]))
    window.move(T, np.eye(4) * 1e-6)
    np.testing.assert_allclose(window.state().v_world, T.R @ before.v_world, atol=1e-9)
    np.testing.assert_allclose(window.state().T_world_body.t, T.apply(before.T_world_body.t), atol=1e-9)
    assert window.solve().rms_px == pytest.approx(error, rel=1e-3)


def test_the_marginal_prior_is_the_schur_complement() -> None:
    """Against gtsam's elimination of a chain of poses: exact but for rounding."""
    rng = np.random.default_rng(4)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    poses = [gtsam.Pose3(gtsam.Rot3.Expmap(0.3 * rng.standard_normal(3)), rng.standard_normal(3)) for _ in range(3)]
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
    graph.add(gtsam.PriorFactorPose3(X(0), poses[0].retract(0.1 * rng.standard_normal(6)), noise))
    for k in (0, 1):
        step = poses[k].between(poses[k + 1]).retract(0.05 * rng.standard_normal(6))
        graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), step, noise))
    keys = [X(0), X(1), X(2)]
    linear = graph.linearize(values)
    H, g = linear.hessian(gtsam.Ordering(keys))
    equations = NormalEquations(dict.fromkeys(keys, 6))
    equations.add(keys, H, g)
    prior, conditional = equations.without([X(0)], values)
    rest = linear.eliminatePartialSequential(gtsam.Ordering([X(0)]))[1]
    expected, expected_g = rest.hessian(gtsam.Ordering([X(1), X(2)]))
    np.testing.assert_allclose(prior.G, expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(prior.g, expected_g, atol=1e-9 * np.abs(expected_g).max())
    whole = np.linalg.solve(H, g)  # what left follows from the others
    np.testing.assert_allclose(conditional.shift - conditional.by @ whole[6:], whole[:6], atol=1e-9)


def test_the_newest_covariance_is_the_marginal_of_the_whole_window() -> None:
    """Against the inverse of all that is known about everything, points included."""
    window, _, _, _ = flown(2, 4.0)
    window.solve()
    newest, values = window.frames[-1].k, window.values
    problem = window._problem()
    seen = replace(problem.sightings, free=0).linearised(values)
    inertial = problem.inertial.linearize(values)
    felt = inertial.keyVector()
    keys = list(dict.fromkeys([*felt, *seen.keys]))
    begin = dict(zip(keys, np.cumsum([0, *(dimension(values, key) for key in keys)]).tolist(), strict=False))
    H = np.zeros((sum(dimension(values, key) for key in keys),) * 2)
    for some, G in ((felt, inertial.hessian(gtsam.Ordering(felt))[0]), (seen.keys, seen.G)):
        columns = np.concatenate([np.arange(dimension(values, key)) + begin[key] for key in some])
        H[np.ix_(columns, columns)] += G
    for known in window._known():
        columns = np.concatenate([np.arange(dimension(values, key)) + begin[key] for key in known.point])
        H[np.ix_(columns, columns)] += known.at(values).G
    covariance = np.linalg.inv(H)[begin[X(newest)] :, begin[X(newest)] :][:6, :6]
    # One Gauss–Newton step lies between the two, and outliers that left in it.
    np.testing.assert_allclose(np.sqrt(np.diag(window.pose_covariance)), np.sqrt(np.diag(covariance)), rtol=0.05)
    assert {V(newest), B(newest)} <= set(window.values.keys())
