"""A base station: what the measurements of a known place tell of the errors that a rover nearby has as well.

Source: Misra and Enge, Global Positioning System, 5.6 (differential corrections of code and carrier).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.odometry.gnss_carrier import CarrierLocks
from air.odometry.gnss_corrections import Signals
from air.odometry.gnss_settings import GnssSelection
from common.arrays import F64, I64

MAX_AGE_S = 10.0


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
    """Holds the newest residuals of a base at a known place (3,) m, ECEF."""

    def __init__(self, p_ecef: F64, settings: GnssSelection) -> None:
        self.p_ecef = p_ecef
        self._locks = CarrierLocks(settings)
        self._newest: _Residuals | None = None

    def add(self, t_s: float, signals: Signals, lock_s: F64) -> None:
        """Take the signals of an epoch at GPST `t_s` by the base's clock."""
        arcs = self._locks.step(t_s, signals, lock_s)
        ranges = signals.ranges(self.p_ecef)
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
