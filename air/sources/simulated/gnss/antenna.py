"""Antennas of simulated receivers: one carried by the aircraft, one on the ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from air.sources.simulated.motion.trajectory import Trajectory
from common.arrays import F64
from common.geo import T_ecef_enu
from common.messages import Datum

Antenna = Callable[[F64], tuple[F64, F64]]
"""Position and velocity (N, 3) of an antenna in ECEF, m and m/s, at times (N,) s of the flight."""


def carried_antenna(trajectory: Trajectory, p_body_antenna: F64, datum: Datum) -> Antenna:
    """The antenna with its phase centre at (3,) m in body, on an aircraft whose `world` is at the datum."""
    T_ecef_world = T_ecef_enu(datum)

    def at(t_s: F64) -> tuple[F64, F64]:
        motion = trajectory.at(t_s)
        p_world = motion.p_world + motion.R_world_body @ p_body_antenna
        turning = np.einsum("nij,nj->ni", motion.R_world_body, np.cross(motion.omega_body, p_body_antenna))
        return T_ecef_world.apply(p_world), (motion.v_world + turning) @ T_ecef_world.R.T

    return at


def fixed_antenna(p_world: F64, datum: Datum) -> Antenna:
    """An antenna that stands at (3,) m in the `world` of the datum."""
    p_ecef = T_ecef_enu(datum).apply(p_world)

    def at(t_s: F64) -> tuple[F64, F64]:
        return np.repeat(p_ecef[None], len(t_s), axis=0), np.zeros((len(t_s), 3))

    return at
