"""The filtered solution that a simulated receiver computes of its own measurements."""

from __future__ import annotations

import numpy as np

from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS
from air.gnss.navigation_message import NavigationMessages
from air.gnss.positioning import PointPosition, find_position
from air.gnss.settings import PositioningSettings
from air.sensors.ubx_messages import NavigationBits
from common.arrays import F64
from common.geo import ecef_to_geodetic
from common.measurements import Ephemeris, FixKind, GnssEpoch, Ionosphere, ReceiverSolution

_SMOOTHING_S = 60.0
"""Over so long positions are averaged, carried along by the Dopplers' velocity."""
_COASTING_S, _DRIFTING = 3.0, 1.0
"""For so long a solution without measurements goes on, and grows worse by so many m/s."""
_EVERY_S = 0.15
"""Positions and velocities are found no more often; between them the last ones are carried along."""


class OwnSolution:
    """Position, velocity and time of a receiver, epoch by epoch, from what it has heard so far."""

    def __init__(self, receiver: str, heard: list[Ephemeris | Ionosphere], leap_s: int):
        self._receiver = receiver
        self._leap_s = leap_s
        self._messages = NavigationMessages()
        self._broadcast = Ephemerides(heard)
        self._position: F64 | None = None
        self._velocity = np.zeros(3)
        self._sigma = np.full(2, 4e3)
        self._clock_s = 0.0
        self._kind, self._used = FixKind.NONE, 0
        self._averaged_s = 0.0
        self._seen_ns = self._tried_ns = self._t_ns = 0

    def hear(self, bits: NavigationBits, t_ns: int) -> None:
        """Take a piece of a satellite's message, received at GPST `t_ns`."""
        for message in self._messages.add(bits.satellite, bits.signal, bits.words, bits.channel, t_ns, self._leap_s):
            self._broadcast.add(message)

    def solve(self, epoch: GnssEpoch) -> ReceiverSolution:
        """The solution at an epoch; without any, the last one, marked as none."""
        dt = (epoch.t_ns - self._t_ns) / SECOND_NS
        if self._position is not None and self._kind is not FixKind.NONE:
            self._position = self._position + self._velocity * dt
        self._t_ns = epoch.t_ns
        if epoch.clock_reset or epoch.t_ns - self._tried_ns >= _EVERY_S * SECOND_NS:
            found = find_position(epoch, self._broadcast, PositioningSettings(), self._position)
            if isinstance(found, PointPosition):
                self._update(found)
            else:
                self._coast(epoch.t_ns)
            self._tried_ns = epoch.t_ns
        good = self._kind is FixKind.FIX_3D
        latitude, longitude, height = ecef_to_geodetic(self._position if self._position is not None else _NOWHERE)
        east, north, up = _enu(np.radians(latitude), np.radians(longitude))
        return ReceiverSolution(
            t_ns=epoch.t_ns - round(self._clock_s * SECOND_NS),
            receiver=self._receiver,
            kind=self._kind,
            latitude_deg=float(latitude),
            longitude_deg=float(longitude),
            height=float(height),
            sigma_horizontal=float(self._sigma[0]),
            sigma_vertical=float(self._sigma[1]),
            v_enu=np.array([axis @ self._velocity for axis in (east, north, up)]),
            sigma_velocity=0.1 if good else 5.0,
            sigma_time=2e-8 if good else 1e-3,
            satellites=self._used if good else 0,
        )

    def _coast(self, t_ns: int) -> None:
        lost_s = (t_ns - self._seen_ns) / SECOND_NS
        self._kind = FixKind.NONE if lost_s > _COASTING_S else FixKind.DEAD_RECKONING
        if self._position is not None:
            self._sigma = self._sigma + _DRIFTING * (t_ns - self._tried_ns) / SECOND_NS

    def _update(self, found: PointPosition) -> None:
        dt = (found.t_ns - self._seen_ns) / SECOND_NS
        gained = found.velocity - self._velocity if np.isfinite(found.velocity).all() else np.zeros(3)
        self._velocity = self._velocity + gained
        if self._position is None or self._kind is FixKind.NONE:
            self._position, self._averaged_s = found.position, 0.0
        else:
            carried = self._position + gained * dt / 2  # it came at the speed of the last one
            self._averaged_s = min(self._averaged_s + dt, _SMOOTHING_S)
            self._position = carried + dt / self._averaged_s * (found.position - carried)
        self._kind = FixKind.FIX_3D
        self._used = len(found.used)
        latitude, longitude, _ = ecef_to_geodetic(found.position)
        axes = np.array(_enu(np.radians(latitude), np.radians(longitude)))
        variance = np.diag(axes @ found.covariance @ axes.T)
        self._sigma = np.sqrt([variance[0] + variance[1], variance[2]])
        self._clock_s = next(iter(found.clocks.values()))
        self._seen_ns = found.t_ns


_NOWHERE = np.array([6_378_137.0, 0.0, 0.0])


def _enu(latitude: float, longitude: float) -> tuple[F64, F64, F64]:
    """Unit vectors (3,) in ECEF to the east, the north and up at a place in rad."""
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    east = np.array([-sin_lon, cos_lon, 0.0])
    north = np.array([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat])
    return east, north, np.array([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat])
