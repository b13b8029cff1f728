"""Signals of the satellites: frequencies by satellite and observation code.

Satellites are named as in RINEX 3 (G05, R12, E31, C06, J02, S23), signals by the last two letters of its observation
codes, of which the first is the band. Source: RINEX 3.05, tables 4 to 10.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.arrays import F64, I32

LIGHT = 299_792_458.0
"""Speed of light, m/s."""

_L1, _L2, _L5 = 1575.42e6, 1227.60e6, 1176.45e6
_FREQUENCY = {
    "G": {"1": _L1, "2": _L2, "5": _L5},
    "J": {"1": _L1, "2": _L2, "5": _L5, "6": 1278.75e6},
    "E": {"1": _L1, "5": _L5, "6": 1278.75e6, "7": 1207.14e6, "8": 1191.795e6},
    "C": {"1": _L1, "2": 1561.098e6, "5": _L5, "6": 1268.52e6, "7": 1207.14e6, "8": 1191.795e6},
    "S": {"1": _L1, "5": _L5},
    "I": {"5": _L5, "9": 2492.028e6},
    "R": {"3": 1202.025e6, "4": 1600.995e6, "6": 1248.06e6},
}
_FDMA = {"1": (1602.0e6, 562.5e3), "2": (1246.0e6, 437.5e3)}
"""GLONASS: frequency of channel 0 and the step from channel to channel, Hz."""
CHANNELS = range(-7, 7)
"""Frequency numbers that GLONASS uses."""

PRIMARY = {"G": "1", "J": "1", "E": "1", "R": "1", "C": "2"}
SECONDARY = {"G": "2", "J": "2", "E": "7", "R": "2", "C": "7"}
"""Bands of a single-frequency position, and those that remove the ionosphere together with them."""
_PREFERENCE = "CPYWMNSLBXQIAZD"
"""Attributes of codes in one band, the one to prefer first."""


def frequency(satellite: str, signal: str, channel: int = 0) -> float:
    """Carrier frequency of a signal in Hz, NaN for one that is unknown."""
    system, band = satellite[:1], signal[:1]
    if system == "R" and band in _FDMA:
        base, step = _FDMA[band]
        return base + channel * step if channel in CHANNELS else np.nan
    return _FREQUENCY.get(system, {}).get(band, np.nan)


def frequencies(satellites: Sequence[str], signals: Sequence[str], channels: I32) -> F64:
    """Carrier frequencies (N,) in Hz, NaN for unknown signals."""
    rows = zip(satellites, signals, channels.tolist(), strict=True)
    return np.array([frequency(*row) for row in rows], float)


def preference(signal: str) -> int:
    """Rank of a signal among those of its band; the lowest is to be used first."""
    found = _PREFERENCE.find(signal[1:2])
    return found if found >= 0 and len(signal) > 1 else len(_PREFERENCE)
