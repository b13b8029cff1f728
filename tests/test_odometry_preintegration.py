"""Pre-integration: truth regained from a perfect IMU; gaps, saturation, refused samples, moved biases."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from odometry_scene import START_NS, Scene

from air.odometry.preintegration import ImuBuffer, Preintegrator, Propagation
from air.odometry.settings import ImuSettings
from air.sources.simulated.imu import ImuOptions
from air.sources.simulated.motion.mission import FlightOptions
from common.gravity import normal_gravity
from common.measurements import ImuSample
from common.se3 import rotation_angle

GRAVITY = normal_gravity(30.5355, 62.0)
SETTINGS = ImuSettings(gravity=GRAVITY)


def perfect_scene(duration_s: float) -> Scene:
    return Scene(3, duration_s, FlightOptions(start="air"), replace(ImuOptions.perfect(), earth_rate=0))


def buffer_of(samples: list[ImuSample]) -> ImuBuffer:
    buffer = ImuBuffer(SETTINGS)
    for sample in samples:
        assert buffer.add(sample)
    return buffer


def samples_of(scene: Scene) -> list[ImuSample]:
    return list(scene.samples())


def steady(t_s: list[float]) -> list[ImuSample]:
    return [ImuSample(START_NS + round(t * 1e9), np.array([0.0, 0.0, GRAVITY]), np.zeros(3)) for t in t_s]


def test_a_perfect_imu_predicts_where_the_aircraft_will_be() -> None:
    scene = perfect_scene(12.0)
    buffer = buffer_of(samples_of(scene))
    begin_ns, end_ns = START_NS + 1_003_000_000, START_NS + 11_001_700_000
    state = Preintegrator(SETTINGS).predict(scene.state(begin_ns), buffer.between(begin_ns, end_ns))
    truth = scene.state(end_ns)
    # Motion within the two half samples at the ends is all that is lost: 2.5 ms of an acceleration's change.
    assert np.linalg.norm(state.T_world_body.t - truth.T_world_body.t) < 0.01
    assert np.linalg.norm(state.v_world - truth.v_world) < 0.002
    assert rotation_angle(state.T_world_body.R.T @ truth.T_world_body.R) < 1e-3
    assert state.t_ns == end_ns


def test_carrying_on_piece_by_piece_ends_where_one_stretch_ends() -> None:
    scene = perfect_scene(4.0)
    buffer = buffer_of(samples_of(scene))
    edges = [START_NS + round(t * 1e9) for t in (1.0, 1.013, 1.2, 1.2024, 2.9)]
    carried = Propagation(Preintegrator(SETTINGS), scene.state(edges[0]))
    for a, b in pairwise(edges):
        carried.advance(buffer.between(a, b))
    at_once = Preintegrator(SETTINGS).predict(scene.state(edges[0]), buffer.between(edges[0], edges[-1]))
    # Cut samples are integrated in two steps instead of one.
    np.testing.assert_allclose(carried.state.T_world_body.t, at_once.T_world_body.t, atol=1e-4)
    np.testing.assert_allclose(carried.state.v_world, at_once.v_world, atol=1e-4)


@given(
    st.lists(st.integers(1, 40_000_000), min_size=2, max_size=60),
    st.floats(0.0, 1.0),
    st.floats(0.0, 1.0),
)
def test_pieces_fill_any_stretch_of_time(steps_ns: list[int], a: float, b: float) -> None:
    t_ns = np.cumsum(steps_ns)
    buffer = ImuBuffer(SETTINGS)
    for t in t_ns.tolist():
        buffer.add(ImuSample(int(t), np.array([t * 1e-9, 0.0, 0.0]), np.zeros(3)))
    low, high = sorted(int(t_ns[0] + share * (t_ns[-1] - t_ns[0])) for share in (a, b))
    pieces = buffer.between(low, high)
    assert abs(pieces.dt_s.sum() - (high - low) * 1e-9) < 1e-9
    assert (pieces.dt_s > 0).all()
    assert (np.diff(pieces.accel[:, 0]) > 0).all()  # in order, each sample once


def test_a_gap_and_a_saturated_sample_make_the_motion_doubtful() -> None:
    t_s = np.arange(0.0, 1.0, 0.005)
    whole, gap = steady(t_s.tolist()), steady([t for t in t_s.tolist() if not 0.4 < t < 0.6])
    clipped = [replace(s, saturated=i in (80, 81)) for i, s in enumerate(whole)]
    integrator, bias = Preintegrator(SETTINGS), gtsam.imuBias.ConstantBias()
    end_ns = START_NS + 990_000_000
    sigmas = []
    for samples in (whole, gap, clipped):
        pieces = buffer_of(samples).between(START_NS, end_ns)
        measurement = integrator.integrate(pieces, bias)
        sigmas.append(float(np.sqrt(measurement.preintMeasCov()[8, 8])))
        assert abs(measurement.deltaTij() - 0.99) < 1e-9
    assert sigmas[1] > 20 * sigmas[0]
    assert sigmas[0] < sigmas[2] < sigmas[1]


def test_a_late_a_repeated_and_a_broken_sample_are_refused() -> None:
    buffer = buffer_of(steady([0.0, 0.01]))
    late, again = steady([0.005, 0.01])
    broken = replace(steady([0.02])[0], gyro=np.array([0.0, np.nan, 0.0]))
    assert [buffer.add(sample) for sample in (late, again, broken)] == [False] * 3
    assert buffer.refused == 3
    assert buffer.last_ns == START_NS + 10_000_000


def test_forgetting_keeps_what_is_still_needed() -> None:
    buffer = buffer_of(steady(np.arange(0.0, 1.0, 0.005).tolist()))
    begin_ns, end_ns = START_NS + 502_000_000, START_NS + 800_000_000
    before = buffer.between(begin_ns, end_ns)
    buffer.forget(begin_ns)
    after = buffer.between(begin_ns, end_ns)
    np.testing.assert_array_equal(before.dt_s, after.dt_s)
    assert buffer.covers(begin_ns, end_ns)
    assert not buffer.covers(START_NS, end_ns)


def test_a_bias_that_moved_far_asks_for_integration_anew() -> None:
    integrator = Preintegrator(SETTINGS)
    pieces = buffer_of(steady([0.0, 0.005, 0.01])).between(START_NS, START_NS + 10_000_000)
    measurement = integrator.integrate(pieces, gtsam.imuBias.ConstantBias())
    near = gtsam.imuBias.ConstantBias(np.full(3, 0.5 * SETTINGS.accel_bias_step / 3), np.zeros(3))
    far = gtsam.imuBias.ConstantBias(np.zeros(3), np.full(3, SETTINGS.gyro_bias_step))
    assert not integrator.moved(measurement, near)
    assert integrator.moved(measurement, far)
