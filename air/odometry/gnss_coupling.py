"""GNSS beside the window: cleans epochs, finds where the world lies on the earth, then hands them to the window."""

from __future__ import annotations

from collections import deque

import numpy as np

from air.gnss.gnss_time import SECOND_NS
from air.odometry.gnss_factors import Misfit
from air.odometry.gnss_preprocessing import CleanEpoch, GnssPreprocessor
from air.odometry.gnss_settings import GnssSettings
from air.odometry.gnss_start import GnssStart
from air.odometry.gnss_window import GYRO_NS, GnssWindow
from air.odometry.gnss_world import WorldSearch
from air.odometry.preintegration import ImuBuffer, InertialState
from air.odometry.window import Window
from common.arrays import F64
from common.geo import T_ecef_enu
from common.measurements import GnssEpoch
from common.messages import Datum

WAITING = 50
"""Epochs that wait for the IMU; older ones are given up."""
SIGMA_CYCLES = 0.05
"""Below it carriers of whole cycles place the aircraft, m; codes add nothing."""
PLACING_S = 5.0
"""Ranges of another kind have placed the aircraft within so long."""


class GnssCoupling:
    """What GNSS is to the odometry of one flight. What satellites broadcast is kept whatever happens to the window."""

    def __init__(self, settings: GnssSettings, imu: ImuBuffer, flight: str, base: F64 | None = None) -> None:
        """`base` (3,) m, ECEF, is where a base station stands, unless its epochs, which come by `add_base`, tell it."""
        self._settings, self._imu, self._flight = settings, imu, flight
        self._preprocessor = GnssPreprocessor(settings, base)
        self._lever = np.array(settings.p_body_antenna)
        self._waiting: deque[GnssEpoch] = deque(maxlen=WAITING)
        self._near: F64 | None = None
        self._companion: GnssWindow | None = None
        self._search = WorldSearch(flight)
        self.start = GnssStart(settings, flight)
        self.datum: Datum | None = None
        self._used = (0, 0)
        self._anchor_sigma = 0.0
        self._differential = False
        self._began_ns: int | None = None
        self.why_not = "no epochs so far"

    # Measurements

    def add(self, message: object) -> None:
        """Keep what satellites broadcast; ignore anything else."""
        self._preprocessor.add(message)

    def add_base(self, epoch: GnssEpoch) -> None:
        """Take an epoch of the base station."""
        self._preprocessor.add_base(epoch)

    def add_epoch(self, epoch: GnssEpoch) -> None:
        """Take an epoch of the receiver on board."""
        self._waiting.append(epoch)

    @property
    def base_fault(self) -> str:
        """Why the measurements of the base station are of no use, if they are not."""
        return self._preprocessor.base.fault

    def ready(self) -> list[CleanEpoch]:
        """The epochs that IMU samples cover by now, cleaned."""
        out, last_ns = [], self._imu.last_ns
        while self._waiting and last_ns is not None and self._waiting[0].t_ns <= last_ns:
            epoch = self._preprocessor.clean(self._waiting.popleft(), self._near)
            if not isinstance(epoch, CleanEpoch):
                self.why_not = epoch.reason
            elif self._imu.covers(epoch.t_ns, epoch.t_ns):
                self._near = epoch.fix.position if epoch.fix is not None else self._near
                out.append(epoch)
        return out

    def satellites(self, t_ns: int) -> int:
        """How many satellites are in use at a time."""
        used_ns, count = self._used
        return count if self._companion is not None and t_ns - used_ns < SECOND_NS else 0

    # The window

    def couple(self, window: Window, epoch: CleanEpoch) -> bool:
        """Hand an epoch to the window; whether the world has been found, to which the window has jumped."""
        if self._companion is not None:
            self._add(window, epoch)
            return False
        state = window.state_at(epoch.t_ns)
        if state is None:
            return False
        found = self._search.add(epoch, *self._antenna(state))
        if isinstance(found, str):
            self.why_not = found
            return False
        window.move(found.T_world_odom, found.covariance)
        self._anchor_sigma = float(np.sqrt(np.trace(found.covariance[:3, :3])))
        self.join(window, found.datum)
        for passed in self._search.since(window.frames[0].t_ns):
            self._add(window, passed)
        return True

    def fix(self, window: Window) -> bool:
        """Whether the place has just become known to whole cycles of a base station's carriers."""
        return self._companion is not None and self._companion.fix(window)

    def places_anew(self, t_ns: int) -> bool:
        """Whether ranges of another kind have begun lately to tell the place: differences to a base station."""
        return self._began_ns is not None and t_ns - self._began_ns < PLACING_S * SECOND_NS

    def misfit(self, window: Window) -> Misfit | None:
        """How well the newest epoch fits; None where none is used."""
        return None if self._companion is None else self._companion.misfit(window.values)

    def join(self, window: Window, datum: Datum) -> None:
        """Be the companion of a window whose world is ENU at a datum."""
        self.datum, self.why_not = datum, ""
        self._companion = GnssWindow(self._settings, self._imu, T_ecef_enu(datum))
        window.companion = self._companion

    def leave(self) -> None:
        """Forget the window, which is no more; the datum stays."""
        self._companion = None
        self._search = WorldSearch(self._flight, self.datum)
        self.start = GnssStart(self._settings, self._flight, self.datum)

    def _add(self, window: Window, epoch: CleanEpoch) -> None:
        assert self._companion is not None
        if self._is_anchored(window, epoch.differential):
            epoch = epoch.without_code()
        if epoch.differential and not self._differential:
            self._began_ns = epoch.t_ns
        self._differential = epoch.differential
        if self._companion.add(window, epoch):
            self._used = epoch.t_ns, int(np.sum(np.isfinite(epoch.code) | np.isfinite(epoch.rate)))

    def _is_anchored(self, window: Window, differential: bool) -> bool:
        """Whether pseudoranges have done their work and the position is still as well known."""
        sigma = float(np.sqrt(np.trace(window.pose_covariance[3:, 3:])))
        if differential:
            return sigma < SIGMA_CYCLES
        return sigma <= self._settings.reanchor * self._anchor_sigma

    def _antenna(self, state: InertialState) -> tuple[F64, F64]:
        """Position (3,) m and velocity (3,) m/s of the antenna in world."""
        omega = self._imu.between(state.t_ns - GYRO_NS, state.t_ns).rate - state.gyro_bias
        T = state.T_world_body
        return T.apply(self._lever), state.v_world + T.R @ np.cross(omega, self._lever)
