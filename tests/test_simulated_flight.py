"""The simulated flight: one consistent motion, missions, wind, and what a multirotor does in it."""

from __future__ import annotations

import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.interpolate import BSpline

from air.sources.simulated.motion.mission import FlightOptions, Phase, plan
from air.sources.simulated.motion.multirotor import DRAG, GRAVITY, fly
from air.sources.simulated.motion.spline import DEGREE, Spline
from air.sources.simulated.motion.trajectory import Motion, Trajectory
from air.sources.simulated.motion.wind import gusts, mean_wind, turbulence
from common.arrays import F64
from common.config import parse
from common.errors import ConfigError
from common.se3 import rotation_vector, rotation_vector_to_matrix

HOME = np.array([3.0, -2.0, 5.25])
CALM = FlightOptions(wind=0.0, gusts=0.0, shake_deg=0.0)


def flown(options: FlightOptions = FlightOptions(), duration_s: float = 300.0, seed: int = 1) -> Trajectory:  # noqa: B008
    return fly(options, seed, duration_s, HOME)[0]


def arrays(motion: Motion) -> list[F64]:
    return [getattr(motion, f.name) for f in fields(motion)]


# One function of time


@pytest.mark.parametrize("begin_s", [7.0, 46.03, 99.99, 245.0])
def test_accelerations_and_rates_integrate_to_positions_and_attitudes(begin_s: float) -> None:
    """The midpoint rule at 2 kHz over 10 s; its error is the step squared times the third derivative / 24: < 1e-7."""
    step_s, trajectory = 5e-4, flown()
    t_s = begin_s + np.arange(0, 10, step_s)
    start, middle, end = (trajectory.at(t_s + shift) for shift in (0.0, step_s / 2, step_s))
    for first, rate, value in (
        (start.v_world, middle.a_world, end.v_world),
        (start.p_world, middle.v_world, end.p_world),
        (start.omega_body, middle.alpha_body, end.omega_body),
    ):
        np.testing.assert_allclose(first[0] + np.cumsum(rate * step_s, axis=0), value, atol=1e-6)
    R = start.R_world_body[0]
    for omega in middle.omega_body:
        R = R @ rotation_vector_to_matrix(omega * step_s)
    assert np.linalg.norm(rotation_vector(R.T @ end.R_world_body[-1])) < 1e-6


def test_the_motion_at_a_time_depends_on_nothing_else() -> None:
    trajectory, t_s = flown(), np.linspace(0, 300, 5001)
    together = arrays(trajectory.at(t_s))
    order = np.random.default_rng(0).permutation(len(t_s))
    for all_at_once, shuffled in zip(together, arrays(trajectory.at(t_s[order])), strict=True):
        np.testing.assert_array_equal(shuffled, all_at_once[order])
    for k in (0, 1, 77, 5000):
        for all_at_once, alone in zip(together, arrays(trajectory.at(t_s[k : k + 1])), strict=True):
            np.testing.assert_array_equal(alone[0], all_at_once[k])
    again = arrays(flown().at(t_s))
    assert all(np.array_equal(a, b) for a, b in zip(together, again, strict=True))
    assert not np.array_equal(flown(seed=2).at(t_s).p_world, together[0])


def test_the_spline_is_the_textbooks() -> None:
    control = np.random.default_rng(3).standard_normal((30, 2))
    spline = Spline(control, 0.1, -1.0)
    knots = -1.0 + 0.1 * (np.arange(30 + DEGREE + 1) - (DEGREE + 1) / 2)
    oracle = BSpline(knots, control, DEGREE)
    t_s = np.linspace(spline.begin_s, spline.end_s, 500)
    values = spline.at(t_s)
    for order in range(3):
        np.testing.assert_allclose(values[:, order], oracle(t_s, nu=order), atol=1e-9 * 100**order)
    with pytest.raises(ValueError, match="reaches from"):
        spline.at(np.array([spline.end_s + 0.01]))


def test_the_body_moves_no_quicker_than_a_multirotor() -> None:
    t_s = np.arange(0, 300, 0.01)
    motion = flown().at(t_s)
    assert np.linalg.norm(np.diff(motion.a_world, axis=0), axis=1).max() / 0.01 < 4.0  # jerk, m/s³
    assert np.linalg.norm(motion.a_world, axis=1).max() < 3.0
    assert np.abs(motion.omega_body).max() < np.radians(90)
    assert np.linalg.norm(motion.alpha_body, axis=1).max() < 8.0
    assert np.degrees(np.arccos(motion.R_world_body[:, 2, 2])).max() < 25


