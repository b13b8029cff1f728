"""The first state of an aircraft in motion without a camera: attitude from Doppler and IMU, place from the ranges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from air.gnss.gnss_time import SECOND_NS
from air.odometry.gnss_attitude import InitialAttitude, MeasuredVelocity, find_attitude
from air.odometry.gnss_preprocessing import CleanEpoch
from air.odometry.gnss_settings import GnssSettings
from air.odometry.preintegration import ImuBuffer
from air.odometry.settings import ImuSettings
from common.geo import T_ecef_enu, ecef_to_geodetic
from common.gravity import normal_gravity
from common.messages import Datum
from common.se3 import SE3

SPAN_S = 12.0
EVERY_S = 0.5
"""Between two of the velocities that are used."""
SIGMA_PLACE = 30.0
"""What the first single-point position is worth beside the ranges that follow, m."""


class GnssStart:
    """Collects the velocities of epochs until they tell the attitude."""

    def __init__(self, settings: GnssSettings, flight: str, datum: Datum | None = None) -> None:
        """`datum`, when there is one already, stays."""
        self._lever = np.array(settings.p_body_antenna)
        self._flight, self.datum = flight, datum
        self._velocities: list[MeasuredVelocity] = []

    def add(self, epoch: CleanEpoch, imu: ImuBuffer, settings: ImuSettings) -> InitialAttitude | str:
        """State and covariance at the epoch in the world of `datum`, or why they are not known yet."""
        fix = epoch.fix
        if fix is None or not np.isfinite(fix.velocity).all():
            return "an epoch has no position of its own"
        if self._velocities and epoch.t_ns - self._velocities[-1].t_ns < 0.9 * EVERY_S * SECOND_NS:
            return "too soon after the last try"
        if self.datum is None:
            self.datum = Datum(self._flight, *ecef_to_geodetic(fix.position).tolist())
        T_ecef_world = T_ecef_enu(self.datum)
        R = T_ecef_world.R.T
        sigma = np.sqrt(np.diag(R @ fix.velocity_covariance @ R.T))
        oldest_ns = epoch.t_ns - round(SPAN_S * SECOND_NS)
        self._velocities = [v for v in self._velocities if v.t_ns >= oldest_ns]
        self._velocities.append(MeasuredVelocity(epoch.t_ns, R @ fix.velocity, sigma))
        imu.forget(self._velocities[0].t_ns)
        gravity = normal_gravity(self.datum.latitude_deg, self.datum.height)
        found = find_attitude(imu, self._velocities, replace(settings, gravity=gravity))
        if isinstance(found, str):
            return found
        R_world_body = found.state.T_world_body.R
        p_world = T_ecef_world.inverse().apply(fix.position) - R_world_body @ self._lever
        covariance = found.covariance.copy()
        covariance[3:6], covariance[:, 3:6] = 0.0, 0.0
        covariance[3:6, 3:6] = np.eye(3) * SIGMA_PLACE**2
        state = replace(found.state, T_world_body=SE3(R_world_body, p_world))
        return replace(found, state=state, covariance=covariance)
