"""Messages of u-blox receivers by number, and the payload of RXM-SFRBX, both ways.

Source: u-blox F9 HPG 1.32, Interface Description (UBX-22008968), sections 3.9 and 3.17.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from air.sensors.ubx_signals import GLONASS, SATELLITE_IDS, SATELLITE_NAMES, SIGNAL_NAMES, signal_id

NAV_PVT, RXM_SFRBX, RXM_RAWX, ACK_NAK, ACK_ACK, CFG_VALSET = 0x0107, 0x0213, 0x0215, 0x0500, 0x0501, 0x068A


@dataclass(frozen=True)
class NavigationBits:
    """A subframe, page or string of a navigation message, as the receiver hands it out in words of 32 bits."""

    satellite: str
    signal: str
    channel: int
    words: tuple[int, ...]


def parse_sfrbx(payload: bytes) -> NavigationBits | None:
    """What RXM-SFRBX holds; None when damaged, or of a satellite or signal without name."""
    if len(payload) < 8 or len(payload) != 8 + 4 * payload[4]:
        return None
    gnss, sv, signal, frequency, count = payload[:5]
    satellite, name = SATELLITE_NAMES.get((gnss, sv)), SIGNAL_NAMES.get((gnss, signal))
    if satellite is None or name is None:
        return None
    words = struct.unpack_from(f"<{count}I", payload, 8)
    return NavigationBits(satellite, name, frequency - 7 if gnss == GLONASS else 0, words)


def pack_sfrbx(bits: NavigationBits) -> bytes:
    """The payload of RXM-SFRBX. Raises KeyError for a satellite or signal that u-blox has no number for."""
    gnss, sv = SATELLITE_IDS[bits.satellite]
    frequency = bits.channel + 7 if gnss == GLONASS else 0
    head = bytes((gnss, sv, signal_id(bits.satellite, bits.signal), frequency, len(bits.words), 0, 2, 0))
    return head + struct.pack(f"<{len(bits.words)}I", *bits.words)