def test_a_long_flight_takes_little_memory() -> None:
    tracemalloc.start()
    trajectory = flown(duration_s=600.0)
    for begin_s in range(0, 600, 20):
        trajectory.at(begin_s + np.arange(0, 1, 0.005))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6


# Missions


def test_a_mission_stands_climbs_surveys_returns_and_lands() -> None:
    trajectory, mission = fly(FlightOptions(), 1, 300.0, HOME)
    met = [mission.phase(t) for t in range(300)]
    order = list(dict.fromkeys(met))
    assert order == [Phase.STAND, Phase.TAKE_OFF, Phase.HOVER, Phase.SURVEY, Phase.RETURN, Phase.LAND]
    still = trajectory.at(np.arange(0, 5, 0.005))
    assert np.abs(still.p_world - HOME).max() < 1e-12
    assert max(np.abs(still.v_world).max(), np.abs(still.omega_body).max()) < 1e-12  # rounding
    assert trajectory.thrust(np.array([1.0]))[0] == 0.0
    end = trajectory.at(np.array([299.0]))
    np.testing.assert_allclose(end.p_world[0], HOME, atol=1e-9)
    assert np.abs(end.v_world).max() < 1e-9


def test_survey_lines_are_flown_level_at_speed_and_nose_ahead() -> None:
    trajectory, mission = fly(FlightOptions(azimuth_deg=30.0), 1, 300.0, HOME)
    lines = [k for k, p in enumerate(mission.phases) if p is Phase.SURVEY and mission.t_s[k + 1] - mission.t_s[k] > 20]
    assert len(lines) >= 4
    for k in lines:
        motion = trajectory.at(np.arange(mission.t_s[k] + 5, mission.t_s[k + 1] - 5, 0.1))
        assert np.abs(motion.p_world[:, 2] - HOME[2] - 40).max() < 1.0
        assert np.linalg.norm(motion.v_world, axis=1).mean() == pytest.approx(3.0, abs=0.1)
        nose = motion.R_world_body[:, :, 0]
        assert np.sum(nose * motion.v_world, axis=1).min() > 2.4
        ahead = motion.v_world[:, :2].mean(axis=0) / 3.0
        assert abs(abs(ahead @ [np.sin(np.radians(30)), np.cos(np.radians(30))]) - 1) < 0.05


def test_a_flight_may_begin_in_the_air_at_full_speed() -> None:
    start = flown(replace(CALM, start="air"), 20.0).at(np.zeros(1))
    assert start.p_world[0, 2] == pytest.approx(HOME[2] + 40.0, abs=1e-6)
    assert np.linalg.norm(start.v_world) == pytest.approx(3.0, abs=1e-6)
    hover = flown(replace(CALM, start="air", mission="hover"), 20.0).at(np.linspace(0, 20, 50))
    assert np.abs(hover.v_world).max() < 1e-9


def test_waypoints_are_passed_and_home_is_reached() -> None:
    options = replace(CALM, waypoints="0,30,20;40,30,10", speed=5.0)
    motion = flown(options, 200.0).at(np.linspace(0, 200, 4000))
    for place in ([0, 30, 20], [40, 30, 10]):
        # A turn by a right angle is cut by about speed · averaging time / 8 · √2.
        assert np.linalg.norm(motion.p_world - HOME - place, axis=1).min() < 5.5
    np.testing.assert_allclose(motion.p_world[-1], HOME, atol=1e-9)


@pytest.mark.parametrize("waypoints", ["1,2", "a,b,c", "1,2,3", "1,2,-3;4,5,6", "nan,0,5;1,1,5"])
def test_waypoints_that_are_none_are_named(waypoints: str) -> None:
    with pytest.raises(ConfigError, match="waypoints"):
        plan(FlightOptions(waypoints=waypoints), 100.0)


def test_options_come_from_text_and_impossible_ones_are_named() -> None:
    assert parse({"height": 25, "start": "air"}, FlightOptions) == FlightOptions(height=25.0, start="air")
    with pytest.raises(ConfigError, match="height is 1000"):
        parse({"height": 1000}, FlightOptions)


