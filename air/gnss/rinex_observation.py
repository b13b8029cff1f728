"""Reads RINEX observation files: lines in, epochs out.

Source: RINEX 2.11, tables A1 and A2; RINEX 3.05, tables A2 and A3. A signal of version 2 gets the code of version 3
that receivers usually track there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta

import numpy as np

from air.gnss.calendar import from_calendar
from air.gnss.gnss_time import BDT_MINUS_GPST_NS, SECOND_NS
from air.gnss.rinex_lines import Lines, number
from common.arrays import F64, U8
from common.measurements import GnssEpoch

_SATELLITE = re.compile(r"[GRECJSI]\d\d")
_KINDS = "CLDS"
_WIDTH = 16
_EVENT = 2
"""From this flag on an epoch holds no measurements but lines of header or remarks."""
_OLD_ATTRIBUTE = {
    **dict.fromkeys(("C1", "C2"), "C"),
    **dict.fromkeys(("P1", "P2"), "W"),
    **dict.fromkeys(("C5", "C6", "C7", "C8", "EC1"), "X"),
    **dict.fromkeys(("RP1", "RP2"), "P"),
    **dict.fromkeys(("CC2", "CC6", "CC7"), "I"),
}
_OLD_SYSTEMS = "GRECJS"

_Columns = dict[str, tuple[int, int, int, int]]
"""Where the four kinds of a signal stand in the row of a satellite, −1 where they do not."""


@dataclass
class _Header:
    version: float = 3.0
    codes: dict[str, list[str]] = field(default_factory=dict)
    time_system: str = "GPS"
    leap_s: int | None = None
    channels: dict[str, int] = field(default_factory=dict)


def read_observations(lines: Lines, channels: dict[str, int], receiver: str) -> Iterator[GnssEpoch]:
    """Epochs in the order of the file.

    `channels` are GLONASS frequency numbers by satellite, for files that do not tell them themselves. Lines that
    cannot be understood are counted in `lines.damaged` and skipped.
    """
    header = _read_header(lines)
    header.channels = channels | header.channels
    columns = {system: _columns(codes) for system, codes in header.codes.items()}
    locks: dict[tuple[str, str], tuple[int, int]] = {}
    epochs = _epochs_old(lines, header) if header.version < 3 else _epochs(lines, header)
    for t_ns, rows in epochs:
        yield _epoch(t_ns, rows, columns, header, locks, receiver)


def _read_header(lines: Lines) -> _Header:
    header, system, old_codes = _Header(), "", []
    for line in lines:
        label = line[60:80].strip()
        if label == "RINEX VERSION / TYPE":
            header.version = number(line[:9]) or 3.0
        elif label == "SYS / # / OBS TYPES":
            system = line[0].strip() or system
            header.codes.setdefault(system, []).extend(line[7:60].split())
        elif label == "# / TYPES OF OBSERV":
            old_codes += line[6:60].split()
        elif label == "TIME OF FIRST OBS":
            header.time_system = line[48:51].strip() or "GPS"
        elif label == "LEAP SECONDS":
            header.leap_s = int(number(line[:6])) if number(line[:6]) == number(line[:6]) else None
        elif label == "GLONASS SLOT / FRQ #":
            found = re.findall(r"(R\d\d) +(-?\d)\b", line[4:60])
            header.channels |= {satellite: int(channel) for satellite, channel in found}
        elif label == "END OF HEADER":
            break
    if old_codes:
        header.codes = {system: _new_codes(system, old_codes) for system in _OLD_SYSTEMS}
    return header


def _new_codes(system: str, codes: list[str]) -> list[str]:
    """Codes of version 3 for those of version 2: phase, Doppler and C/N0 belong to the band's usual code."""

    def attribute(code: str) -> str:
        return _OLD_ATTRIBUTE.get(system + code, _OLD_ATTRIBUTE.get(code, ""))

    usual = {}
    for band in "125678":
        first = ("P", "C") if band == "2" else ("C", "P")
        usual[band] = next((attribute(kind + band) for kind in first if kind + band in codes), "C")
    new = []
    for code in codes:
        kind, band = code[:1], code[1:]
        new.append(f"C{band}{attribute(code)}" if kind in "CP" else f"{kind}{band}{usual.get(band, 'C')}")
    return new


def _columns(codes: list[str]) -> _Columns:
    places = {code: i for i, code in reversed(list(enumerate(codes)))}
    signals = dict.fromkeys(code[1:] for code in codes if len(code) == 3 and code[0] in _KINDS)
    found = {s: [places.get(kind + s, -1) for kind in _KINDS] for s in signals}
    return {s: (c[0], c[1], c[2], c[3]) for s, c in found.items()}


_Rows = list[tuple[str, str]]
"""Satellites and their observations, in columns of 16 characters."""


