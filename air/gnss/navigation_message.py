"""Broadcast navigation messages of all constellations: collects what belongs together, gives what is new."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from air.gnss import beidou_d1_d2, glonass_strings, inav, lnav
from common.measurements import Ephemeris, Ionosphere, KeplerEphemeris

Broadcast = Ephemeris | Ionosphere

_SIGNALS = {
    "G": {"1C"},
    "J": {"1C"},
    "E": {"1C", "1B", "7I", "7Q"},
    "C": {"2I", "7I", "6I"},
    "R": {"1C", "2C"},
}
"""The signals that carry the messages read here; others carry CNAV, F/NAV and the like."""
_SQRT_A = (4000.0, 7000.0)
_E_MOST = 0.5
"""No navigation satellite flies outside these: a satellite that has nothing to say fills its message with patterns."""


@dataclass
class _Set:
    """Parts of one message, by number, that were sent together."""

    key: int = 0
    parts: dict[int, int] = field(default_factory=dict)


class NavigationMessages:
    """Takes what satellites send, piece by piece, and gives ephemerides and ionospheres when they are new.

    Parts of different issues never mix. `refused` counts pieces that failed their parity or CRC.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._sets: dict[str, _Set] = {}
        self._latest: dict[tuple[str, str], str] = {}

    def add(
        self, satellite: str, signal: str, words: Sequence[int], channel: int, t_ns: int, leap_s: int
    ) -> list[Broadcast]:
        """What a subframe, page or string completes, if it was not known; `channel` is GLONASS's frequency number.

        `words` as the receiver hands them out, `t_ns` when (GPST, good to weeks; GLONASS: to hours), `leap_s` GPST
        minus UTC.
        """
        system = satellite[:1]
        if signal not in _SIGNALS.get(system, ()):
            return []
        if system in "GJ":
            found = self._lnav(satellite, words, t_ns)
        elif system == "E":
            found = self._inav(satellite, words, t_ns)
        elif system == "C":
            found = self._beidou(satellite, words, t_ns)
        else:
            found = self._glonass(satellite, words, channel, t_ns, leap_s)
        return [message for message in found if self._is_new(message)]

    def _lnav(self, satellite: str, words: Sequence[int], t_ns: int) -> list[Broadcast]:
        bits = lnav.subframe(words)
        if bits is None:
            return self._refuse()
        number = lnav.subframe_id(bits)
        if number == 4:
            iono = lnav.ionosphere(bits, satellite[:1], t_ns)
            return [] if iono is None else [iono]
        parts = self._collect(satellite, number, lnav.EPHEMERIS.parts, bits)
        return _believed(lnav.ephemeris(parts, satellite, t_ns) if parts else None)

    def _inav(self, satellite: str, words: Sequence[int], t_ns: int) -> list[Broadcast]:
        bits = inav.word(words)
        if bits is None:
            return self._refuse()
        parts = self._collect(satellite, inav.word_type(bits), inav.EPHEMERIS.parts, bits)
        return _believed(inav.ephemeris(parts, satellite, t_ns) if parts else None)

    def _beidou(self, satellite: str, words: Sequence[int], t_ns: int) -> list[Broadcast]:
        bits = beidou_d1_d2.subframe(words)
        if bits is None:
            return self._refuse()
        place = beidou_d1_d2.place(bits, beidou_d1_d2.source(satellite))
        if place is None:
            return []
        number, count, begun = place
        parts = self._collect(satellite, number, count, bits, begun)
        found = beidou_d1_d2.ephemeris(parts, satellite, t_ns) if parts else None
        return [*_believed(found[0]), found[1]] if found else []

    def _glonass(self, satellite: str, words: Sequence[int], channel: int, t_ns: int, leap_s: int) -> list[Broadcast]:
        bits = glonass_strings.string(words)
        if bits is None:
            return self._refuse()
        frame = glonass_strings.frame_number(words)
        number = glonass_strings.string_number(bits)
        parts = self._collect(satellite, number, glonass_strings.EPHEMERIS.parts, bits, frame)
        if parts is None:
            return []
        return _believed(glonass_strings.ephemeris(parts, satellite, channel, t_ns, leap_s))

    def _refuse(self) -> list[Broadcast]:
        self.refused += 1
        return []

    def _collect(self, satellite: str, number: int, count: int, bits: int, key: int = 0) -> list[int] | None:
        """All parts 1 to `count` of a satellite's message once they are there; another key begins a new set."""
        if not 1 <= number <= count:
            return None
        held = self._sets.setdefault(satellite, _Set(key))
        if held.key != key:
            held = self._sets[satellite] = _Set(key)
        held.parts[number] = bits
        return [held.parts[i] for i in range(1, count + 1)] if len(held.parts) == count else None

    def _is_new(self, message: Broadcast) -> bool:
        """Whether anything but the time of its reception differs from what was last given."""
        name = message.system if isinstance(message, Ionosphere) else message.satellite
        key = (type(message).__name__, name)
        content = repr(replace(message, t_ns=0))  # as text, in which NaN equals itself
        if self._latest.get(key) == content:
            return False
        self._latest[key] = content
        return True


def _believed(eph: Ephemeris | None) -> list[Broadcast]:
    """The ephemeris in a list, unless there is none or its orbit is impossible."""
    if isinstance(eph, KeplerEphemeris) and not (_SQRT_A[0] <= eph.sqrt_a <= _SQRT_A[1] and eph.e <= _E_MOST):
        return []
    return [] if eph is None else [eph]
