"""When satellites send which piece of their navigation messages, as a receiver hands it out.

Pieces that hold neither ephemeris nor ionosphere nor time (almanacs and the like) are left out. Sources: IS-GPS-200,
20.3.2 and figure 20-1; Galileo OS SIS ICD, table 41 (E1-B); BeiDou B1I ICD, 5.2.2 and 5.3.2; GLONASS ICD 5.1, 4.3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from air.gnss import beidou_d1_d2, glonass_strings, inav, lnav
from air.gnss.gnss_time import BDT_MINUS_GPST_NS, GPS_EPOCH_NS, SECOND_NS, WEEK_NS
from air.gnss.orbit import is_geostationary
from air.sensors.ubx_messages import NavigationBits
from air.sources.simulated.gnss.constellation import Constellation
from common.measurements import GlonassEphemeris, KeplerEphemeris

_FRAME_NS = 30 * SECOND_NS
_FLIGHT_TIME_NS = 75_000_000
_LNAV_PAGES, _KLOBUCHAR_PAGE = 25, 18
_INAV_WORDS = ((0, 2), (2, 4), (4, 6), (10, 0), (20, 1), (22, 3), (24, 5))
"""When, s from the frame's begin, which word is sent on E1-B."""


@dataclass(frozen=True)
class Piece:
    """A piece of a message: begun and wholly received at GPST, ns."""

    begin_ns: int
    end_ns: int
    bits: NavigationBits


class Broadcast:
    """The messages of a constellation, frame by frame of 30 s; the frames of the present are kept."""

    def __init__(self, constellation: Constellation):
        self._constellation = constellation
        self._frames: dict[str, tuple[int, list[Piece]]] = {}

    def pieces(self, satellite: str, begin_ns: int, end_ns: int) -> Iterator[Piece]:
        """Pieces of a satellite that are wholly received from `begin_ns` on and before `end_ns`, less than 30 s."""
        for t_ns in sorted({self._frame_of(satellite, t - _FLIGHT_TIME_NS - 1) for t in (begin_ns, end_ns)}):
            yield from (piece for piece in self._frame(satellite, t_ns) if begin_ns <= piece.end_ns < end_ns)

    def _frame_of(self, satellite: str, t_ns: int) -> int:
        """When the frame of a satellite that is on air at `t_ns` began."""
        shift_ns = {"C": -BDT_MINUS_GPST_NS, "R": self._constellation.leap_s * SECOND_NS}.get(satellite[0], 0)
        origin_ns = GPS_EPOCH_NS + shift_ns
        return origin_ns + (t_ns - origin_ns) // _FRAME_NS * _FRAME_NS

    def _frame(self, satellite: str, t_ns: int) -> list[Piece]:
        if self._frames.get(satellite, (0, []))[0] != t_ns:
            self._frames[satellite] = t_ns, list(self._encoded(satellite, t_ns))
        return self._frames[satellite][1]

    def _encoded(self, satellite: str, t_ns: int) -> Iterator[Piece]:
        eph = self._constellation.issue(satellite, t_ns)
        if isinstance(eph, GlonassEphemeris):
            for i, words in enumerate(glonass_strings.strings(eph, t_ns, self._constellation.leap_s)):
                yield _piece(t_ns, 2 * i, 2, NavigationBits(satellite, "1C", eph.channel, words))
        elif satellite[0] == "G":
            for i, words in enumerate(self._lnav(eph, t_ns)):
                yield _piece(t_ns, 6 * i, 6, NavigationBits(satellite, "1C", 0, words))
        elif satellite[0] == "E":
            for after_s, word in _INAV_WORDS:
                page = self._inav(eph, word, t_ns + after_s * SECOND_NS)
                yield _piece(t_ns, after_s, 2, NavigationBits(satellite, "1B", 0, page))
        else:
            step_s, length_s = (3.0, 0.6) if is_geostationary(satellite) else (6.0, 6.0)
            subframes = beidou_d1_d2.ephemeris_words(eph, self._constellation.beidou_ionosphere, t_ns)
            for i, words in enumerate(subframes):
                yield _piece(t_ns, step_s * i, length_s, NavigationBits(satellite, "2I", 0, words))

    def _lnav(self, eph: KeplerEphemeris, t_ns: int) -> list[tuple[int, ...]]:
        subframes = lnav.ephemeris_words(eph, t_ns)
        page = (t_ns - GPS_EPOCH_NS) % WEEK_NS // _FRAME_NS % _LNAV_PAGES + 1
        if page == _KLOBUCHAR_PAGE:
            subframes.append(lnav.ionosphere_words(self._constellation.ionosphere, t_ns + 18 * SECOND_NS))
        return subframes

    def _inav(self, eph: KeplerEphemeris, word: int, sent_ns: int) -> tuple[int, ...]:
        if word == 0:
            return inav.time_page(sent_ns)
        if word == 6:
            return inav.utc_page(self._constellation.leap_s, sent_ns)
        return inav.pages(eph, sent_ns)[word - 1]


def _piece(frame_ns: int, after_s: float, length_s: float, bits: NavigationBits) -> Piece:
    begin_ns = frame_ns + round(after_s * SECOND_NS) + _FLIGHT_TIME_NS
    return Piece(begin_ns, begin_ns + round(length_s * SECOND_NS), bits)
