"""Multiple signal messages of RTCM 3: what a base station measured of one system at one instant.

Of the kinds, MSM4 to MSM7 tell ranges, and MSM5 and MSM7 range rates and the channels of GLONASS as well. Source: RTCM
10403.3, section 3.5.16 (messages 1071 to 1137); numbers of signals: tables 3.5-91 and following.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.gnss.calendar import leap_seconds, to_calendar
from air.gnss.gnss_time import BDT_MINUS_GPST_NS, DAY_NS, GPS_EPOCH_NS, SECOND_NS, WEEK_NS, nearest
from air.gnss.signals import LIGHT, frequencies
from common.arrays import F64, I64
from common.measurements import GnssEpoch

SYSTEMS = {107: "G", 108: "R", 109: "E", 111: "J", 112: "C"}
SIGNALS = {
    "G": {2: "1C", 3: "1P", 4: "1W", 8: "2C", 9: "2P", 10: "2W", 15: "2S", 16: "2L", 17: "2X"}
    | {22: "5I", 23: "5Q", 24: "5X", 30: "1S", 31: "1L", 32: "1X"},
    "R": {2: "1C", 3: "1P", 8: "2C", 9: "2P"},
    "E": {2: "1C", 3: "1A", 4: "1B", 5: "1X", 6: "1Z", 8: "6C", 9: "6A", 10: "6B", 11: "6X", 12: "6Z", 14: "7I"}
    | {15: "7Q", 16: "7X", 18: "8I", 19: "8Q", 20: "8X", 22: "5I", 23: "5Q", 24: "5X"},
    "J": {2: "1C", 9: "6S", 10: "6L", 11: "6X", 15: "2S", 16: "2L", 17: "2X", 22: "5I", 23: "5Q", 24: "5X"}
    | {30: "1S", 31: "1L", 32: "1X"},
    "C": {2: "2I", 3: "2Q", 4: "2X", 8: "6I", 9: "6Q", 10: "6X", 14: "7I", 15: "7Q", 16: "7X", 22: "5D", 23: "5P"}
    | {24: "5X", 25: "7D", 30: "1D", 31: "1P", 32: "1X"},
}
MS = LIGHT * 1e-3
"""What is travelled in a millisecond, m."""
MOST_CELLS = 64
_HEADER_BITS = 169
_NO_DAY = 7
MOSCOW_NS = 3 * 3600 * SECOND_NS


@dataclass(frozen=True)
class Kind:
    """What each signal holds in a kind of message: widths in bits, and the unit of the last bit (ms; ms; dBHz)."""

    code: tuple[int, float]
    phase: tuple[int, float]
    lock: int
    cn0: tuple[int, float]
    rates: bool

    @property
    def cell_bits(self) -> int:
        """Bits of each signal."""
        return self.code[0] + self.phase[0] + self.lock + 1 + self.cn0[0] + 15 * self.rates

    @property
    def satellite_bits(self) -> int:
        """Bits of each satellite."""
        return 36 if self.rates else 18


_COARSE, _FINE = ((15, 2**-24), (22, 2**-29), 4, (6, 1.0)), ((20, 2**-29), (24, 2**-31), 10, (10, 2**-4))
KINDS = {4: Kind(*_COARSE, False), 5: Kind(*_COARSE, True), 6: Kind(*_FINE, False), 7: Kind(*_FINE, True)}


def is_read(number: int) -> bool:
    """Whether a message of this number is read: MSM4 to MSM7 of GPS, GLONASS, Galileo, QZSS or BeiDou."""
    return number // 10 in SYSTEMS and number % 10 in KINDS


def is_last(payload: bytes) -> bool:
    """Whether no further message follows for the same instant."""
    return not payload[6] >> 1 & 1


def parse_msm(payload: bytes, near_ns: int, receiver: str) -> GnssEpoch | None:
    """The epoch in a multiple signal message; None for any other message and for one that is damaged.

    `near_ns` is GPST to half a week: a message tells only the time of the week, or of the day. Signals that RINEX has
    no name for, and GLONASS satellites of unknown channel, are left out.
    """
    number, bits = int.from_bytes(payload[:2], "big") >> 4, _Bits(payload)
    if not is_read(number) or bits.left < _HEADER_BITS:
        return None
    system, kind = SYSTEMS[number // 10], KINDS[number % 10]
    bits.skip(24)
    t_ns = _gpst(system, bits.one(30), near_ns)
    bits.skip(19)
    slots, tracked = np.flatnonzero(bits.many(64, 1)) + 1, np.flatnonzero(bits.many(32, 1)) + 1
    if len(slots) * len(tracked) > min(MOST_CELLS, bits.left) or t_ns is None:
        return None
    row, column = np.nonzero(bits.many(len(slots) * len(tracked), 1).reshape(len(slots), len(tracked)))
    n, cells = len(slots), len(row)
    if bits.left < n * kind.satellite_bits + cells * kind.cell_bits:
        return None

    whole = bits.many(n, 8)
    info = bits.many(n, 4) if kind.rates else np.full(n, 15)
    rough = np.where(whole == 255, np.nan, whole + bits.many(n, 10) / 1024)[row]
    rough_rate = _known(bits.signed(n, 14), 14)[row] if kind.rates else np.full(cells, np.nan)
    code = rough + _known(bits.signed(cells, kind.code[0]), kind.code[0]) * kind.code[1]
    phase = rough + _known(bits.signed(cells, kind.phase[0]), kind.phase[0]) * kind.phase[1]
    lock_s = lock_ms(bits.many(cells, kind.lock), kind.lock).astype(float) * 1e-3
    half_cycle = bits.many(cells, 1) == 1
    cn0 = bits.many(cells, kind.cn0[0]) * kind.cn0[1]
    rate = rough_rate + (_known(bits.signed(cells, 15), 15) * 1e-4 if kind.rates else np.nan)

    satellites = [f"{system}{slot:02d}" for slot in slots[row].tolist()]
    signals = [SIGNALS[system].get(one, "") for one in tracked[column].tolist()]
    channel = (info[row] - 7 if system == "R" else np.zeros(cells)).astype(np.int32)
    f = frequencies(satellites, signals, channel)
    keep = np.flatnonzero(np.isfinite(f))
    untold = np.full(len(keep), np.nan)
    return GnssEpoch(
        t_ns=t_ns,
        receiver=receiver,
        satellites=tuple(satellites[i] for i in keep),
        signals=tuple(signals[i] for i in keep),
        pseudorange=code[keep] * MS,
        carrier_phase=phase[keep] * 1e-3 * f[keep],
        doppler=-rate[keep] * f[keep] / LIGHT,
        cn0=np.where(cn0 > 0, cn0, np.nan)[keep],
        lock_s=lock_s[keep],
        half_cycle=half_cycle[keep],
        sigma_pseudorange=untold,
        sigma_carrier_phase=untold,
        sigma_doppler=untold,
        channel=channel[keep],
    )


def _gpst(system: str, told: int, near_ns: int) -> int | None:
    """GPST ns of the 30 bits that tell the time; None when they are impossible."""
    if system != "R":
        late_ns = -BDT_MINUS_GPST_NS if system == "C" else 0
        if told * 1_000_000 >= WEEK_NS:
            return None
        return nearest(GPS_EPOCH_NS + told * 1_000_000 + late_ns, WEEK_NS, near_ns)
    day, time_ns = told >> 27, (told & (1 << 27) - 1) * 1_000_000
    if time_ns >= DAY_NS + SECOND_NS:
        return None
    leap_ns = leap_seconds(to_calendar(near_ns)) * SECOND_NS
    since_ns = GPS_EPOCH_NS + (day % _NO_DAY) * DAY_NS + time_ns - MOSCOW_NS + leap_ns
    return nearest(since_ns, DAY_NS if day == _NO_DAY else WEEK_NS, near_ns)


def lock_ms(told: I64, width: int) -> I64:
    """The least time of lock that an indicator stands for: of 4 bits powers of two, of 10 bits ever coarser steps."""
    if width == 4:
        return np.asarray(np.where(told == 0, 0, np.left_shift(1, told + 4)), np.int64)
    step = np.clip(told // 32 - 1, 0, 21)
    return np.asarray(np.left_shift(told - 32 * step, step), np.int64)


def _known(values: I64, width: int) -> F64:
    """The values, NaN for the one of so many bits that stands for unknown."""
    return np.where(values == -(1 << width - 1), np.nan, values.astype(float))


class _Bits:
    """The bits of a message, read from its beginning on."""

    def __init__(self, payload: bytes) -> None:
        self._bits, self._at = np.unpackbits(np.frombuffer(payload, np.uint8)), 0

    @property
    def left(self) -> int:
        """How many are not read yet."""
        return len(self._bits) - self._at

    def skip(self, count: int) -> None:
        self._at += count

    def one(self, width: int) -> int:
        return int(self.many(1, width)[0])

    def many(self, count: int, width: int) -> I64:
        """Whole numbers (count,) of so many bits each."""
        table = self._bits[self._at : self._at + count * width].reshape(count, width).astype(np.int64)
        self._at += count * width
        return np.asarray(table @ np.left_shift(1, np.arange(width - 1, -1, -1)), np.int64)

    def signed(self, count: int, width: int) -> I64:
        """Numbers (count,) in two's complement."""
        values = self.many(count, width)
        return values - (values >> width - 1 << width)
