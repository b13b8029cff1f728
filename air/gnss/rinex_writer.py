"""Writes RINEX 3.04 observation and navigation files, for RTKLIB and every other program.

Source: RINEX 3.04, tables A2, A3 and A5 to A14. Pseudoranges, phases and Dopplers are rounded to 0.001, time tags to
100 ns, parameters of orbits to 13 digits.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import timedelta
from typing import TextIO

import numpy as np

from air.gnss.calendar import leap_seconds, to_calendar
from air.gnss.gnss_time import BDT_MINUS_GPST_NS, BEIDOU_EPOCH_NS, SECOND_NS, to_week
from common.measurements import GlonassEphemeris, GnssEpoch, Ionosphere, KeplerEphemeris

VERSION = "3.04"
_NAMES = {"G": "GPS", "C": "BDS", "J": "QZS"}
_KINDS = "CLDS"
_TICK_NS = 100
_DATA_SOURCES = {"INAV": 517.0, "FNAV": 258.0}
"""I/NAV of E1 and E5b with the clock of these two; F/NAV of E5a with the clock of E1 and E5a."""


def write_navigation(
    file: TextIO, broadcast: Iterable[KeplerEphemeris | GlonassEphemeris | Ionosphere], program: str = "luojia"
) -> None:
    """Write ephemerides, by reference time and satellite, with the last ionosphere of each system in the header."""
    messages = list(broadcast)
    ephemerides = [message for message in messages if not isinstance(message, Ionosphere)]
    ephemerides.sort(key=lambda ephemeris: (ephemeris.toe_ns, ephemeris.satellite))
    _header(file, "N: GNSS NAV DATA    M: MIXED", program)
    for model in {m.system: m for m in messages if isinstance(m, Ionosphere) and m.system in _NAMES}.values():
        for letter, terms in (("A", model.alpha), ("B", model.beta)):
            text = f"{_NAMES[model.system]}{letter} " + "".join(f"{term:12.4E}" for term in terms)
            _label(file, text, "IONOSPHERIC CORR")
    if ephemerides:
        _label(file, f"{leap_seconds(to_calendar(ephemerides[-1].toe_ns)):6d}", "LEAP SECONDS")
    _label(file, "", "END OF HEADER")
    for ephemeris in ephemerides:
        lines = _kepler(ephemeris) if isinstance(ephemeris, KeplerEphemeris) else _glonass(ephemeris)
        file.writelines(line + "\n" for line in lines)


def write_observations(
    file: TextIO,
    epochs: Sequence[GnssEpoch],
    program: str = "luojia",
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    """Write epochs of one receiver in the order given; a phase after a loss of lock is marked.

    `position` m, ECEF, is where the antenna is, roughly or, of a base station, exactly.
    """
    codes = _codes(epochs)
    channels = {
        satellite: channel
        for epoch in epochs
        for satellite, channel in zip(epoch.satellites, epoch.channel.tolist(), strict=True)
        if satellite[:1] == "R"
    }
    _header(file, "OBSERVATION DATA    M: MIXED", program)
    for label in ("MARKER NAME", "OBSERVER / AGENCY", "REC # / TYPE / VERS", "ANT # / TYPE"):
        _label(file, "", label)
    _label(file, "".join(f"{value:14.4f}" for value in position), "APPROX POSITION XYZ")
    _label(file, f"{0:14.4f}{0:14.4f}{0:14.4f}", "ANTENNA: DELTA H/E/N")
    for system, names in codes.items():
        for i in range(0, len(names), 13):
            start = f"{system}  {len(names):3d}" if i == 0 else " " * 6
            _label(file, start + "".join(f" {name}" for name in names[i : i + 13]), "SYS / # / OBS TYPES")
    if epochs:
        first = to_calendar(epochs[0].t_ns)
        tag = f"{first:%Y    %m    %d    %H    %M}{_seconds(epochs[0].t_ns):13.7f}"
        _label(file, f"  {tag}     GPS", "TIME OF FIRST OBS")
    slots = [f" {satellite} {channel:2d}" for satellite, channel in sorted(channels.items())]
    for i in range(0, len(slots), 8):
        count = f"{len(slots):3d}" if i == 0 else "   "
        _label(file, count + "".join(slots[i : i + 8]), "GLONASS SLOT / FRQ #")
    leap_s = next((epoch.leap_s for epoch in epochs if epoch.leap_s is not None), None)
    if leap_s is not None:
        _label(file, f"{leap_s:6d}", "LEAP SECONDS")
    _label(file, "", "END OF HEADER")
    tracked: dict[tuple[str, str], int] = {}
    for epoch in epochs:
        file.writelines(line + "\n" for line in _epoch(epoch, codes, tracked))


def _header(file: TextIO, kind: str, program: str) -> None:
    _label(file, f"{VERSION:>9}           {kind}", "RINEX VERSION / TYPE")
    _label(file, program[:20], "PGM / RUN BY / DATE")


def _label(file: TextIO, text: str, label: str) -> None:
    file.write(f"{text[:60]:<60}{label}\n")


def _kepler(e: KeplerEphemeris) -> Iterator[str]:
    system = e.satellite[0]
    shift_ns = BDT_MINUS_GPST_NS if system == "C" else 0
    week, toe_s = to_week(e.toe_ns + shift_ns)
    if system == "C":
        week -= to_week(BEIDOU_EPOCH_NS)[0]
    sent_s = (e.t_ns - e.toe_ns) / SECOND_NS + toe_s
    source = _DATA_SOURCES.get(e.source, 0.0)
    last = e.iodc if system in "GJ" else e.group_delay[1]
    yield _start(e.satellite, e.toc_ns + shift_ns, (e.af0, e.af1, e.af2))
    yield _orbit(e.iode, e.crs, e.delta_n, e.m0)
    yield _orbit(e.cuc, e.e, e.cus, e.sqrt_a)
    yield _orbit(toe_s, e.cic, e.omega0, e.cis)
    yield _orbit(e.i0, e.crc, e.omega, e.omega_dot)
    yield _orbit(e.idot, source, week, 0.0)
    yield _orbit(e.accuracy, e.health, e.group_delay[0], last)
    yield _orbit(sent_s, e.iodc if system == "C" else 0.0)


def _glonass(e: GlonassEphemeris) -> Iterator[str]:
    leap_ns = leap_seconds(to_calendar(e.toe_ns)) * SECOND_NS
    x, y, z = ((p / 1e3, v / 1e3, a / 1e3) for p, v, a in zip(e.position, e.velocity, e.acceleration, strict=True))
    yield _start(e.satellite, e.toe_ns - leap_ns, (e.tau, e.gamma, to_week(e.t_ns - leap_ns)[1]))
    yield _orbit(*x, e.health)
    yield _orbit(*y, e.channel)
    yield _orbit(*z, e.age_days)


def _start(satellite: str, t_ns: int, clock: tuple[float, float, float]) -> str:
    moment = to_calendar(t_ns) + timedelta(milliseconds=500)
    return f"{satellite} {moment:%Y %m %d %H %M %S}" + "".join(_number(value) for value in clock)


def _orbit(*values: float) -> str:
    return "    " + "".join(_number(value) for value in values)


def _number(value: float) -> str:
    """Nineteen columns, blank for what is no number; exponents have room for two digits."""
    if not abs(value) < 1e100:
        return " " * 19
    return f"{value if abs(value) >= 1e-99 else 0.0:19.12E}"


def _codes(epochs: Sequence[GnssEpoch]) -> dict[str, list[str]]:
    """Observation codes by system, four for each signal."""
    signals = {(s[:1], signal) for epoch in epochs for s, signal in zip(epoch.satellites, epoch.signals, strict=True)}
    codes: dict[str, list[str]] = {}
    for system, signal in sorted(signals):
        codes.setdefault(system, []).extend(kind + signal for kind in _KINDS)
    return codes


def _epoch(epoch: GnssEpoch, codes: dict[str, list[str]], tracked: dict[tuple[str, str], int]) -> Iterator[str]:
    """Lines of an epoch; `tracked` holds when the phase of each signal was last written, ns."""
    cells: dict[str, dict[str, str]] = {}
    columns = (epoch.pseudorange, epoch.carrier_phase, epoch.doppler, epoch.cn0)
    for i, (satellite, signal) in enumerate(zip(epoch.satellites, epoch.signals, strict=True)):
        row = cells.setdefault(satellite, {})
        for kind, column in zip(_KINDS, columns, strict=True):
            row[kind + signal] = _cell(column[i], _flag(epoch, i, tracked) if kind == "L" else "")
    seconds = f"{_seconds(epoch.t_ns):11.7f}"
    moment = to_calendar(_rounded(epoch.t_ns))
    yield f"> {moment:%Y %m %d %H %M}{seconds}  0{len(cells):3d}"
    for satellite in sorted(cells):
        row = cells[satellite]
        yield (satellite + "".join(row.get(code, " " * 16) for code in codes[satellite[:1]])).rstrip()


def _cell(value: float, flag: str) -> str:
    text = f"{value:14.3f}" if np.isfinite(value) else ""
    return f"{text:14}{flag or ' '} " if 0 < len(text) <= 14 else " " * 16


def _flag(epoch: GnssEpoch, i: int, tracked: dict[tuple[str, str], int]) -> str:
    """Loss-of-lock indicator: 1 after a loss of lock, 2 where half a cycle may be missing."""
    if not np.isfinite(epoch.carrier_phase[i]):
        return ""
    key = epoch.satellites[i], epoch.signals[i]
    before_ns = tracked.get(key)
    tracked[key] = epoch.t_ns
    lost = before_ns is not None and epoch.lock_s[i] < (epoch.t_ns - before_ns) / SECOND_NS
    flag = int(lost) + 2 * int(epoch.half_cycle[i])
    return str(flag) if flag else ""


def _rounded(t_ns: int) -> int:
    return (t_ns + _TICK_NS // 2) // _TICK_NS * _TICK_NS


def _seconds(t_ns: int) -> float:
    return _rounded(t_ns) % (60 * SECOND_NS) / SECOND_NS
