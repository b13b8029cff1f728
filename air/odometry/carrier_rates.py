"""How fast what spoils the carriers of a standing receiver changes: satellite clocks, orbits and air.

What all carriers have in common is the receiver's own clock, and of no interest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.odometry.gnss_corrections import Signals
from common.arrays import F64, I64

MEAN_S = 60.0
"""Rates are the mean over so long, at most."""
LEAST_S = 5.0
"""Over less than that, carriers are noisier than what they are to tell."""


@dataclass(frozen=True)
class _Seen:
    """A carrier's arc, when it was seen last, GPST s, what was left of it m, and its mean rate m/s over how many s."""

    arc: int
    t_s: float
    left: float
    rate: float = 0.0
    over_s: float = 0.0


class CarrierRates:
    """Follows the carriers of one receiver epoch by epoch."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, bool], _Seen] = {}

    def step(self, t_s: float, signals: Signals, left: F64, arcs: I64) -> F64:
        """Rates (M,) m/s at GPST `t_s` of what is `left` (M,) m of the carriers, NaN where they are not known yet.

        `arcs` (M,) number the unbroken carriers, −1 where there is none.
        """
        keys = signals.keys
        last = [self._seen.get(key) for key in keys]
        moved = np.full(len(keys), np.nan)
        for i, seen in enumerate(last):
            if seen is not None and arcs[i] >= 0 and seen.arc == arcs[i]:
                moved[i] = (left[i] - seen.left) / (t_s - seen.t_s)
        known = np.isfinite(moved)
        moved -= np.median(moved[known]) if known.any() else 0.0
        self._seen, rates = {}, np.full(len(keys), np.nan)
        for i, (key, before) in enumerate(zip(keys, last, strict=True)):
            if arcs[i] < 0:
                continue
            now = _Seen(int(arcs[i]), t_s, float(left[i]))
            if before is not None and known[i]:
                dt_s = t_s - before.t_s
                over_s = min(before.over_s + dt_s, MEAN_S)
                rate = before.rate + dt_s / over_s * (float(moved[i]) - before.rate)
                now = _Seen(now.arc, t_s, now.left, rate, over_s)
            self._seen[key] = now
            rates[i] = now.rate if now.over_s >= LEAST_S else np.nan
        return rates
