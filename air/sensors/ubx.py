"""UBX frames of u-blox receivers, both ways, and the NMEA sentences that may stand between them.

Source: u-blox F9 HPG 1.32, Interface Description (UBX-22008968), sections 3.2 to 3.4.
"""

from __future__ import annotations

import re

import numpy as np
from pyubx2 import UBX_MSGIDS

from common.framing import UNFINISHED

SYNC = b"\xb5\x62"
_HEADER, _CHECKSUM = 6, 2
_LONGEST = 8192
"""No message that we know is longer; a larger length is a false header, and not worth waiting for."""
_WEIGHTS = np.arange(_LONGEST + _HEADER, 0, -1).astype(np.uint8)
_NMEA = re.compile(rb"\$([\x20-\x23\x25-\x29\x2b-\x7e]*)\*([0-9A-Fa-f]{2})\r\n")
_NMEA_BEGUN = re.compile(rb"\$[\x20-\x23\x25-\x7e]*\r?")
_NMEA_LONGEST = 400
"""The protocol says 82; u-blox's own sentences are longer."""


def frame(message: int, payload: bytes = b"") -> bytes:
    """A frame of the message `class << 8 | id`."""
    body = message.to_bytes(2, "big") + len(payload).to_bytes(2, "little") + payload
    return SYNC + body + checksum(body)


def checksum(body: bytes) -> bytes:
    """The two checksum bytes over class, id, length and payload: Fletcher's, modulo 256."""
    values = np.frombuffer(body, np.uint8)
    first = int(np.add.reduce(values, dtype=np.uint8))
    second = int(np.dot(values, _WEIGHTS[len(_WEIGHTS) - len(body) :]))  # uint8 wraps as it should
    return bytes((first, second))


def message_of(frame: bytes) -> int:
    """Which message a frame carries, as `class << 8 | id`."""
    return frame[2] << 8 | frame[3]


def payload_of(frame: bytes) -> bytes:
    """What a frame carries."""
    return frame[_HEADER:-_CHECKSUM]


def name_of(message: int) -> str:
    """Name of a message as u-blox writes it, e.g. RXM-RAWX; unknown ones by class and id."""
    return str(UBX_MSGIDS.get(message.to_bytes(2, "big"), f"UBX-{message >> 8:02X}-{message & 0xFF:02X}"))


def probe(held: bytes, at: int) -> int:
    """Length of the valid UBX frame at a place, for `FrameScanner`."""
    if not SYNC.startswith(held[at : at + 2]):
        return 0
    if len(held) < at + _HEADER:
        return UNFINISHED
    length = int.from_bytes(held[at + 4 : at + 6], "little")
    if length > _LONGEST:
        return 0
    end = at + _HEADER + length + _CHECKSUM
    if len(held) < end:
        return UNFINISHED
    valid = checksum(held[at + 2 : end - _CHECKSUM]) == held[end - _CHECKSUM : end]
    return end - at if valid else 0


def probe_nmea(held: bytes, at: int) -> int:
    """Length of the valid NMEA sentence at a place, for `FrameScanner`."""
    if found := _NMEA.match(held, at, at + _NMEA_LONGEST):
        check = 0
        for byte in found[1]:
            check ^= byte
        return found.end() - at if check == int(found[2], 16) else 0
    begun = _NMEA_BEGUN.match(held, at, at + _NMEA_LONGEST)
    unfinished = begun is not None and begun.end() == len(held) and len(held) - at < _NMEA_LONGEST
    return UNFINISHED if unfinished else 0
