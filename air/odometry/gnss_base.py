"""A base station: what the measurements of a known place tell of the errors that a rover nearby has as well.

Source: Misra and Enge, Global Positioning System, 5.6 (differential corrections of code and carrier).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS
from air.odometry.gnss_carrier import CarrierLocks
from air.odometry.gnss_corrections import Signals, correct
from air.odometry.gnss_settings import GnssSelection
from common.arrays import F64, I64
from common.measurements import GnssEpoch

MAX_AGE_S = 10.0
MOVED = 0.05
"""A base that is so far away, m, from where it stood has moved."""


@dataclass(frozen=True, eq=False)
class _Residuals:
    """What is left of the code and the carrier m of each signal at the base, and the arcs of the carriers."""

    t_s: float
    code: dict[tuple[str, bool], float]
    carrier: dict[tuple[str, bool], tuple[float, int]]


@dataclass(frozen=True, eq=False)
class Differences:
    """For M signals of a rover: `code`, `carrier` (M,) m to take off, NaN where unknown; `arc` (M,), −1 if unknown."""

    code: F64
    carrier: F64
    arc: I64


class BaseStation:
    """Holds the newest residuals of a base that stays where it stands."""

    def __init__(self, settings: GnssSelection, p_ecef: F64 | None = None) -> None:
        """`p_ecef` (3,) m is where it stands; without that, where its first epoch that tells a place says."""
        self.p_ecef = p_ecef
        self.fault = ""
        """Why its measurements are of no use, if they are not."""
        self._locks = CarrierLocks(settings)
        self._newest: _Residuals | None = None

    def add(self, epoch: GnssEpoch, broadcast: Ephemerides) -> None:
        """Take an epoch by the base's clock; one of an unknown place, or of another place than before, is refused."""
        self.p_ecef = epoch.p_ecef if self.p_ecef is None else self.p_ecef
        if self.p_ecef is None:
            self.fault = "the base station has not said where it stands"
            return
        moved = 0.0 if epoch.p_ecef is None else float(np.linalg.norm(epoch.p_ecef - self.p_ecef))
        if moved > MOVED:
            # The world would jump along with it, and the map be torn.
            self.fault = f"the base station has moved by {moved:.2f} m: put it back, or begin a new flight"
            self._newest = None
            return
        self.fault = ""
        if self._newest is not None and 0.0 <= self._newest.t_s - epoch.t_ns / SECOND_NS < MAX_AGE_S:
            return  # it came twice, or late: carriers go forwards
        self._take(epoch, correct(epoch, broadcast, self.p_ecef), self.p_ecef)

    def _take(self, epoch: GnssEpoch, signals: Signals, p_ecef: F64) -> None:
        t_s = epoch.t_ns / SECOND_NS
        arcs = self._locks.step(t_s, signals, epoch.lock_s[signals.row])
        ranges = signals.ranges(p_ecef)
        keys = list(zip(signals.satellites, signals.first.tolist(), strict=True))
        code = dict(zip(keys, (signals.code - ranges).tolist(), strict=True))
        carrier = zip(keys, (signals.carrier - ranges).tolist(), arcs.tolist(), strict=True)
        self._newest = _Residuals(t_s, code, {key: (value, arc) for key, value, arc in carrier if arc >= 0})

    def differences(self, t_s: float, signals: Signals) -> Differences:
        """What to take off the signals of a rover at GPST `t_s`; all unknown when the base fell silent."""
        newest = self._newest
        if newest is None or abs(t_s - newest.t_s) > MAX_AGE_S:
            nothing = np.full(len(signals.satellites), np.nan)
            return Differences(nothing, nothing, np.full(len(nothing), -1, np.int64))
        keys = list(zip(signals.satellites, signals.first.tolist(), strict=True))
        carriers = [newest.carrier.get(key, (np.nan, -1)) for key in keys]
        return Differences(
            code=np.array([newest.code.get(key, np.nan) for key in keys], float),
            carrier=np.array([value for value, _ in carriers], float),
            arc=np.array([arc for _, arc in carriers], np.int64),
        )