def _epochs(lines: Lines, header: _Header) -> Iterator[tuple[int, _Rows]]:
    """Epochs of version 3."""
    for line in lines:
        if not line.startswith(">"):
            if line.strip():
                lines.damage(line)
            continue
        t_ns, flag, count = _time(line[1:29], header), number(line[29:32]), number(line[32:35])
        good = t_ns is not None and flag == flag and count == count
        if not good:
            lines.damage(line)
        rows: _Rows = []
        # A damaged epoch's rows are passed over too, up to the next epoch.
        for row in lines:
            if row.startswith(">"):
                lines.give_back(row)
                break
            satellite = row[:3].replace(" ", "0")
            if flag >= _EVENT or not good:
                pass
            elif _SATELLITE.fullmatch(satellite) and len(rows) < count:
                rows.append((satellite, row[3:]))
            else:
                lines.damage(row)
        if t_ns is not None and good and flag < _EVENT:
            yield t_ns, rows


def _epochs_old(lines: Lines, header: _Header) -> Iterator[tuple[int, _Rows]]:
    """Epochs of version 2: the list of satellites, then five observations a line."""
    per_satellite = -(-len(header.codes.get("G", ())) // 5)
    for line in lines:
        t_ns, flag, count = _time(line[:26], header, old=True), number(line[26:29]), number(line[29:32])
        if flag >= _EVENT and 0 < count < 1000:
            for _, _skipped in zip(range(int(count)), lines, strict=False):
                pass
            continue
        if t_ns is None or flag != flag or not 0 < count < 1000:
            if line.strip():
                lines.damage(line)
            continue
        names = line[32:68].ljust(36)
        while len(names) < 3 * count:
            names += next(lines, "")[32:68].ljust(36)
        rows: _Rows = []
        for i in range(int(count)):
            name = names[3 * i : 3 * i + 3]
            satellite = (name[:1].strip() or "G") + name[1:].replace(" ", "0")
            row = "".join(next(lines, "").ljust(80)[:80] for _ in range(per_satellite))
            if _SATELLITE.fullmatch(satellite):
                rows.append((satellite, row))
            else:
                lines.damage(line)
        yield t_ns, rows


def _time(text: str, header: _Header, old: bool = False) -> int | None:
    """Nanoseconds of GPST of an epoch's time tag, None where it is senseless."""
    parts = text.split()
    try:
        year, month, day, hour, minute = (int(part) for part in parts[:5])
        second, _, fraction = parts[5].partition(".")
        century = (1900 if year >= 80 else 2000) if old else 0
        start = datetime(year + century, month, day, hour, minute) + timedelta(seconds=int(second))
        t_ns = from_calendar(start) + int(fraction[:9].ljust(9, "0"))
    except (ValueError, IndexError, OverflowError):
        return None
    if len(parts) != 6:
        return None
    shift_ns = {"GLO": (header.leap_s or 18) * SECOND_NS, "BDT": -BDT_MINUS_GPST_NS}.get(header.time_system, 0)
    return t_ns + shift_ns


def _epoch(
    t_ns: int,
    rows: _Rows,
    columns: dict[str, _Columns],
    header: _Header,
    locks: dict[tuple[str, str], tuple[int, int]],
    receiver: str,
) -> GnssEpoch:
    """The epoch of these rows; `locks` holds since when and until when each carrier was tracked, in ns."""
    names, signals, values, flags = [], [], [], []
    for satellite, row in rows:
        for signal, places in columns.get(satellite[0], {}).items():
            fields = [row[_WIDTH * i : _WIDTH * (i + 1)] if i >= 0 else "" for i in places]
            found = [number(text[:14]) if text else np.nan for text in fields]
            observed = [np.nan if value == 0.0 else value for value in found]
            if any(value == value for value in observed):
                names.append(satellite)
                signals.append(signal)
                values.append(observed)
                flags.append(int(fields[1][14]) if observed[1] == observed[1] and fields[1][14:15].isdecimal() else 0)
    table = np.array(values, float).reshape(-1, 4)
    loss = np.array(flags, np.int64).astype(np.uint8)
    n = len(names)
    unknown = np.full(n, np.nan)
    return GnssEpoch(
        t_ns=t_ns,
        receiver=receiver,
        satellites=tuple(names),
        signals=tuple(signals),
        pseudorange=table[:, 0],
        carrier_phase=table[:, 1],
        doppler=table[:, 2],
        cn0=table[:, 3],
        lock_s=_lock_times(t_ns, list(zip(names, signals, strict=True)), loss, table[:, 1], locks),
        half_cycle=(loss & 2).astype(bool),
        sigma_pseudorange=unknown,
        sigma_carrier_phase=unknown,
        sigma_doppler=unknown,
        channel=np.array([header.channels.get(name, 0) for name in names], np.int32),
        leap_s=header.leap_s,
    )


MAX_GAP_NS = 60 * SECOND_NS


def _lock_times(
    t_ns: int,
    keys: list[tuple[str, str]],
    loss: U8,
    phase: F64,
    locks: dict[tuple[str, str], tuple[int, int]],
) -> F64:
    """Seconds (N,) since the last loss of lock that the file tells of, NaN without a phase."""
    times = np.full(len(keys), np.nan)
    for i, key in enumerate(keys):
        if phase[i] != phase[i]:
            locks.pop(key, None)
            continue
        begun_ns, seen_ns = locks.get(key, (t_ns, t_ns))
        if loss[i] & 1 or not 0 <= t_ns - seen_ns <= MAX_GAP_NS:
            begun_ns = t_ns
        locks[key] = (begun_ns, t_ns)
        times[i] = (t_ns - begun_ns) * 1e-9
    return times
