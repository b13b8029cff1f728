"""What a u-blox F9P is told at start: rates, signals, messages, as one CFG-VALSET.

Source: u-blox F9 HPG 1.32, Interface Description (UBX-22008968), sections 3.10.25 and 6.
"""

from __future__ import annotations

from enum import StrEnum

from pyubx2 import SET_LAYER_RAM, TXN_NONE, UBXMessage


class Port(StrEnum):
    """Where the receiver is connected."""

    USB = "usb"
    UART1 = "uart1"
    UART2 = "uart2"


_SIGNALS = {
    "GPS": ("L1CA", "L2C"),
    "SBAS": ("L1CA",),
    "GAL": ("E1", "E5B"),
    "BDS": ("B1", "B2"),
    "QZSS": ("L1CA", "L2C"),
    "GLO": ("L1", "L2"),
}
_AIRBORNE_2G = 7
"""The dynamic model of something that flies, up to 2 g."""
_MESSAGES = {"UBX_RXM_RAWX": 1, "UBX_RXM_SFRBX": 1, "UBX_NAV_PVT": 1}


def settings(port: Port, rate_hz: int) -> list[tuple[str, int]]:
    """Keys and values: raw measurements of all constellations in both bands and solutions at `rate_hz`, in UBX alone.

    RTCM 3 corrections are taken on the same port.
    """
    name = port.name
    return [
        ("CFG_RATE_MEAS", round(1000 / rate_hz)),
        ("CFG_RATE_NAV", 1),
        ("CFG_NAVSPG_DYNMODEL", _AIRBORNE_2G),
        *((f"CFG_SIGNAL_{system}_ENA", 1) for system in _SIGNALS),
        *((f"CFG_SIGNAL_{system}_{one}_ENA", 1) for system, ones in _SIGNALS.items() for one in ones),
        *((f"CFG_MSGOUT_{message}_{name}", every) for message, every in _MESSAGES.items()),
        (f"CFG_{name}INPROT_UBX", 1),
        (f"CFG_{name}INPROT_RTCM3X", 1),
        (f"CFG_{name}OUTPROT_UBX", 1),
        (f"CFG_{name}OUTPROT_NMEA", 0),
        (f"CFG_{name}OUTPROT_RTCM3X", 0),
    ]


def settings_frame(port: Port, rate_hz: int) -> bytes:
    """The frame that sets them all at once, until the receiver loses power; the receiver acknowledges it or refuses."""
    frame: bytes = UBXMessage.config_set(SET_LAYER_RAM, TXN_NONE, settings(port, rate_hz)).serialize()
    return frame
