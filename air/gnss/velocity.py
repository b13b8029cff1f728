"""Velocity and clock drift of a receiver from the Dopplers of one epoch, at a known place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.gnss.least_squares import chi_square_limit, cofactor_of, worst_residual
from air.gnss.orbit import EARTH_RATE, geometric_range
from air.gnss.ranges import Ranges
from air.gnss.settings import PositioningSettings
from air.gnss.signals import LIGHT
from common.arrays import F64, Bool


@dataclass(frozen=True, eq=False)
class PointVelocity:
    """`velocity` (3,) m/s, ECEF, with `covariance` (3, 3); `drift` of the clock m/s; `used` (N,) of the ranges.

    All but `used` are NaN where the Dopplers are too few or contradict each other.
    """

    velocity: F64
    covariance: F64
    drift: float
    used: Bool


def find_velocity(ranges: Ranges, used: Bool, position: F64, settings: PositioningSettings) -> PointVelocity:
    """Velocity of a receiver at `position` (3,) m, ECEF, from the rates of the ranges `used` (N,).

    Rates that contradict the others are excluded one by one, the worst first. Source: Misra and Enge, Global
    Positioning System, 6.2, with the Sagnac effect's rate.
    """
    used = used & np.isfinite(ranges.range_rate)
    p_sat, v_sat = ranges.states.position, ranges.states.velocity
    _, line = geometric_range(p_sat, position)
    turn = EARTH_RATE / LIGHT
    # Range rate is linear in the receiver's velocity; the last two terms are the Sagnac effect's.
    sagnac = turn * (v_sat[:, 1] * position[0] - v_sat[:, 0] * position[1])
    still = np.einsum("ij,ij->i", v_sat, line) + sagnac - LIGHT * ranges.states.drift
    H_all = np.column_stack([-line, np.ones(len(line))])
    H_all[:, 0] += turn * p_sat[:, 1]
    H_all[:, 1] -= turn * p_sat[:, 0]
    sigma_all = np.fmax(ranges.sigma_rate, settings.sigma_doppler)
    excluded = 0
    while (redundancy := int(used.sum()) - 4) >= settings.min_redundancy + excluded:
        H, y, sigma = H_all[used], (ranges.range_rate - still)[used], sigma_all[used]
        try:
            cofactor = cofactor_of(H, sigma)
        except np.linalg.LinAlgError:
            break
        x = cofactor @ (H.T @ (y / sigma**2))
        v = y - H @ x
        if v / sigma @ (v / sigma) <= chi_square_limit(max(redundancy, 1)):
            return PointVelocity(x[:3], cofactor[:3, :3], float(x[3]), used)
        worst = worst_residual(v, sigma, H, cofactor)
        if worst is None:
            break
        used[np.flatnonzero(used)[worst]] = False
        excluded += 1
    return PointVelocity(np.full(3, np.nan), np.full((3, 3), np.nan), np.nan, np.zeros_like(used))