@pytest.mark.parametrize("mission", ["survey", "hover", "stand"])
@pytest.mark.parametrize("duration_s", [1.0, 33.0, 1800.0])
def test_any_duration_can_be_flown(mission: str, duration_s: float) -> None:
    options = parse({"mission": mission}, FlightOptions)
    motion = flown(options, duration_s).at(np.linspace(-1.0, duration_s + 1.0, 100))
    assert all(np.isfinite(values).all() for values in arrays(motion))
    assert motion.p_world[:, 2].min() >= HOME[2] - 1e-9


# Wind


def test_dryden_turbulence_has_the_standards_deviations_and_correlations() -> None:
    """At 40 m with 5 m/s at 20 ft; the correlation functions belong to the Dryden spectra (MIL-F-8785C, 3.7.2.2)."""
    height, wind, airspeed, step_s, n = 40.0, 5.0, 25.0, 0.05, 400_000
    u, v, w = turbulence(np.random.default_rng(4), wind, height, airspeed, step_s, n).T
    feet = height / 0.3048
    sigma_w, sigma_u = 0.1 * wind, 0.1 * wind / (0.177 + 0.000823 * feet) ** 0.4
    length_u = 0.3048 * feet / (0.177 + 0.000823 * feet) ** 1.2
    for lag in (0, 10, 40):
        # 3000 and more independent values: 4 % of the variance is about two sigma.
        x, y = lag * step_s * airspeed / length_u, lag * step_s * airspeed / height
        found = [np.mean(s[: n - lag] * s[lag:]) for s in (u, v, w)]
        expected = [
            sigma_u**2 * np.exp(-x),
            sigma_u**2 * np.exp(-x) * (1 - x / 2),
            sigma_w**2 * np.exp(-y) * (1 - y / 2),
        ]
        np.testing.assert_allclose(found, expected, atol=0.05 * sigma_u**2)
    assert abs(np.corrcoef(u, v)[0, 1]) < 0.05


def test_wind_grows_with_height_and_gusts_rise_and_fall() -> None:
    speeds = mean_wind(5.0, np.array([0.0, 20 * 0.3048, 40.0]))
    assert speeds[1] == pytest.approx(5.0)
    assert speeds[0] < speeds[1] < speeds[2] < 8.0
    blown = gusts(np.random.default_rng(1), 3.0, 0.02, 30_000)
    speed = np.linalg.norm(blown, axis=1)
    assert 1.2 < speed.max() < 3.2
    assert np.mean(speed == 0) > 0.5
    assert np.abs(np.diff(blown, axis=0)).max() / 0.02 < 4.0  # m/s²: no jumps


def test_wind_moves_the_body_by_decimetres_and_calm_air_by_nothing() -> None:
    t_s = np.linspace(40, 220, 9001)
    calm, windy, stormy = (
        flown(o).at(t_s).p_world for o in (CALM, FlightOptions(), FlightOptions(wind=10.0, gusts=8.0))
    )
    excursion = windy - calm
    assert excursion.std(axis=0).min() > 0.03
    assert 0.2 < np.linalg.norm(excursion, axis=1).max() < 1.5
    assert np.linalg.norm(stormy - calm, axis=1).max() < 4.0
    reference = plan(CALM, 300.0).reference(40.0, 0.02, 9001).p
    np.testing.assert_allclose(calm - HOME, reference, atol=1e-3)  # what the spline rounds off


def test_the_body_leans_into_wind_and_accelerations() -> None:
    steady = replace(CALM, mission="hover", wind=6.0, turbulence=0.0, wind_from_deg=270.0)
    motion = flown(steady, 120.0).at(np.array([60.0]))
    drag = DRAG * float(mean_wind(6.0, np.array([40.0]))[0])
    np.testing.assert_allclose(motion.R_world_body[0, :, 2] * np.hypot(drag, GRAVITY), [-drag, 0, GRAVITY], atol=1e-6)
    t_s = np.arange(40, 220, 0.05)
    moving = flown(CALM).at(t_s)
    thrust = moving.a_world + DRAG * moving.v_world + [0, 0, GRAVITY]
    direction = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    np.testing.assert_allclose(moving.R_world_body[:, :, 2], direction, atol=1e-3)
