"""XBus frames of Xsens devices: preamble, bus, message, length, payload, checksum; both ways, without I/O.

Source: Xsens MT0101P, MT Low Level Communication Protocol, section "Message structure".
"""

from __future__ import annotations

from enum import IntEnum

from air.sensors.driver import Counts

_PREAMBLE, _MASTER = 0xFA, 0xFF
_HEADER = bytes((_PREAMBLE, _MASTER))
_EXTENDED = 0xFF
_LONGEST = 2048
"""The largest payload of the protocol; a longer one is a false header."""


class MessageId(IntEnum):
    """What a frame is."""

    GO_TO_MEASUREMENT = 0x10
    GO_TO_MEASUREMENT_ACK = 0x11
    GO_TO_CONFIG = 0x30
    GO_TO_CONFIG_ACK = 0x31
    MT_DATA2 = 0x36
    WAKE_UP = 0x3E
    ERROR = 0x42
    SET_OUTPUT_CONFIGURATION = 0xC0
    SET_OUTPUT_CONFIGURATION_ACK = 0xC1


def frame(message: int, payload: bytes = b"") -> bytes:
    """A frame to or from the device; payloads of 255 bytes and more get an extended length."""
    length = bytes([len(payload)]) if len(payload) < _EXTENDED else bytes([_EXTENDED]) + len(payload).to_bytes(2, "big")
    body = bytes([_MASTER, message]) + length + payload
    return bytes([_PREAMBLE]) + body + bytes([-sum(body) & 0xFF])


class FrameScanner:
    """Finds frames in bytes that may begin anywhere and be damaged; holds no more than one unfinished frame."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._held = b""
        self._in_burst = False

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Message ids and payloads of the frames that these bytes complete."""
        self._counts.received_bytes += len(data)
        held, at, frames = self._held + data, 0, []
        while True:
            begin = held.find(_HEADER, at)
            if begin < 0:  # the last byte may be the first half of a header
                begin = max(at, len(held) - held.endswith(_HEADER[:1]))
            self._drop(begin - at)
            at = begin
            extent = _extent(held, at)
            if extent is None:
                break
            payload, end = extent
            if payload - at > 4 and end - payload - 1 > _LONGEST:
                self._drop(1)
                at += 1
            elif end > len(held):
                break
            elif sum(held[at + 1 : end]) & 0xFF:
                self._drop(1)
                at += 1
            else:
                frames.append((held[at + 2], held[payload : end - 1]))
                self._in_burst = False
                at = end
        self._held = held[at:]
        return frames

    def _drop(self, count: int) -> None:
        if count:
            self._counts.dropped_bytes += count
            self._counts.bursts += not self._in_burst
            self._in_burst = True


def _extent(held: bytes, at: int) -> tuple[int, int] | None:
    """Where the payload of the frame at `at` begins and the frame ends, or None while its length is unknown."""
    if len(held) < at + 4:
        return None
    if held[at + 3] != _EXTENDED:
        return at + 4, at + 5 + held[at + 3]
    if len(held) < at + 6:
        return None
    return at + 6, at + 7 + int.from_bytes(held[at + 4 : at + 6], "big")
