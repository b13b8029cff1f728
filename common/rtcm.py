"""RTCM 3 frames, which carry what a base station measures: found and checked, and where the station says it stands.

Source: RTCM 10403.3, section 4 (transport layer) and messages 1005 and 1006.
"""

from __future__ import annotations

import numpy as np

from common.arrays import F64
from common.counts import Counts
from common.crc24q import crc24q
from common.framing import UNFINISHED, FrameScanner

PREAMBLE = 0xD3
_HEADER, _CRC = 3, 3
PLACES = {1005: 19, 1006: 21}
"""Messages that tell where a station stands, and their bytes."""
_LEAST_RADIUS, _MOST_RADIUS = 6.3e6, 6.5e6
"""Distances from the centre of the earth where stations stand, m."""


def frame(payload: bytes) -> bytes:
    """A frame around a message of at most 1023 bytes. Raises ValueError for a longer one."""
    if len(payload) > 1023:
        raise ValueError(f"an RTCM message of {len(payload)} bytes; allowed: 0 to 1023")
    body = bytes([PREAMBLE]) + len(payload).to_bytes(2, "big") + payload
    return body + crc24q(body).to_bytes(_CRC, "big")


def probe(held: bytes, at: int) -> int:
    """Length of the valid RTCM frame at a place, for `FrameScanner`.

    Numbers that RTCM never gave away and reserved bits that are set mean that there is none, without more bytes.
    """
    if len(held) < at + _HEADER + 2:
        return UNFINISHED
    length = int.from_bytes(held[at + 1 : at + 3], "big")
    number = message_number(held[at : at + _HEADER + 2])
    if not (2 <= length <= 1023 and (1001 <= number <= 1304 or number >= 4001)):
        return 0
    end = at + _HEADER + length + _CRC
    if len(held) < end:
        return UNFINISHED
    valid = crc24q(held[at : end - _CRC]) == int.from_bytes(held[end - _CRC : end], "big")
    return end - at if valid else 0


def message_number(frame: bytes) -> int:
    """Which message a frame carries, e.g. 1077."""
    return int.from_bytes(frame[_HEADER : _HEADER + 2], "big") >> 4


def payload_of(frame: bytes) -> bytes:
    """The message in a frame."""
    return frame[_HEADER:-_CRC]


def station_of(payload: bytes) -> int:
    """Number of the station that a message of measurements or of a place is from."""
    return int.from_bytes(payload[1:3], "big") & 0xFFF


def is_msm(number: int) -> bool:
    """Whether it is a multiple signal message: what a station measured of one system at one instant."""
    return 1071 <= number <= 1137 and 1 <= number % 10 <= 7


def second_of(payload: bytes) -> int:
    """Which second of the week, or of its day for GLONASS, a multiple signal message is of."""
    told = int.from_bytes(payload[3:7], "big") >> 2
    glonass = 1081 <= int.from_bytes(payload[:2], "big") >> 4 <= 1087
    return (told & (1 << 27) - 1 if glonass else told) // 1000


def pack_place(station: int, p_ecef: F64) -> bytes:
    """Message 1006 of a station whose antenna's reference point is at (3,) m, ECEF, upon its mark.

    Raises ValueError for a place far above the earth.
    """
    tenths = [round(float(value) * 1e4) for value in p_ecef]
    if not all(abs(value) < 1 << 37 for value in tenths):
        raise ValueError(f"a station at {p_ecef.tolist()} m; allowed: within 13 000 km of the centre of the earth")
    x, y, z = (value & (1 << 38) - 1 for value in tenths)
    fields = ((1006, 12), (station, 12), (0, 6), (0b1110, 4), (x, 38), (0, 2), (y, 38), (0, 2), (z, 38), (0, 16))
    bits = 0
    for value, width in fields:
        bits = bits << width | value
    return bits.to_bytes(PLACES[1006], "big")


def parse_place(payload: bytes) -> F64 | None:
    """Where (3,) m, ECEF, the antenna's reference point of a station is by message 1005 or 1006.

    None for any other message, and for a station that does not know its place yet.
    """
    number = int.from_bytes(payload[:2], "big") >> 4
    if len(payload) < PLACES.get(number, len(payload) + 1):
        return None
    bits = int.from_bytes(payload[:19], "big")
    raw = [bits >> shift & (1 << 38) - 1 for shift in (80, 40, 0)]
    p_ecef = np.array([value - (value >> 37 << 38) for value in raw]) * 1e-4
    return p_ecef if _LEAST_RADIUS < np.linalg.norm(p_ecef) < _MOST_RADIUS else None


class RtcmFilter:
    """Passes whole, valid frames on to a receiver, and nothing else of what came over the radio."""

    def __init__(self) -> None:
        self.counts = Counts()
        self._scanner = FrameScanner(self.counts, {PREAMBLE: probe})

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that these bytes complete, to be written to the receiver as they are."""
        frames = self._scanner.feed(data)
        for one in frames:
            self.counts.frames[f"RTCM-{message_number(one)}"] += 1
        return frames
