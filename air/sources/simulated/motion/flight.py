"""A photo survey: where the camera is when, without knowing what is below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.arrays import F64
from common.se3 import SE3, rotation_vector_to_matrix

PERIOD_S = 2.0
TURN_S = 6.0


@dataclass(frozen=True, eq=False)
class Flight:
    """Time stamps and camera poses of a flight, in its own world frame; `lines` has the line of each photo."""

    t_ns: list[int]
    T_world_cam: list[SE3]
    lines: list[int]


def plan_survey(
    rng: np.random.Generator, photos: int, start_ns: int, height: float, along: float, across: float
) -> Flight:
    """A serpentine over a roughly square block around the origin, as a small drone in a breeze flies it.

    `height` m above the origin, photos `along` m apart on lines `across` m apart; the top of each image points
    along its line. Gusts tilt the camera by up to 3° and move it by up to a metre.
    """
    lines = _line_of_photo(photos, along, across)
    count = max(lines) + 1
    heading = rng.uniform(-0.2, 0.2) + np.pi / 2
    roll, pitch, yaw = (_gusts(rng, photos) * np.radians(limit) for limit in (3.0, 3.0, 4.0))
    drift = np.stack([_gusts(rng, photos) * limit for limit in (0.6, 0.6, 1.0)], axis=1)
    t_ns, poses = [], []
    for i, line in enumerate(lines):
        on_line = [k for k, other in enumerate(lines) if other == line]
        ahead = (i - (on_line[0] + on_line[-1]) / 2) * along
        forward = line % 2 == 0
        azimuth = heading if forward else heading + np.pi
        p_line = np.array([ahead if forward else -ahead, (line - (count - 1) / 2) * across])
        t_ns.append(start_ns + round((i * PERIOD_S + line * (TURN_S - PERIOD_S)) * 1e9))
        position = np.array([*(_axes(heading) @ p_line), height]) + drift[i]
        tilt = rotation_vector_to_matrix(np.array([pitch[i], roll[i], 0.0]))
        poses.append(SE3(_looking_down(azimuth + yaw[i]) @ tilt, position))
    return Flight(t_ns, poses, lines)


def _line_of_photo(photos: int, along: float, across: float) -> list[int]:
    """Line index of each photo: as many lines as make the block square, photos spread evenly."""
    lines = max(1, round(float(np.sqrt(photos * along / across))))
    return [i * lines // photos for i in range(photos)]


def _axes(azimuth: float) -> F64:
    """Columns: unit vectors (2,) along an azimuth (from north, clockwise) and to its right, in east and north."""
    return np.array([[np.sin(azimuth), np.cos(azimuth)], [np.cos(azimuth), -np.sin(azimuth)]])


def _looking_down(azimuth: float) -> F64:
    """`R_world_cam` of a camera that looks down, the top of its image along the azimuth."""
    (ahead_e, right_e), (ahead_n, right_n) = _axes(azimuth)
    return np.array([[right_e, -ahead_e, 0.0], [right_n, -ahead_n, 0.0], [0.0, 0.0, -1.0]])


def _gusts(rng: np.random.Generator, n: int) -> F64:
    """Correlated disturbance (n,) within ±1: first-order Gauss–Markov over a few photos, softly limited."""
    white, state = rng.standard_normal(n), 0.0
    out = np.empty(n)
    for i in range(n):
        state = 0.6 * state + 0.8 * white[i]
        out[i] = np.tanh(0.5 * state)
    return out
