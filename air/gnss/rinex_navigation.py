"""Reads RINEX navigation files: lines in, ephemerides and ionosphere out.

Source: RINEX 2.11, tables A3, A4 and A10; RINEX 3.05, tables A6 to A13. Records of SBAS and NavIC are passed over.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta

from air.gnss.calendar import YEARS, from_calendar, leap_seconds
from air.gnss.gnss_time import BDT_MINUS_GPST_NS, GPS_EPOCH_NS, SECOND_NS, WEEK_NS, nearest
from air.gnss.orbit import is_geostationary
from air.gnss.rinex_lines import Lines, number, numbers
from air.gnss.signals import CHANNELS
from common.measurements import GlonassEphemeris, Ionosphere, KeplerEphemeris

_START = re.compile(r"([A-Z][ \d]\d|[ \d]\d) ")
_OTHERS = "SI"
_IONOSPHERE = {"GPS": "G", "BDS": "C", "QZS": "J"}
_INAV_CLOCK = 1 << 9
"""Galileo's data source says that the clock is that of E1 and E5b, which is I/NAV's; F/NAV has that of E1 and E5a."""
_FIELDS = 31
"""Numbers of a record at most: clock, and seven lines of orbit."""

Broadcast = KeplerEphemeris | GlonassEphemeris | Ionosphere


@dataclass
class _Header:
    version: float = 3.0
    system: str = "G"
    """Of a file of version 2, which has one system alone."""
    terms: dict[str, tuple[float, ...]] = field(default_factory=dict)


def read_navigation(lines: Lines) -> Iterator[Broadcast]:
    """Ephemerides in the order of the file, with the ionosphere of its header before them.

    Records that cannot be understood are counted in `lines.damaged` and skipped.
    """
    header = _read_header(lines)
    ionosphere = list(_ionosphere(header))
    for record in _records(lines):
        if header.version >= 3 and record[0][0] in _OTHERS:
            continue
        message = _ephemeris(record, header.version < 3, header.system)
        if message is None:
            lines.damage(record[0])
            continue
        yield from (Ionosphere(message.t_ns, *model) for model in ionosphere)
        ionosphere.clear()
        yield message
    yield from (Ionosphere(0, *model) for model in ionosphere)


def _read_header(lines: Lines) -> _Header:
    header = _Header()
    for line in lines:
        label = line[60:80].strip()
        if label == "RINEX VERSION / TYPE":
            header.version = number(line[:9]) or 3.0
            header.system = "R" if line[20:21] == "G" else "G"
        elif label == "IONOSPHERIC CORR":
            header.terms[line[:4].strip()] = numbers(line, 5, 12, 4)
        elif label in ("ION ALPHA", "ION BETA"):
            header.terms["GPS" + label[4]] = numbers(line, 2, 12, 4)
        elif label == "END OF HEADER":
            break
    return header


_Model = tuple[str, tuple[float, float, float, float], tuple[float, float, float, float]]


def _ionosphere(header: _Header) -> Iterator[_Model]:
    for name, system in _IONOSPHERE.items():
        alpha, beta = header.terms.get(name + "A", ()), header.terms.get(name + "B", ())
        if len(alpha) == 4 and len(beta) == 4 and all(x == x for x in alpha + beta):
            yield system, (alpha[0], alpha[1], alpha[2], alpha[3]), (beta[0], beta[1], beta[2], beta[3])


def _records(lines: Lines) -> Iterator[list[str]]:
    """Lines of one record at a time."""
    record: list[str] = []
    for line in lines:
        if _START.match(line):
            if record:
                yield record
            record = [line]
        elif record and line[:3].strip() == "" and len(record) < 8:
            record.append(line)
        elif line.strip():
            lines.damage(line)
    if record:
        yield record


def _ephemeris(record: list[str], old: bool, system: str) -> KeplerEphemeris | GlonassEphemeris | None:
    """The ephemeris of a record, None when it is damaged; version 3 names the system itself."""
    system = system if old else record[0][0]
    prn = number(record[0][:2] if old else record[0][1:3])
    moment = _moment(record[0][2:22] if old else record[0][3:23])
    first, width = (22, 3) if old else (23, 4)
    values = numbers(record[0], first, 19, 3)
    for line in record[1:]:
        values += numbers(line, width, 19, 4)
    values += (float("nan"),) * (_FIELDS - len(values))
    if moment is None or prn != prn:
        return None
    satellite = f"{system}{prn:02.0f}"
    if system == "R":
        return _glonass(satellite, moment, values, old)
    return _kepler(satellite, moment, values) if system in "GECJ" else None


def _moment(text: str) -> datetime | None:
    try:
        year, month, day, hour, minute, second = (float(part) for part in text.split())
        century = 0 if year > 99 else 1900 if year >= 80 else 2000
        start = datetime(int(year) + century, int(month), int(day), int(hour), int(minute))
        moment = start + timedelta(seconds=second)
    except (ValueError, OverflowError):
        return None
    return moment if moment.year in YEARS else None


def _kepler(satellite: str, moment: datetime, v: tuple[float, ...]) -> KeplerEphemeris | None:
    """`v` holds the clock (3) and seven lines of orbit (4 each), in the order of the file."""
    system = satellite[0]
    needed = (*v[:3], *v[4:20], v[24])
    if any(x != x for x in needed) or not v[10] > 0 or not 0 <= v[8] < 1:
        return None
    shift_ns = -BDT_MINUS_GPST_NS if system == "C" else 0
    toc_ns = from_calendar(moment) + shift_ns
    toe_ns = _in_week(v[11], shift_ns, toc_ns)
    known = 0 <= v[27] < 604_800
    sent_ns = _in_week(v[27], shift_ns, toe_ns) if known else toe_ns
    issue = _whole(v[3])
    return KeplerEphemeris(
        t_ns=sent_ns,
        satellite=satellite,
        source=_source(satellite, v),
        toe_ns=toe_ns,
        toc_ns=toc_ns,
        iode=issue,
        iodc=issue if system == "E" else _whole(v[28] if system == "C" else v[26]),
        af0=v[0],
        af1=v[1],
        af2=v[2],
        crs=v[4],
        delta_n=v[5],
        m0=v[6],
        cuc=v[7],
        e=v[8],
        cus=v[9],
        sqrt_a=v[10],
        cic=v[12],
        omega0=v[13],
        cis=v[14],
        i0=v[15],
        crc=v[16],
        omega=v[17],
        omega_dot=v[18],
        idot=v[19],
        accuracy=v[23] if v[23] == v[23] else 0.0,
        health=_whole(v[24]),
        group_delay=(_or_zero(v[25]), 0.0 if system in "GJ" else _or_zero(v[26])),
    )


def _source(satellite: str, v: tuple[float, ...]) -> str:
    if satellite[0] == "E":
        return "INAV" if _whole(v[20]) & _INAV_CLOCK else "FNAV"
    if satellite[0] == "C":
        return "D2" if is_geostationary(satellite) else "D1"
    return "LNAV"


def _glonass(satellite: str, moment: datetime, v: tuple[float, ...], old: bool) -> GlonassEphemeris | None:
    """`v` holds the clock (3) and three lines of position, velocity, acceleration and one more (4 each)."""
    needed = (*v[:2], *v[3:14])
    if any(x != x for x in needed):
        return None
    leap_ns = leap_seconds(moment) * SECOND_NS
    toe_ns = from_calendar(moment) + leap_ns
    sent_ns = toe_ns
    if not old and 0 <= v[2] < 604_800:
        sent_ns = _in_week(v[2], leap_ns, toe_ns)
    channel = _whole(v[10])
    channel -= 256 if channel > 128 else 0  # some write the byte without its sign
    if channel not in CHANNELS:
        return None
    x, y, z = ((1e3 * v[i], 1e3 * v[i + 1], 1e3 * v[i + 2]) for i in (3, 7, 11))
    return GlonassEphemeris(
        t_ns=sent_ns,
        satellite=satellite,
        toe_ns=toe_ns,
        position=(x[0], y[0], z[0]),
        velocity=(x[1], y[1], z[1]),
        acceleration=(x[2], y[2], z[2]),
        tau=v[0],
        gamma=v[1],
        channel=channel,
        age_days=_whole(v[14]),
        health=_whole(v[6]),
    )


def _in_week(seconds: float, shift_ns: int, near_ns: int) -> int:
    """GPST of a second of the week, which begins `shift_ns` after GPST's, in the week that is nearest."""
    return nearest(GPS_EPOCH_NS + round(seconds * 1e9) + shift_ns, WEEK_NS, near_ns)


def _whole(value: float) -> int:
    return int(value) if abs(value) < 1e15 else 0


def _or_zero(value: float) -> float:
    return value if value == value else 0.0
