"""The payload of NAV-PVT, the receiver's own position, velocity and time, both ways.

Source: u-blox F9 HPG 1.32, Interface Description (UBX-22008968), section 3.15.
"""

from __future__ import annotations

import calendar
import math
import struct
import time

import numpy as np

from air.gnss.gnss_time import GPS_EPOCH_NS, SECOND_NS, WEEK_NS, to_week
from common.measurements import FixKind, ReceiverSolution

_PVT = struct.Struct("<IHBBBBBBIiBBBBiiiiIIiiiiiIIHH4xihH")
_NAMES = (
    *(
        "itow_ms",
        "year",
        "month",
        "day",
        "hour",
        "minute",
        "second",
        "valid",
        "t_acc",
        "nano",
        "fix",
        "flags",
        "flags2",
    ),
    *("satellites", "lon", "lat", "height", "height_msl", "h_acc", "v_acc", "v_north", "v_east", "v_down", "speed"),
    *("heading", "s_acc", "heading_acc", "pdop", "flags3", "heading_vehicle", "declination", "declination_acc"),
)
_DATE_VALID, _TIME_VALID, _TIME_RESOLVED = 0x01, 0x02, 0x04
_YEARS = range(1999, 2138)
_WEEK_MS = 604_800_000
_POSITION_INVALID = 0x01
_FIXES = {1: FixKind.DEAD_RECKONING, 2: FixKind.FIX_2D, 3: FixKind.FIX_3D, 4: FixKind.FIX_3D, 5: FixKind.TIME_ONLY}
_FIX_CODES = {kind: code for code, kind in reversed(_FIXES.items())} | {FixKind.NONE: 0}
_FIX_OK, _DIFFERENTIAL, _RTK_FLOAT, _RTK_FIXED = 0x01, 0x02, 0x40, 0x80
_FLAGS = {
    FixKind.NONE: 0,
    FixKind.DIFFERENTIAL: _FIX_OK | _DIFFERENTIAL,
    FixKind.RTK_FLOAT: _FIX_OK | _DIFFERENTIAL | _RTK_FLOAT,
    FixKind.RTK_FIXED: _FIX_OK | _DIFFERENTIAL | _RTK_FIXED,
}


def parse_pvt(payload: bytes, receiver: str) -> ReceiverSolution | None:
    """The solution in NAV-PVT; None when damaged, or while the receiver does not know the time.

    Its time is the receiver's best estimate of when it measured, without the clock error that raw epochs have.
    """
    if len(payload) != _PVT.size:
        return None
    v = dict(zip(_NAMES, _PVT.unpack(payload), strict=True))
    t_ns = _time(v)
    if t_ns is None:
        return None
    return ReceiverSolution(
        t_ns=t_ns,
        receiver=receiver,
        kind=FixKind.NONE if v["flags3"] & _POSITION_INVALID else _fix_kind(v["fix"], v["flags"]),
        latitude_deg=v["lat"] * 1e-7,
        longitude_deg=v["lon"] * 1e-7,
        height=v["height"] * 1e-3,
        sigma_horizontal=v["h_acc"] * 1e-3,
        sigma_vertical=v["v_acc"] * 1e-3,
        v_enu=np.array((v["v_east"], v["v_north"], -v["v_down"])) * 1e-3,
        sigma_velocity=v["s_acc"] * 1e-3,
        sigma_time=v["t_acc"] * 1e-9,
        satellites=v["satellites"],
    )


def _time(v: dict[str, int]) -> int | None:
    """GPST, ns: the date tells the week, iTOW (which is GPST) the second, `nano` the rest; no leap seconds needed."""
    if ~v["valid"] & (_DATE_VALID | _TIME_VALID) or v["year"] not in _YEARS or v["itow_ms"] >= _WEEK_MS:
        return None
    if not (1 <= v["month"] <= 12 and 1 <= v["day"] <= 31):
        return None
    date = (v["year"], v["month"], v["day"], v["hour"], v["minute"], v["second"])
    itow_ns = v["itow_ms"] * 1_000_000
    week = round((calendar.timegm(date) * SECOND_NS - GPS_EPOCH_NS - itow_ns) / WEEK_NS)
    second = round((itow_ns - v["nano"]) / SECOND_NS)
    return GPS_EPOCH_NS + week * WEEK_NS + second * SECOND_NS + v["nano"]


def _fix_kind(fix: int, flags: int) -> FixKind:
    kind = _FIXES.get(fix, FixKind.NONE)
    if not flags & _FIX_OK:
        return FixKind.NONE
    if kind is not FixKind.FIX_3D:
        return kind
    if flags & _RTK_FIXED:
        return FixKind.RTK_FIXED
    if flags & _RTK_FLOAT:
        return FixKind.RTK_FLOAT
    return FixKind.DIFFERENTIAL if flags & _DIFFERENTIAL else kind


def pack_pvt(solution: ReceiverSolution, leap_s: int) -> bytes:
    """The payload of NAV-PVT with a solution; `leap_s` is GPST minus UTC, s."""
    utc_ns = solution.t_ns - leap_s * SECOND_NS
    utc_s = (utc_ns + SECOND_NS // 2) // SECOND_NS
    year, month, day, hour, minute, second, *_ = time.gmtime(utc_s)
    v_east, v_north, v_up = (round(1e3 * float(v)) for v in solution.v_enu)
    values = {
        "itow_ms": round(1e3 * to_week(solution.t_ns)[1]) % _WEEK_MS,
        "year": year,
        "month": month,
        "day": day,
        "hour": hour,
        "minute": minute,
        "second": second,
        "valid": _DATE_VALID | _TIME_VALID | _TIME_RESOLVED,
        "t_acc": round(1e9 * solution.sigma_time),
        "nano": utc_ns - utc_s * SECOND_NS,
        "fix": _FIX_CODES.get(solution.kind, 3),
        "flags": _FLAGS.get(solution.kind, _FIX_OK),
        "satellites": solution.satellites,
        "lon": round(1e7 * solution.longitude_deg),
        "lat": round(1e7 * solution.latitude_deg),
        "height": round(1e3 * solution.height),
        "h_acc": round(1e3 * solution.sigma_horizontal),
        "v_acc": round(1e3 * solution.sigma_vertical),
        "v_north": v_north,
        "v_east": v_east,
        "v_down": -v_up,
        "speed": round(math.hypot(v_east, v_north)),
        "s_acc": round(1e3 * solution.sigma_velocity),
    }
    return _PVT.pack(*(values.get(name, 0) for name in _NAMES))
