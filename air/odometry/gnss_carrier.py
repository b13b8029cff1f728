"""Unbroken carriers: which signals keep their phase from epoch to epoch, and which slipped.

A carrier that slips departs from its own Doppler, or from the carrier of the satellite's other band (the
geometry-free combination), or its receiver says so by its lock time. With another ephemeris its range steps, which
amounts to the same. Source: Teunissen and Montenbruck, Springer Handbook of GNSS, 8.4 and 20.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.odometry.gnss_corrections import Signals
from air.odometry.gnss_settings import GnssSelection
from common.arrays import F64, I64

LONGEST_GAP_S = 3.0
"""A carrier that was not seen for longer begins anew."""
_BEND_PER_S2 = 5.0
"""The mean of two Dopplers tells the way between them the less, the longer that takes."""


@dataclass(frozen=True)
class _Seen:
    """A carrier when it was last seen: GPST s, m, m/s, s of lock, the number of its arc and when that began, and the
    ephemeris in it."""

    t_s: float
    carrier: float
    rate: float
    lock_s: float
    arc: int
    since_s: float
    issue: int


class CarrierLocks:
    """Numbers the unbroken arcs of every carrier."""

    def __init__(self, settings: GnssSelection) -> None:
        self._settings = settings
        self._seen: dict[tuple[str, bool], _Seen] = {}
        self._arcs = 0
        self.slips = 0

    def step(self, t_s: float, signals: Signals, lock_s: F64) -> I64:
        """Number of the arc (M,) of each signal's carrier at GPST `t_s`, −1 where it is not locked for long enough.

        `lock_s` (M,) is what the receiver says, NaN where it does not.
        """
        keys = signals.keys
        last = [self._last(key, t_s) for key in keys]
        slipped = self._slipped(t_s, signals, lock_s, last)
        arcs = np.full(len(keys), -1, np.int64)
        for i, (key, before) in enumerate(zip(keys, last, strict=True)):
            carrier = float(signals.carrier[i])
            if not np.isfinite(carrier):
                self._seen.pop(key, None)
                continue
            if before is None or slipped[i]:
                self.slips += before is not None
                self._arcs += 1
                told = 0.0 if before is not None or np.isnan(lock_s[i]) else float(lock_s[i])
                arc, since_s = self._arcs, t_s - told
            else:
                arc, since_s = before.arc, before.since_s
            self._seen[key] = _Seen(
                t_s, carrier, float(signals.rate[i]), float(lock_s[i]), arc, since_s, int(signals.issue[i])
            )
            if t_s - since_s >= self._settings.min_lock_s:
                arcs[i] = arc
        return arcs

    def _last(self, key: tuple[str, bool], t_s: float) -> _Seen | None:
        seen = self._seen.get(key)
        return seen if seen is not None and 0.0 < t_s - seen.t_s <= LONGEST_GAP_S else None

    def _slipped(self, t_s: float, signals: Signals, lock_s: F64, last: list[_Seen | None]) -> list[bool]:
        """Whether each carrier slipped since it was last seen."""
        settings, m = self._settings, len(last)
        dt, gone, told, before = np.full((4, m), np.nan)
        for i, seen in enumerate(last):
            if seen is not None:
                dt[i], told[i], before[i] = t_s - seen.t_s, seen.lock_s, seen.carrier
                gone[i] = signals.carrier[i] - seen.carrier - (signals.rate[i] + seen.rate) / 2 * dt[i]
        known = np.isfinite(gone)
        gone -= np.median(gone[known]) if known.any() else 0.0  # what all share is the receiver's clock
        slipped = np.abs(gone) > settings.max_slip + settings.max_slip * _BEND_PER_S2 * dt**2
        slipped |= (lock_s < told) | (lock_s < 0.99 * dt)
        others = [seen is not None and seen.issue != issue for seen, issue in zip(last, signals.issue, strict=True)]
        slipped |= np.array(others, bool)
        moved = dict(zip(signals.keys, signals.carrier - before, strict=True))
        for i, satellite in enumerate(signals.satellites):
            split = moved.get((satellite, True), np.nan) - moved.get((satellite, False), np.nan)
            slipped[i] |= abs(split) > settings.max_split
        return [bool(value) for value in slipped]
