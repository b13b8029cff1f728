"""How u-blox numbers satellites and signals, and what RINEX calls them.

Source: u-blox F9 HPG 1.32, Interface Description (UBX-22008968), sections 1.5.2 and 1.5.4; RINEX 3.04, table 4 to 9.
"""

from __future__ import annotations

from air.gnss.beidou_d1_d2 import GEOSTATIONARY

GLONASS = 6
_SATELLITES = {0: ("G", 1, 32, 0), 1: ("S", 120, 158, 100), 2: ("E", 1, 36, 0), 3: ("C", 1, 63, 0)} | {
    5: ("J", 1, 10, 0),
    6: ("R", 1, 32, 0),
    7: ("I", 1, 14, 0),
}
"""By constellation: letter, first and last number, and what RINEX takes off."""
_SIGNALS = {
    0: {0: "1C", 3: "2L", 4: "2S", 6: "5I", 7: "5Q"},
    1: {0: "1C"},
    2: {0: "1C", 1: "1B", 3: "5I", 4: "5Q", 5: "7I", 6: "7Q", 8: "6B", 9: "6C", 10: "6A"},
    3: {0: "2I", 1: "2I", 2: "7I", 3: "7I", 4: "6I", 5: "1P", 6: "1D", 7: "5P", 8: "5D", 10: "6I"},
    5: {0: "1C", 1: "1Z", 4: "2S", 5: "2L", 8: "5I", 9: "5Q"},
    6: {0: "1C", 2: "2C"},
    7: {0: "5A"},
}
SATELLITE_NAMES = {
    (constellation, number): f"{letter}{number - off:02d}"
    for constellation, (letter, first, last, off) in _SATELLITES.items()
    for number in range(first, last + 1)
}
"""(gnssId, svId) → RINEX name. A GLONASS satellite whose number is unknown has none."""
SATELLITE_IDS = {name: ids for ids, name in SATELLITE_NAMES.items()}
SIGNAL_NAMES = {(constellation, i): name for constellation, names in _SIGNALS.items() for i, name in names.items()}
"""(gnssId, sigId) → the last two letters of RINEX observation codes."""
_SIGNAL_IDS = {(constellation, name): i for (constellation, i), name in reversed(SIGNAL_NAMES.items())}
"""Of several identifiers of a name, the first."""
_D2 = {0: 1, 2: 3, 4: 10}
"""sigId of a BeiDou signal with D1 → the same with D2."""


def signal_id(satellite: str, signal: str) -> int:
    """The sigId of a signal by its RINEX names; geostationary BeiDou satellites send D2. KeyError where it has none."""
    constellation, _ = SATELLITE_IDS[satellite]
    found = _SIGNAL_IDS[constellation, signal]
    return _D2.get(found, found) if satellite in GEOSTATIONARY else found
