"""Small logs of autopilots, written from the definitions of their formats, for tests."""

from __future__ import annotations

import struct
from typing import Any

FORMATS = {
    "IMU": (10, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"),
    "GPS": (11, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"),
    "GPA": (12, "QBCCCCfBIHf", "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta,Und"),
    "ATT": (13, "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF"),
    "POS": (14, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "BAT": (15, "QBfffffcfBB", "TimeUS,Inst,Volt,VoltR,Curr,CurrTot,EnrgTot,Temp,Res,RemPct,H"),
    "MSG": (16, "QZ", "TimeUS,Message"),
    "ARM": (17, "QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method"),
    "NTUN": (18, "QfIB", "TimeUS,Dist,TBrg,Odd"),
}
PACKED = {"Z": "64s", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i"}


def layout(name: str) -> struct.Struct:
    return struct.Struct("<" + "".join(PACKED.get(letter, letter) for letter in FORMATS[name][1]))


def message(name: str, *values: Any) -> bytes:
    return b"\xa3\x95" + bytes([FORMATS[name][0]]) + layout(name).pack(*values)


def describe(name: str) -> bytes:
    number, letters, columns = FORMATS[name]
    body = struct.pack("<BB4s16s64s", number, layout(name).size + 3, name.encode(), letters.encode(), columns.encode())
    return b"\xa3\x95\x80" + body


def write_log(gps: bool = True) -> bytes:
    """Two seconds: two IMUs at 100 Hz, attitude at 10 Hz, GPS at 5 Hz that is logged 0.1 s late."""
    fmt = struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    out = [b"\xa3\x95\x80" + fmt, *map(describe, FORMATS)]
    out.append(message("ARM", 900_000, 1, 0, 0, 0))
    out.append(message("MSG", 900_000, b"Plane V4.5"))
    for i in range(200):
        t_us = 1_000_000 + 10_000 * i
        for k in range(2):
            out.append(message("IMU", t_us, k, 0.1, 0.2, 0.3, 1.0, 2.0, -9.81 - k, 0, 0, 40.0, 1, 1, 100, 100))
        if i % 10 == 0:
            out.append(message("POS", t_us, 475_000_000, 85_000_000, 500.0, 40.0, 40.0))
            out.append(message("BAT", t_us, 0, 15.2, 15.2, 9.5, 1.0, 1.0, 2500, 0.1, 65, 1))
            out.append(message("ATT", t_us, 0, 0, 0, 3000, 0, 9000, 0, 0, 1))
        if gps and i % 20 == 0:
            ms = 216_000_000 + 10 * i - 100
            out.append(message("GPA", t_us, 0, 120, 40, 70, 5, 0.0, 1, 0, 0, 0.0))
            fix = (0, 3, ms, 2122, 17, 90, 475_000_000, 85_000_000, 54_700, 5.0, 90.0, -1.0, 0.0, 1)
            out.append(message("GPS", t_us, *fix))
        out.append(message("NTUN", t_us, 1.0, 2, 3))
    return b"".join(out)


# ULog: header, formats (F), what is logged (A), data (D)

UTC_S = 1_600_000_000
"""Unix time 2 s after the start."""


def ulog_message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def write_ulog() -> bytes:
    """Two seconds: IMU at 100 Hz, attitude at 50 Hz, GPS at 5 Hz, from 1 s after the start."""
    topics = {
        "sensor_combined": ("uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;", "<Q6f"),
        "vehicle_attitude": ("uint64_t timestamp;float[4] q;", "<Q4f"),
        "sensor_gps": (
            "uint64_t timestamp;uint64_t time_utc_usec;double latitude_deg;double longitude_deg;"
            "double altitude_ellipsoid_m;float eph;uint8_t fix_type;uint8_t satellites_used;",
            "<QQdddfBB",
        ),
    }
    out = [b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000), ulog_message("B", bytes(40))]
    out += [ulog_message("F", f"{name}:{fields}".encode()) for name, (fields, _) in topics.items()]
    for number, name in enumerate(topics):
        out.append(ulog_message("A", struct.pack("<BH", 0, number) + name.encode()))

    def data(name: str, *values: float) -> bytes:
        number = list(topics).index(name)
        return ulog_message("D", struct.pack("<H", number) + struct.pack(topics[name][1], *values))

    for i in range(200):
        t_us = 1_000_000 + 10_000 * i
        out.append(data("sensor_combined", t_us, 0.1, 0.2, 0.3, 1.0, 2.0, -9.81))
        if i % 2 == 0:
            out.append(data("vehicle_attitude", t_us, 1.0, 0.0, 0.0, 0.0))
        if i % 20 == 0:
            utc_us = UTC_S * 10**6 + t_us - 2_000_000
            out.append(data("sensor_gps", t_us, utc_us, 47.5, 8.5, 547.0, 0.5, 3, 14))
    return b"".join(out)
