"""The bands of each satellite as one measurement, and as a difference to a base station where there is one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from air.odometry.gnss_base import Differences
from air.odometry.gnss_corrections import Signals
from common.arrays import F64, I64, Bool

_NOMINAL_CN0 = 45.0
_LEAST = 0.7
_MIN_DIFFERENCES = 5
DIFFERENTIAL = "-base"


@dataclass(frozen=True)
class Row:
    """The bands of a satellite as one: `code`, `carrier` m and `rate` m/s, and what spoils these in units of a single
    signal in the zenith. `air` is by how much the ionosphere is in the code, `air_drift` in Doppler and carrier; a
    base station has smoothed its code for `base_s`, and `drift_known` says whether it has told the drift too."""

    code: float
    rate: float
    code_noise: float
    rate_noise: float
    multipath: float
    air: float
    carrier: float = np.nan
    carrier_noise: float = np.nan
    air_drift: float = 1.0
    base_s: float = 0.0
    drift_known: bool = False
    arc: str = ""


@dataclass(frozen=True, eq=False)
class Measured:
    """Signals with their arcs (M,) and how loud they are: sigma (M,) in units of that at 45 dBHz; and what was taken
    off them, if they are differences to a base station."""

    signals: Signals
    arcs: I64
    sigma: F64
    base: Differences | None = None

    def minus(self, base: Differences, usable: Bool) -> tuple[Measured, Bool]:
        """Differences to a base station, where it saw the same signals; all as they are when it saw too few of them."""
        both = usable & np.isfinite(base.code)
        if np.sum(both & self.signals.first) < _MIN_DIFFERENCES:
            return self, usable
        signals = replace(
            self.signals,
            code=self.signals.code - base.code,
            carrier=self.signals.carrier - base.carrier,
            rate=self.signals.rate - np.nan_to_num(base.rate),
        )
        arcs = np.where(base.arc >= 0, self.arcs, -1)
        return Measured(signals, arcs, self.sigma, base), both

    def of(self, i: int, j: int | None) -> Row:
        """The signal `i` of the first band and, where there is one, `j` of the second as one row.

        The ionosphere is taken out where both bands are there, by the combination that is free of it; from differences
        to a base station it is gone already.
        """
        s, name, loud = self.signals, self.signals.satellites[i], self.sigma
        bend = float(s.bend[i])
        if j is None:
            noise = float(loud[i])
            row = Row(
                code=float(s.code[i]),
                rate=float(s.rate[i]),
                code_noise=noise,
                rate_noise=noise,
                multipath=1.0,
                air=bend,
                air_drift=bend,
            )
        else:
            bands = [i, j]
            f1, f2 = s.frequency[bands] ** 2
            mean = np.array([0.5, 0.5])
            free = mean if self.base is not None else np.array([f1, -f2]) / (f1 - f2)
            row = Row(
                code=float(free @ s.code[bands]),
                rate=float(mean @ s.rate[bands]),
                code_noise=float(np.linalg.norm(free * loud[bands])),
                rate_noise=float(np.linalg.norm(mean * loud[bands])),
                multipath=float(np.linalg.norm(free)),
                air=float(mean @ s.bend[bands]) if self.base is not None else 0.0,
                air_drift=float(mean @ s.bend[bands]),
            )
        if self.base is not None:
            used = [i] if j is None else [i, j]
            told = np.isfinite(self.base.rate[used]).all()
            row = replace(row, base_s=float(self.base.over_s[used].mean()), drift_known=bool(told))
        if self.arcs[i] < 0:
            return row
        first = replace(row, carrier=float(s.carrier[i]), carrier_noise=float(loud[i]))
        if self.base is not None:
            return replace(
                first, air_drift=0.0, drift_known=True, arc=f"{name}{DIFFERENTIAL}/{self.arcs[i]}-{self.base.arc[i]}"
            )
        if j is None or self.arcs[j] < 0:
            return replace(first, air_drift=bend, arc=f"{name}/{self.arcs[i]}")
        return replace(
            row,
            carrier=float(free @ s.carrier[bands]),
            carrier_noise=float(np.linalg.norm(free * loud[bands])),
            air_drift=0.0,
            arc=f"{name}/{self.arcs[i]}+{self.arcs[j]}",
        )


def loudness(cn0: F64) -> F64:
    """Sigma (M,) of white noise in units of that at 45 dBHz."""
    known = np.clip(np.where(np.isnan(cn0), _NOMINAL_CN0, cn0), 0.0, 60.0)
    return np.maximum(10 ** ((_NOMINAL_CN0 - known) / 20), _LEAST)
