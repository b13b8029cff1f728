"""A multirotor that flies a mission through wind: reference and wind in, true trajectory out.

Along each axis the aircraft is a mass with drag that a position controller holds by its thrust, which follows its
command with a lag. Thrust per mass is acceleration plus gravity plus drag: so it leans into wind, turns and speed.

Source: R. Mahony, V. Kumar, P. Corke, Multirotor Aerial Vehicles (2012), on the model and the cascade of controllers.
"""

from __future__ import annotations

import numpy as np

from air.sources.simulated.motion.mission import FlightOptions, Mission, Reference, plan
from air.sources.simulated.motion.spline import Spline
from air.sources.simulated.motion.trajectory import CHANNELS, HEADING, POSITION, ROTORS, THRUST, Trajectory
from air.sources.simulated.motion.wind import gusts, mean_wind, turbulence
from common.arrays import F64

STEP_S = 0.02
"""Between control points: the body does nothing that is quicker than some Hz."""
SPARE_S = 1.5
SETTLING_S = 60.0
"""How long the wind has blown before the flight."""
GRAVITY = 9.80665
DRAG = 0.25
"""Per second: 23 m/s of wind make it lean by 30°."""
_BANDWIDTH, _DAMPING = 8.0, 0.8
"""Of the attitude, rad/s."""
_PROPORTIONAL, _DERIVATIVE, _INTEGRAL = 0.9, 1.6, 0.15
_SHAKE_S = 0.3
_WIND, _GUSTS, _SHAKE = 30, 31, 32


def fly(options: FlightOptions, seed: int, duration_s: float, home: F64) -> tuple[Trajectory, Mission]:
    """The true trajectory of a flight and its mission; `home` (3,) m in world is where the IMU stands on the ground.

    Raises ConfigError for waypoints that are none.
    """
    mission = plan(options, duration_s)
    count = round((duration_s + 2 * SPARE_S) / STEP_S) + 6
    reference = mission.reference(-SPARE_S, STEP_S, count)
    excursion, effort = respond(_gusty_air(options, seed, count))
    control = np.empty((count, CHANNELS))
    airborne, shake = reference.airborne[:, None], _shake(options, seed, count)
    control[:, POSITION] = home + reference.p + airborne * excursion
    control[:, THRUST] = airborne * (_steady_thrust(options, reference) + effort + GRAVITY * shake[:, :3])
    control[:, THRUST] += [0.0, 0.0, GRAVITY]
    control[:, HEADING] = reference.heading + reference.airborne * shake[:, 3]
    control[:, ROTORS] = reference.rotors
    return Trajectory(Spline(control, STEP_S, -SPARE_S), duration_s), mission


def respond(wind: F64) -> tuple[F64, F64]:
    """Excursion m and thrust per mass m/s² (N, 3) that a changing wind (SETTLING + N, 3) m/s causes."""
    p, d, i = _PROPORTIONAL, _DERIVATIVE, _INTEGRAL
    square = _BANDWIDTH**2
    # States: integral of the excursion, excursion, its rate, thrust per mass, its rate.
    A = np.array(
        [
            [0, 1, 0, 0, 0],
            [0, 0, 1, 0, 0],
            [0, 0, -DRAG, 1, 0],
            [0, 0, 0, 0, 1],
            [-square * i, -square * p, -square * d, -square, -2 * _DAMPING * _BANDWIDTH],
        ]
    )
    step = _exponential(np.block([[A, np.array([[0, 0, DRAG, 0, 0]]).T], [np.zeros((1, 6))]]) * STEP_S)
    free, forced = step[:5, :5], step[:5, 5:]
    state, out = np.zeros((5, 3)), np.empty((len(wind), 2, 3))
    for k in range(len(wind)):
        out[k] = state[[1, 3]]
        state = free @ state + forced * wind[k]
    flown = out[round(SETTLING_S / STEP_S) :]
    return flown[:, 0], flown[:, 1]


def _gusty_air(options: FlightOptions, seed: int, count: int) -> F64:
    """What comes on top of the mean wind (SETTLING + N, 3) m/s, in world."""
    count += round(SETTLING_S / STEP_S)
    overhead = float(mean_wind(options.wind, np.array(options.height)))
    airspeed = max(float(np.hypot(overhead, options.speed)), 1.0)
    rng = np.random.default_rng([seed, _WIND])
    local = options.turbulence * turbulence(rng, options.wind, options.height, airspeed, STEP_S, count)
    along = _downwind(options)
    left = np.array([-along[1], along[0], 0.0])
    world = local @ np.stack([along, left, [0.0, 0.0, 1.0]])
    return np.asarray(world + gusts(np.random.default_rng([seed, _GUSTS]), options.gusts, STEP_S, count))


def _steady_thrust(options: FlightOptions, reference: Reference) -> F64:
    """Thrust per mass (N, 3) m/s² beyond gravity that the reference takes in the mean wind."""
    velocity = np.gradient(reference.p, STEP_S, axis=0)
    wind = mean_wind(options.wind, reference.p[:, 2])[:, None] * _downwind(options)
    return np.asarray(np.gradient(velocity, STEP_S, axis=0) + DRAG * (velocity - wind))


def _downwind(options: FlightOptions) -> F64:
    azimuth = np.radians(options.wind_from_deg)
    return np.array([-np.sin(azimuth), -np.cos(azimuth), 0.0])


def _shake(options: FlightOptions, seed: int, count: int) -> F64:
    """Trembling (N, 4) rad of the thrust's direction (the third is 0) and of the heading, at some Hz."""
    window = np.hanning(round(_SHAKE_S / STEP_S) + 2)[1:-1]
    white = np.random.default_rng([seed, _SHAKE]).standard_normal((count + len(window) - 1, 4))
    rows = [np.convolve(row, window / np.linalg.norm(window), "valid") for row in white.T]
    return np.asarray(np.radians(options.shake_deg) * np.stack(rows, axis=1) * [1, 1, 0, 1])


def _exponential(M: F64) -> F64:
    """The exponential of a small matrix, by its series."""
    total = term = np.eye(len(M))
    for k in range(1, 30):
        term = term @ M / k
        total = total + term
    return total
