"""A base station: what the measurements of a known place tell of the errors that a rover nearby has as well.

Its own noise and echoes would come along, were its codes not smoothed by its carriers. Source: Misra and Enge, Global
Positioning System, 5.6 (differential corrections of code and carrier).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS
from air.odometry.carrier_rates import CarrierRates
from air.odometry.code_smoothing import CodeSmoother
from air.odometry.gnss_carrier import CarrierLocks
from air.odometry.gnss_corrections import Signals, correct
from air.odometry.gnss_settings import GnssSelection
from common.arrays import F64, I64
from common.measurements import GnssEpoch

MAX_AGE_S = 10.0
MOVED = 0.05
"""A base that is so far away, m, from where it stood has moved."""


@dataclass(frozen=True)
class _Left:
    """What is left of a signal at the base: of its code m, smoothed over some s, of its carrier m, of its rate m/s;
    and the arc of the carrier. NaN, and −1, where unknown."""

    code: float = np.nan
    over_s: float = 0.0
    carrier: float = np.nan
    rate: float = np.nan
    arc: int = -1


_UNKNOWN = _Left()


@dataclass(frozen=True, eq=False)
class Differences:
    """For M signals of a rover: `code`, `carrier` (M,) m and `rate` (M,) m/s to take off, NaN where unknown; `arc`
    (M,), −1 if unknown.

    The base's codes were smoothed for `over_s` (M,).
    """

    code: F64
    over_s: F64
    carrier: F64
    rate: F64
    arc: I64


class BaseStation:
    """Holds the newest residuals of a base that stays where it stands."""

    def __init__(self, settings: GnssSelection, p_ecef: F64 | None = None) -> None:
        """`p_ecef` (3,) m is where it stands; without that, where its first epoch that tells a place says."""
        self.p_ecef = p_ecef
        self.fault = ""
        """Why its measurements are of no use, if they are not."""
        self._locks = CarrierLocks(settings)
        self._smoother, self._rates = CodeSmoother(), CarrierRates()
        self._newest: dict[tuple[str, bool], _Left] = {}
        self._newest_s = -np.inf

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
            self._newest = {}
            return
        self.fault = ""
        if 0.0 <= self._newest_s - epoch.t_ns / SECOND_NS < MAX_AGE_S:
            return  # it came twice, or late: carriers go forwards
        self._take(epoch, correct(epoch, broadcast, self.p_ecef), self.p_ecef)

    def _take(self, epoch: GnssEpoch, signals: Signals, p_ecef: F64) -> None:
        t_s = epoch.t_ns / SECOND_NS
        arcs = self._locks.step(t_s, signals, epoch.lock_s[signals.row])
        ranges = signals.ranges(p_ecef)
        smooth, over_s = self._smoother.step(t_s, signals, arcs)
        code, carrier = smooth - ranges, np.where(arcs >= 0, signals.carrier - ranges, np.nan)
        rate = self._rates.step(t_s, signals, carrier, arcs)
        rows = zip(code.tolist(), over_s.tolist(), carrier.tolist(), rate.tolist(), arcs.tolist(), strict=True)
        self._newest = {key: _Left(*row) for key, row in zip(signals.keys, rows, strict=True)}
        self._newest_s = t_s

    def differences(self, t_s: float, signals: Signals) -> Differences:
        """What to take off the signals of a rover at GPST `t_s`; all unknown when the base fell silent."""
        heard = abs(t_s - self._newest_s) <= MAX_AGE_S
        left = [self._newest.get(key, _UNKNOWN) if heard else _UNKNOWN for key in signals.keys]
        return Differences(
            code=np.array([one.code for one in left], float),
            over_s=np.array([one.over_s for one in left], float),
            carrier=np.array([one.carrier for one in left], float),
            rate=np.array([one.rate for one in left], float),
            arc=np.array([one.arc for one in left], np.int64),
        )
