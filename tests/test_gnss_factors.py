"""GNSS factors of the odometry agree with their own measurements, computed the long way round."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gnss_scene import DATUM

from air.gnss.gnss_time import SECOND_NS
from air.gnss.orbit import geometric_range
from air.gnss.signals import LIGHT
from air.odometry.gnss_biases import BiasNode, Kind, first_node, needed, next_node
from air.odometry.gnss_factors import STATES, AntennaMotion, antenna_motion, linearise, misfit
from air.odometry.gnss_preprocessing import CleanEpoch
from air.odometry.gnss_settings import GnssNoise
from air.odometry.mounting import ANTENNA, COLUMNS, MOUNTING
from air.odometry.quadratic import Quadratic
from common.arrays import F64
from common.geo import T_ecef_enu

T_ECEF_WORLD = T_ecef_enu(DATUM)
LEVER = np.array([-0.12, 0.02, 0.22])
OMEGA = np.array([0.2, -0.1, 0.4])
NOISE = GnssNoise()
SYSTEMS = ("G", "G", "G", "G", "E", "E", "E", "E")


def measured_way() -> gtsam.PreintegratedCombinedMeasurements:
    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(9.79)
    measured = gtsam.PreintegratedCombinedMeasurements(parameters, gtsam.imuBias.ConstantBias())
    for _ in range(100):
        measured.integrateMeasurement(np.array([0.3, -0.2, 9.9]), OMEGA, 0.005)
    return measured


WAY = measured_way()
POSE = gtsam.Pose3(gtsam.Rot3.Ypr(0.7, 0.1, -0.2), np.array([4.0, -3.0, 40.0]))
VELOCITY = np.array([2.0, 1.0, -0.5])
IMU_BIAS = gtsam.imuBias.ConstantBias(np.array([0.05, -0.02, 0.03]), np.array([0.004, -0.003, 0.002]))


def moved(delta: F64) -> AntennaMotion:
    """The antenna after a small change of the columns of keyframe and mounting."""
    bias = IMU_BIAS.vector() + delta[9:15]
    return antenna_motion(
        POSE.retract(delta[:6]),
        VELOCITY + delta[6:9],
        gtsam.imuBias.ConstantBias(bias[:3], bias[3:]),
        WAY,
        LEVER + delta[15:][ANTENNA],
        OMEGA,
    )


def test_the_antenna_moves_with_the_keyframe_as_its_derivatives_say() -> None:
    here, step = moved(np.zeros(STATES)), 1e-5
    for column in range(STATES):
        delta = np.zeros(STATES)
        delta[column] = step
        ahead, behind = moved(delta), moved(-delta)
        # Central differences of smooth functions: the step's square, and rounding divided by the step.
        assert (ahead.p_world - behind.p_world) / (2 * step) == pytest.approx(here.p_by_state[:, column], abs=1e-6)
        assert (ahead.v_world - behind.v_world) / (2 * step) == pytest.approx(here.v_by_state[:, column], abs=1e-6)


def epoch_at(p_world: F64, v_world: F64, clock: float, drift: float, biases: F64) -> CleanEpoch:
    """Measurements of eight satellites from a place, with a bias (8,) of each code."""
    rng = np.random.default_rng(3)
    n = len(SYSTEMS)
    azimuth, elevation = np.linspace(0, 2 * np.pi, n, endpoint=False), rng.uniform(0.3, 1.4, n)
    enu = np.stack(
        [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
    )
    p_sat = T_ECEF_WORLD.apply(2.3e7 * enu)
    v_sat = 3e3 * np.cross(enu, [0.0, 0.6, 0.8]) @ T_ECEF_WORLD.R.T
    p, v = T_ECEF_WORLD.apply(p_world), T_ECEF_WORLD.R @ v_world
    ranges = geometric_range(p_sat, p)[0]
    tick = 1e-3
    # The rate of the range, the turn of the earth included, by its own difference.
    ahead, behind = (geometric_range(p_sat + dt * v_sat, p + dt * v)[0] for dt in (tick, -tick))
    rates = (ahead - behind) / (2 * tick)
    later = np.where(np.array(SYSTEMS) == "E", 7.0, 0.0)
    names = tuple(f"{system}{i:02d}" for i, system in enumerate(SYSTEMS, 1))
    ones = np.ones(n)
    with_carrier = np.arange(n) % 2 == 0
    return CleanEpoch(
        t_ns=3 * SECOND_NS,
        satellites=names,
        systems=SYSTEMS,
        p_satellite=p_sat,
        v_satellite=v_sat,
        code=ranges + clock + later + biases,
        carrier=np.where(with_carrier, ranges + clock + 1000.0 * np.arange(n), np.nan),
        rate=rates + drift,
        arcs=tuple(f"{name}/1" if use else "" for name, use in zip(names, with_carrier, strict=True)),
        sigma_code=0.5 * ones,
        sigma_carrier=0.005 * ones,
        sigma_rate=0.05 * ones,
        sigma_multipath=3.0 * ones,
        sigma_slow=2.0 * ones,
        slow_s=2700.0 * ones,
        sigma_drift=0.003 * ones,
        elevation=elevation,
        offset=np.where(with_carrier, 1000.0 * np.arange(n), np.nan),
        fix=None,
    )


def node_for(epoch: CleanEpoch, biases: F64) -> tuple[BiasNode, F64]:
    """A node with the true biases of an epoch."""
    node, _ = first_node(0, epoch.t_ns, needed([epoch], NOISE))
    u = np.zeros(len(node))
    for i, name in enumerate(epoch.satellites):
        u[node.biases[Kind.MULTIPATH, name]] = biases[i]
        if epoch.arcs[i]:
            u[node.biases[Kind.AMBIGUITY, epoch.arcs[i]]] = 1000.0 * i
    u[node.biases[Kind.SYSTEM, "E"]] = 7.0
    return node, u


def test_a_true_state_leaves_no_residual_whatever_the_clock_shows() -> None:
    motion, biases = moved(np.zeros(STATES)), np.linspace(-3, 3, 8)
    epoch = epoch_at(motion.p_world, motion.v_world, 12_345.6, -78.9, biases)
    linear = linearise(epoch, motion, *node_for(epoch, biases), T_ECEF_WORLD, np.inf)
    assert linear.rows == 8 + 4 + 4  # codes, carriers, Dopplers of those without carrier
    assert linear.f < 1e-6  # sigmas²: rounding of 2e7 m against 5 mm


def test_the_factor_finds_the_state_that_the_measurements_were_made_with() -> None:
    """So many columns are more than one epoch tells: only what it tells must come out."""
    rng = np.random.default_rng(1)
    delta = np.concatenate(
        [0.002 * rng.standard_normal(3), rng.standard_normal(3), 0.1 * rng.standard_normal(3), np.zeros(STATES - 9)]
    )
    biases = np.zeros(8)
    truth = moved(delta)
    epoch = epoch_at(truth.p_world, truth.v_world, 100.0, 3.0, biases)
    node, u = node_for(epoch, biases)
    linear = linearise(epoch, moved(np.zeros(STATES)), node, u, T_ECEF_WORLD, np.inf)
    expected = np.concatenate([delta, np.zeros(len(node))])
    left = linear.g - linear.G @ expected
    # Second order of a turn of 2 mrad over metres of lever and way, in units of the gradient.
    assert np.abs(left).max() < 0.01 * np.abs(linear.g).max()


def test_satellites_without_a_place_in_the_node_are_left_out() -> None:
    motion, biases = moved(np.zeros(STATES)), np.zeros(8)
    epoch = epoch_at(motion.p_world, motion.v_world, 0.0, 0.0, biases)
    node, _ = first_node(0, epoch.t_ns, needed([replace(epoch, code=epoch.code.copy())], NOISE))
    stranger = replace(epoch, satellites=("G32", *epoch.satellites[1:]), arcs=("", *epoch.arcs[1:]))
    u = np.zeros(len(node))
    assert linearise(stranger, motion, node, u, T_ECEF_WORLD, np.inf).rows == 7 + 3 + 4


def test_one_wild_code_hardly_counts() -> None:
    motion, biases = moved(np.zeros(STATES)), np.zeros(8)
    wild = np.where(np.arange(8) == 2, 40.0, 0.0)
    epoch = epoch_at(motion.p_world, motion.v_world, 0.0, 0.0, wild)
    node, u = node_for(epoch, biases)
    pulls = [np.linalg.norm(linearise(epoch, motion, node, u, T_ECEF_WORLD, robust).g[3:6]) for robust in (np.inf, 4.0)]
    assert pulls[1] < 0.1 * pulls[0]


def known_at(values: gtsam.Values, node: BiasNode, epoch: CleanEpoch, motion: AntennaMotion, u: F64) -> Quadratic:
    linear = linearise(epoch, motion, node, u, T_ECEF_WORLD, np.inf)
    X, V, B = (gtsam.symbol(letter, 0) for letter in "xvb")
    return Quadratic(
        {X: POSE, V: VELOCITY, B: IMU_BIAS.vector(), MOUNTING: np.zeros(COLUMNS), node.key: u},
        linear.G,
        linear.g,
        linear.f,
    )


def values_of(node: BiasNode, u: F64, pose: gtsam.Pose3 = POSE) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(gtsam.symbol("x", 0), pose)
    values.insert(gtsam.symbol("v", 0), VELOCITY)
    values.insert(gtsam.symbol("b", 0), IMU_BIAS)
    values.insert(MOUNTING, np.zeros(COLUMNS))
    values.insert(node.key, u)
    return values


def test_seen_from_elsewhere_it_says_the_same() -> None:
    motion = moved(np.zeros(STATES))
    epoch = epoch_at(motion.p_world + 0.3, motion.v_world, 5.0, 1.0, np.linspace(-1, 1, 8))
    node, u = node_for(epoch, np.zeros(8))
    known = known_at(values_of(node, u), node, epoch, motion, u)
    shift = np.array([0.2, -0.1, 0.3])
    later = values_of(node, u + 0.5, gtsam.Pose3(POSE.rotation(), POSE.translation() + POSE.rotation().rotate(shift)))
    delta = np.concatenate([[0, 0, 0], shift, np.zeros(STATES - 6), np.full(len(node), 0.5)])
    expected = (known.f - 2 * known.g @ delta + delta @ known.G @ delta) / 2
    assert known.error(later) == pytest.approx(expected, rel=1e-6)
    assert known.at(later).f / 2 == pytest.approx(expected, rel=1e-6)
    assert known.at(later).g == pytest.approx(known.g - known.G @ delta, rel=1e-6, abs=1e-3)


def test_a_prior_knows_no_place_that_its_factors_did_not_know() -> None:
    """A shift of the antenna with all its ambiguities costs nothing, also after the attitude was corrected."""
    motion, biases = moved(np.zeros(STATES)), np.zeros(8)
    epoch = epoch_at(motion.p_world, motion.v_world, 0.0, 0.0, biases)
    epoch = replace(epoch.without_code(), rate=np.full(8, np.nan))
    node, _ = first_node(0, epoch.t_ns, needed([epoch], NOISE))
    u = np.zeros(len(node))
    known = known_at(values_of(node, u), node, epoch, motion, u)
    turned = gtsam.Pose3(POSE.rotation().compose(gtsam.Rot3.Ypr(0.05, 0.01, 0.0)), POSE.translation())
    G = known.at(values_of(node, u, turned)).G
    shift = np.array([1.0, -2.0, 0.5])
    line = geometric_range(epoch.p_satellite, T_ECEF_WORLD.apply(motion.p_world))[1] @ T_ECEF_WORLD.R
    delta = np.zeros(STATES + len(node))
    delta[3:6] = turned.rotation().matrix().T @ shift
    for i, arc in enumerate(epoch.arcs):
        if arc:
            delta[STATES + node.biases[Kind.AMBIGUITY, arc]] = line[i] @ shift
    assert delta @ G @ delta < 1e-6 * (delta[3:6] @ G[3:6, 3:6] @ delta[3:6])


def test_biases_wander_from_node_to_node_as_their_processes_say() -> None:
    epoch = epoch_at(np.zeros(3), np.zeros(3), 0.0, 0.0, np.zeros(8))
    wanted = needed([epoch], NOISE)
    first, known = first_node(0, epoch.t_ns, wanted)
    u = known.point[first.key].copy()
    satellite, arc = epoch.satellites[0], epoch.arcs[0]
    u[first.biases[Kind.MULTIPATH, satellite]] = 2.0
    u[first.biases[Kind.DRIFT, arc]] = 0.5
    u[first.biases[Kind.AMBIGUITY, arc]] = 100.0
    seconds = 6.0
    later, link = next_node(first, u, epoch.t_ns + round(seconds * SECOND_NS), wanted)
    expected = link.point[later.key]
    keep = np.exp(-seconds / NOISE.multipath_s)
    assert expected[later.biases[Kind.MULTIPATH, satellite]] == pytest.approx(2.0 * keep)
    assert expected[later.biases[Kind.AMBIGUITY, arc]] == pytest.approx(100.0 + 0.5 * seconds)
    row = len(first) + later.biases[Kind.MULTIPATH, satellite]
    assert link.G[row, row] ** -0.5 == pytest.approx(3.0 * np.sqrt(1 - keep**2))
    # The same bias before and after, both moved as the process says, costs nothing.
    delta = np.concatenate([np.full(len(first), 0.1), np.zeros(len(later))])
    delta[len(first) :] = -np.linalg.solve(link.G[len(first) :, len(first) :], link.G[len(first) :] @ delta)
    assert delta @ link.G @ delta == pytest.approx(0.0, abs=1e-6)


def test_a_satellite_that_was_away_for_long_begins_anew() -> None:
    epoch = epoch_at(np.zeros(3), np.zeros(3), 0.0, 0.0, np.zeros(8))
    first, _ = first_node(0, epoch.t_ns, needed([epoch], NOISE))
    u = np.zeros(len(first))
    later, _ = next_node(first, u, epoch.t_ns + 61 * SECOND_NS, {})
    assert len(later) == 0
    soon, _ = next_node(first, u, epoch.t_ns + 2 * SECOND_NS, {})
    assert soon.biases == first.biases
    without_carriers, _ = next_node(first, u, epoch.t_ns + 5 * SECOND_NS, {})
    assert without_carriers.biases.keys() == {bias for bias in first.biases if "/" not in bias[1]}


def test_the_misfit_tells_the_clock_and_what_does_not_fit() -> None:
    motion, biases = moved(np.zeros(STATES)), np.zeros(8)
    epoch = epoch_at(motion.p_world, motion.v_world, 3000.0, 4.0, biases)
    node, u = node_for(epoch, biases)
    fits = misfit(epoch, motion, node, u, T_ECEF_WORLD)
    assert max(fits.code, fits.carrier, fits.rate) < 1e-3
    assert fits.clocks_s["G"] == pytest.approx(3000.0 / LIGHT, abs=1e-11)
    assert fits.drift == pytest.approx(4.0 / LIGHT, abs=1e-12)
    spoilt = replace(epoch, code=epoch.code + 2.0 * np.where(np.arange(8) % 2, 1.0, -1.0))
    assert misfit(spoilt, motion, node, u, T_ECEF_WORLD).code == pytest.approx(2.0, abs=0.3)
