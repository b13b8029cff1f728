"""Writes multiple signal messages of RTCM 3, as a base station sends them.

Source: RTCM 10403.3, section 3.5.16.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from air.gnss.calendar import leap_seconds, to_calendar
from air.gnss.gnss_time import BDT_MINUS_GPST_NS, DAY_NS, GPS_EPOCH_NS, SECOND_NS, WEEK_NS
from air.gnss.msm import KINDS, MOSCOW_NS, MOST_CELLS, MS, SIGNALS, SYSTEMS, lock_ms
from air.gnss.signals import LIGHT, frequencies
from common.arrays import F64, I64, U8
from common.measurements import GnssEpoch


@dataclass
class MsmWriter:
    """Writes the messages of a station, MSM4 to MSM7 by `kind`.

    Its ambiguities are whole cycles that keep phases near their codes, for a message holds no other.
    """

    station: int = 1
    kind: int = 7
    _cycles: dict[tuple[str, str], float] = field(default_factory=dict)

    def messages(self, epoch: GnssEpoch) -> list[bytes]:
        """The messages of an epoch, one for each system. Its time tag is rounded to milliseconds, its ranges with it.

        Raises ValueError for more signals than a message holds.
        """
        t_ns = round(epoch.t_ns / 1_000_000) * 1_000_000
        ahead_s = (epoch.t_ns - t_ns) / SECOND_NS
        systems = [s for s in SYSTEMS.items() if any(name[0] == s[1] for name in epoch.satellites)]
        return [
            self._message(epoch, number * 10 + self.kind, system, t_ns, ahead_s, (number, system) != systems[-1])
            for number, system in systems
        ]

    def _message(self, epoch: GnssEpoch, number: int, system: str, t_ns: int, ahead_s: float, more: bool) -> bytes:
        kind, codes = KINDS[self.kind], {name: i for i, name in SIGNALS[system].items()}
        which = [
            i
            for i, (satellite, signal) in enumerate(zip(epoch.satellites, epoch.signals, strict=True))
            if satellite[0] == system and signal in codes and np.isfinite(epoch.pseudorange[i])
        ]
        which.sort(key=lambda i: (epoch.satellites[i], codes[epoch.signals[i]]))
        slots = sorted({int(epoch.satellites[i][1:]) for i in which})
        tracked = sorted({codes[epoch.signals[i]] for i in which})
        if len(slots) * len(tracked) > MOST_CELLS:
            raise ValueError(f"{len(slots)} satellites with {len(tracked)} signals; allowed: 64 of them together")
        row = np.array([slots.index(int(epoch.satellites[i][1:])) for i in which], np.int64)
        f = frequencies([epoch.satellites[i] for i in which], [epoch.signals[i] for i in which], epoch.channel[which])
        code = (epoch.pseudorange[which] - LIGHT * ahead_s) / MS
        rate = -epoch.doppler[which] * LIGHT / f
        first = [int(np.flatnonzero(row == k)[0]) for k in range(len(slots))]
        rough, rough_rate = np.round(code[first] * 1024).astype(np.int64), np.round(np.nan_to_num(rate[first]))
        phase = (epoch.carrier_phase[which] - f * ahead_s) / (f * 1e-3)
        near = rough[row] / 1024
        phase += np.array([self._shift(epoch, i, k, phase, near, f) for k, i in enumerate(which)]) / (f * 1e-3)

        out = _Writer()
        out.many([number, self.station], 12)
        out.many([_told(system, t_ns)], 30)
        out.many([int(more), *[0] * 18], 1)
        out.many([slot in slots for slot in range(1, 65)], 1)
        out.many([one in tracked for one in range(1, 33)], 1)
        pairs = {(int(epoch.satellites[i][1:]), codes[epoch.signals[i]]) for i in which}
        out.many([(slot, one) in pairs for slot in slots for one in tracked], 1)
        out.many(rough // 1024, 8)
        if kind.rates:
            out.many(epoch.channel[which][first] + 7 if system == "R" else np.zeros(len(slots)), 4)
        out.many(rough % 1024, 10)
        if kind.rates:
            out.many(rough_rate, 14)
        out.many(_told_in(code - near, *kind.code), kind.code[0])
        out.many(_told_in(phase - near, *kind.phase), kind.phase[0])
        out.many(_lock_told(epoch.lock_s[which], kind.lock), kind.lock)
        out.many(epoch.half_cycle[which], 1)
        out.many(np.round(np.nan_to_num(epoch.cn0[which]) / kind.cn0[1]), kind.cn0[0])
        if kind.rates:
            out.many(_told_in(rate - rough_rate[row], 15, 1e-4), 15)
        return out.payload()

    def _shift(self, epoch: GnssEpoch, i: int, k: int, phase_ms: F64, near_ms: F64, f: F64) -> float:
        """Whole cycles to be added to a phase; they stay while it is within what a message holds."""
        if np.isnan(phase_ms[k]):
            return np.nan
        key, cycle_ms = (epoch.satellites[i], epoch.signals[i]), 1e3 / f[k]
        held = self._cycles.get(key)
        if held is None or abs(phase_ms[k] + held * cycle_ms - near_ms[k]) > 2**-8 * 0.9:
            held = self._cycles[key] = float(np.round((near_ms[k] - phase_ms[k]) / cycle_ms))
        return held


def _told(system: str, t_ns: int) -> int:
    """The 30 bits that tell a time in GPST."""
    if system == "C":
        t_ns += BDT_MINUS_GPST_NS
    if system != "R":
        return (t_ns - GPS_EPOCH_NS) % WEEK_NS // 1_000_000
    leap_ns = leap_seconds(to_calendar(t_ns)) * SECOND_NS
    day, time_ns = divmod((t_ns - GPS_EPOCH_NS + MOSCOW_NS - leap_ns) % WEEK_NS, DAY_NS)
    return day << 27 | time_ns // 1_000_000


def _told_in(values: F64, width: int, unit: float) -> I64:
    """Values in units; the number that stands for unknown for NaN and where they do not fit."""
    half = 1 << width - 1
    raw = np.round(values / unit)
    return np.where(np.abs(raw) < half, np.nan_to_num(raw), -half).astype(np.int64)


def _lock_told(lock_s: F64, width: int) -> I64:
    """The indicator of so many bits of times of lock."""
    table = lock_ms(np.arange(705 if width == 10 else 16), width)
    return np.asarray(np.searchsorted(table, np.nan_to_num(lock_s) * 1e3 + 1e-6, side="right") - 1, np.int64)


class _Writer:
    def __init__(self) -> None:
        self._bits: list[U8] = []

    def many(self, values: object, width: int) -> None:
        """Append whole numbers of so many bits each."""
        numbers = np.asarray(values).astype(np.int64)
        self._bits.append((numbers[:, None] >> np.arange(width - 1, -1, -1) & 1).astype(np.uint8).ravel())

    def payload(self) -> bytes:
        return np.packbits(np.concatenate(self._bits)).tobytes()
