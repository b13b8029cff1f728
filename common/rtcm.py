"""RTCM 3 frames, which carry corrections to a receiver: found and checked, their content left alone.

Source: RTCM 10403.3, section 4 (transport layer).
"""

from __future__ import annotations

from common.counts import Counts
from common.crc24q import crc24q
from common.framing import UNFINISHED, FrameScanner

PREAMBLE = 0xD3
_HEADER, _CRC = 3, 3


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
