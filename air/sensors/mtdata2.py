"""The payload of Xsens MTData2 messages: packets of a data identifier, a size and values; both ways.

Source: Xsens MT0101P, MT Low Level Communication Protocol, section "MTData2".
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from enum import IntEnum

Packets = dict[int, tuple[float, ...]]
"""Values by data identifier, the precision bits of the identifier cleared."""


class DataId(IntEnum):
    """Data identifiers without precision and coordinate system."""

    TEMPERATURE = 0x0810
    UTC_TIME = 0x1010
    PACKET_COUNTER = 0x1020
    SAMPLE_TIME_FINE = 0x1060
    SAMPLE_TIME_COARSE = 0x1070
    QUATERNION = 0x2010
    DELTA_V = 0x4010
    ACCELERATION = 0x4020
    RATE_OF_TURN = 0x8020
    DELTA_Q = 0x8030
    MAGNETIC_FIELD = 0xC020
    STATUS_BYTE = 0xE010
    STATUS_WORD = 0xE020


class Precision(IntEnum):
    """How reals are written: the lowest two bits of a data identifier."""

    FLOAT32 = 0
    FP12_20 = 1
    FP16_32 = 2
    FLOAT64 = 3


ENU, NED, NWU = 0x0, 0x4, 0x8
"""Coordinate systems of an orientation: bits 2 and 3 of its data identifier."""

SKIPPED = {
    0x1030: "ITOW",
    0x2020: "RotationMatrix",
    0x2030: "EulerAngles",
    0x3010: "BaroPressure",
    0x4030: "FreeAcceleration",
    0x4040: "AccelerationHR",
    0x5020: "AltitudeEllipsoid",
    0x5030: "PositionEcef",
    0x5040: "LatLon",
    0x7010: "GnssPvtData",
    0x7020: "GnssSatInfo",
    0x8040: "RateOfTurnHR",
    0xA010: "RawAccGyrMagTemp",
    0xA020: "RawGyroTemp",
    0xD010: "VelocityXYZ",
}
"""Names of what a device may send and this reader leaves aside."""

_WHOLE: dict[int, struct.Struct] = {
    DataId.UTC_TIME: struct.Struct(">IH6B"),
    DataId.PACKET_COUNTER: struct.Struct(">H"),
    DataId.SAMPLE_TIME_FINE: struct.Struct(">I"),
    DataId.SAMPLE_TIME_COARSE: struct.Struct(">I"),
    DataId.STATUS_BYTE: struct.Struct(">B"),
    DataId.STATUS_WORD: struct.Struct(">I"),
}
_REALS: dict[int, int] = {
    DataId.TEMPERATURE: 1,
    DataId.QUATERNION: 4,
    DataId.DELTA_V: 3,
    DataId.ACCELERATION: 3,
    DataId.RATE_OF_TURN: 3,
    DataId.DELTA_Q: 4,
    DataId.MAGNETIC_FIELD: 3,
}
_FLOATS: dict[tuple[int, int], struct.Struct] = {
    (count, precision): struct.Struct(f">{count}{code}")
    for count in (1, 3, 4)
    for precision, code in ((Precision.FLOAT32, "f"), (Precision.FLOAT64, "d"))
}
_FIXED = {count: struct.Struct(f">{count}i") for count in (1, 3, 4)}
_LONG_FIXED = {count: struct.Struct(">" + count * "Ih") for count in (1, 3, 4)}


def unpack(payload: bytes) -> tuple[Packets, list[str]] | None:
    """The packets that Luojia reads and the names of the others; None when the sizes do not fit together."""
    packets: Packets = {}
    skipped = []
    at, end = 0, len(payload)
    while at < end:
        if end - at < 3:
            return None
        identifier, size = payload[at] << 8 | payload[at + 1], payload[at + 2]
        data = payload[at + 3 : at + 3 + size]
        if len(data) != size:
            return None
        at += 3 + size
        base = identifier & 0xFFF0
        if base in _WHOLE:
            layout = _WHOLE[base]
            values: tuple[float, ...] | None = layout.unpack(data) if size == layout.size else None
        elif base in _REALS:
            values = _reals(data, _REALS[base], identifier & 0x3)
        else:
            skipped.append(SKIPPED.get(base, f"0x{base:04X}"))
            continue
        if values is None:
            return None
        packets[identifier & 0xFFFC] = values
    return packets, skipped


def pack(packets: Mapping[int, tuple[float, ...]], precision: Precision = Precision.FLOAT32) -> bytes:
    """The payload of an MTData2 message; identifiers may carry a coordinate system, reals are written as given.

    Raises KeyError for an identifier that Luojia does not read, struct.error for values that do not fit.
    """
    payload = b""
    for identifier, values in packets.items():
        base = identifier & 0xFFF0
        if base in _WHOLE:
            data = _WHOLE[base].pack(*values)
        else:
            identifier |= precision
            data = _real_bytes(values, _REALS[base], precision)
        payload += struct.pack(">HB", identifier, len(data)) + data
    return payload


def _reals(data: bytes, count: int, precision: int) -> tuple[float, ...] | None:
    floats = _FLOATS.get((count, precision))
    if floats is not None:
        return floats.unpack(data) if len(data) == floats.size else None
    if precision == Precision.FP12_20:
        return tuple(v / 2**20 for v in _FIXED[count].unpack(data)) if len(data) == 4 * count else None
    if len(data) != 6 * count:
        return None
    words = _LONG_FIXED[count].unpack(data)  # the fraction comes before the whole number
    return tuple(whole + fraction / 2**32 for fraction, whole in zip(words[::2], words[1::2], strict=True))


def _real_bytes(values: tuple[float, ...], count: int, precision: Precision) -> bytes:
    if precision in (Precision.FLOAT32, Precision.FLOAT64):
        return _FLOATS[count, precision].pack(*values)
    if precision is Precision.FP12_20:
        return _FIXED[count].pack(*(round(v * 2**20) for v in values))
    fixed = [round(v * 2**32) for v in values]
    return _LONG_FIXED[count].pack(*(word for v in fixed for word in (v & 0xFFFFFFFF, v >> 32)))
