"""Where the odometry's frame lies on the earth: found once, from where it says that the antenna was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.gnss.gnss_time import SECOND_NS
from air.odometry.gnss_alignment import align_yaw, find_anchor
from air.odometry.gnss_preprocessing import CleanEpoch
from common.arrays import F64
from common.geo import T_ecef_enu, ecef_to_geodetic
from common.messages import Datum
from common.se3 import SE3

SPAN_S = 60.0
MOST = 60
"""Epochs that the anchor is found from, at most."""
SIGMA_LOCAL = 0.03
"""Of the odometry's velocity, m/s."""
MAX_YAW_SIGMA = np.radians(0.3)
SIGMA_YAW = np.radians(3.0)
"""What the yaw is worth to a window that sees the same Dopplers again, rad."""


@dataclass(frozen=True, eq=False)
class FoundWorld:
    """`T_world_odom`, a turn about the vertical and a shift, with covariance (4, 4) of shift m and turn rad."""

    datum: Datum
    T_world_odom: SE3
    covariance: F64


@dataclass(frozen=True, eq=False)
class _Passed:
    epoch: CleanEpoch
    p_odom: F64
    v_odom: F64
    v_enu: F64
    sigma: float


class WorldSearch:
    """Collects epochs until yaw and place are known."""

    def __init__(self, flight: str, datum: Datum | None = None) -> None:
        """`datum`, when there is one already, stays."""
        self._flight, self._datum = flight, datum
        self._R_enu_ecef: F64 | None = None
        self._passed: list[_Passed] = []

    def add(self, epoch: CleanEpoch, p_odom: F64, v_odom: F64) -> FoundWorld | str:
        """The world, or why it is not known yet; the antenna was at (3,) m and moved with (3,) m/s at the epoch."""
        fix = epoch.fix
        if fix is None or not np.isfinite(fix.velocity).all():
            return "an epoch has no position of its own"
        if self._R_enu_ecef is None:
            self._R_enu_ecef = T_ecef_enu(Datum(self._flight, *ecef_to_geodetic(fix.position).tolist())).R.T
        R = self._R_enu_ecef
        variance = float(np.trace((R @ fix.velocity_covariance @ R.T)[:2, :2])) / 2
        passed = _Passed(epoch, p_odom, v_odom, R @ fix.velocity, np.hypot(np.sqrt(variance), SIGMA_LOCAL))
        oldest_ns = epoch.t_ns - round(SPAN_S * SECOND_NS)
        self._passed = [*(one for one in self._passed if one.epoch.t_ns >= oldest_ns), passed]
        return self._find()

    def since(self, t_ns: int) -> list[CleanEpoch]:
        """The epochs from a time on."""
        return [one.epoch for one in self._passed if one.epoch.t_ns >= t_ns]

    def _find(self) -> FoundWorld | str:
        local, enu = (np.array([getattr(one, name) for one in self._passed]) for name in ("v_odom", "v_enu"))
        yaw = align_yaw(local, enu, np.array([one.sigma for one in self._passed]), MAX_YAW_SIGMA)
        if isinstance(yaw, str):
            return yaw
        chosen = [self._passed[i] for i in np.unique(np.linspace(0, len(self._passed) - 1, MOST).astype(int))]
        near = np.median([one.epoch.fix.position for one in chosen if one.epoch.fix is not None], axis=0)
        p_odom = np.array([one.p_odom for one in chosen])
        anchor = find_anchor(p_odom, [one.epoch for one in chosen], yaw.yaw, near)
        if isinstance(anchor, str):
            return anchor
        origin = anchor.T_ecef_odom.t
        datum = self._datum or Datum(self._flight, *ecef_to_geodetic(origin).tolist())
        c, s = np.cos(yaw.yaw), np.sin(yaw.yaw)
        R_world_odom = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        covariance = np.zeros((4, 4))
        covariance[:3, :3], covariance[3, 3] = anchor.covariance_enu, SIGMA_YAW**2
        return FoundWorld(datum, SE3(R_world_odom, T_ecef_enu(datum).inverse().apply(origin)), covariance)
