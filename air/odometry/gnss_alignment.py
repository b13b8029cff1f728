"""Where an odometry's own frame lies on the earth, coarse to fine: yaw from Doppler, then the anchor from all ranges.

Source: Cao, Lu, Shen, GVINS (2022), section VI. The yaw has a closed form here: velocities in the horizontal plane are
complex numbers, and the rotation between two sets of them is the angle of their correlation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from air.gnss.orbit import geometric_range
from air.odometry.gnss_preprocessing import CleanEpoch
from common.arrays import F64
from common.geo import T_ecef_enu, ecef_to_geodetic
from common.messages import Datum
from common.se3 import SE3

MIN_VELOCITIES = 4
MAX_MISFIT = 3.0
"""Residual velocities may be so many times their sigma, as root mean square."""
SIGMA_SYSTEM = 300.0
"""What is known beforehand of a delay between systems, m: where none of the first is seen, all may be shifted."""
ROUNDS = 4
_CONVERGED = 1e-3


@dataclass(frozen=True)
class YawAlignment:
    """`yaw` rad turns local axes into east and north: `v_enu = Rz(yaw) v_local`, with its `sigma` and the `misfit`."""

    yaw: float
    sigma: float
    misfit: float


@dataclass(frozen=True, eq=False)
class Anchor:
    """`T_ecef_odom` with the covariance (3, 3) m² of its position in ENU, and the `misfit` of the ranges in sigmas."""

    T_ecef_odom: SE3
    covariance_enu: F64
    misfit: float


def align_yaw(v_local: F64, v_enu: F64, sigma: F64, most: float) -> YawAlignment | str:
    """The yaw between local velocities (N, 3) m/s and those of Doppler in ENU (N, 3), or why it is not known.

    `sigma` (N,) m/s is of one horizontal component of a pair; the yaw is known with a sigma of at `most` rad. The
    velocities may come at any rate.
    """
    if len(v_local) < MIN_VELOCITIES:
        return f"{len(v_local)} velocities are too few"
    local = v_local[:, 0] + 1j * v_local[:, 1]
    enu = v_enu[:, 0] + 1j * v_enu[:, 1]
    weight = 1.0 / sigma**2
    correlation = np.sum(weight * np.conj(local) * enu)
    power = float(np.sum(weight * np.abs(local) ** 2))
    if power <= 0.0:
        return "the aircraft stands still"
    yaw = float(np.angle(correlation))
    left = enu - np.exp(1j * yaw) * local
    misfit = float(np.sqrt(np.sum(weight * np.abs(left) ** 2) / (2 * len(left) - 1)))
    yaw_sigma = float(max(misfit, 1.0) / np.sqrt(power))
    if misfit > MAX_MISFIT:
        return f"local velocity and Doppler contradict each other: {misfit:.1f} sigmas"
    if yaw_sigma > most:
        return f"yaw known to {np.degrees(yaw_sigma):.1f}° only: it takes moving"
    return YawAlignment(yaw, yaw_sigma, misfit)


def find_anchor(p_odom: F64, epochs: Sequence[CleanEpoch], yaw: float, near: F64) -> Anchor | str:
    """Where the origin of a local trajectory lies, from the codes of all its epochs, or why it is not known.

    `p_odom` (K, 3) m is the antenna at each epoch, `near` (3,) m, ECEF, is about where it was: the median of
    single-point positions. One clock for each epoch and one delay for each further system are solved for besides.
    """
    usable = [(p, epoch) for p, epoch in zip(p_odom, epochs, strict=True) if np.isfinite(epoch.code).sum() >= 2]
    if not usable:
        return "no ranges"
    c, s = np.cos(yaw), np.sin(yaw)
    R_enu_odom = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    R_ecef_enu = T_ecef_enu(Datum("anchor", *ecef_to_geodetic(near).tolist())).R
    R_ecef_odom = R_ecef_enu @ R_enu_odom
    origin = near - R_ecef_odom @ np.mean([p for p, _ in usable], axis=0)
    systems = sorted({name for _, epoch in usable for name in epoch.systems})[1:]
    known = np.diag([0.0, 0.0, 0.0, *np.full(len(systems), SIGMA_SYSTEM**-2.0)])
    normal, misfit = np.eye(3), np.inf
    for _ in range(ROUNDS):
        parts = [_rows(epoch, origin + R_ecef_odom @ p, R_ecef_enu, systems) for p, epoch in usable]
        H, r = np.vstack([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
        normal = H.T @ H + known
        if np.linalg.cond(normal) > 1e12:
            return "ranges do not determine the anchor"
        step = np.linalg.solve(normal, H.T @ r)
        origin = origin + R_ecef_enu @ step[:3]
        misfit = float(np.sqrt(np.mean((r - H @ step) ** 2)))
        if np.linalg.norm(step[:3]) < _CONVERGED:
            break
    # Errors of a satellite stay for the whole trajectory: as many epochs tell no more than one.
    covariance = np.asarray(np.linalg.inv(normal)[:3, :3] * len(usable), np.float64)
    return Anchor(SE3(R_ecef_odom, origin), covariance, misfit)


def _rows(epoch: CleanEpoch, p_ecef: F64, R_ecef_enu: F64, systems: list[str]) -> tuple[F64, F64]:
    """Weighted rows of the codes of one epoch, its clock taken off: for the origin in ENU and the systems' delays."""
    good = np.isfinite(epoch.code)
    distance, line = geometric_range(epoch.p_satellite[good], p_ecef)
    names = np.array(epoch.systems)[good]
    H = np.column_stack([-line @ R_ecef_enu, *(np.where(names == name, 1.0, 0.0) for name in systems)])
    r = epoch.code[good] - distance
    weight = 1.0 / (epoch.sigma_code[good] ** 2 + epoch.sigma_multipath[good] ** 2 + epoch.sigma_slow[good] ** 2)
    H, r = H - weight @ H / weight.sum(), r - weight @ r / weight.sum()
    return H * np.sqrt(weight)[:, None], r * np.sqrt(weight)
