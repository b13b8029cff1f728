"""The I/NAV message of Galileo (E1-B and E5b-I): pages of two halves ⇄ words of 128 bits ⇄ ephemeris.

Source: Galileo OS SIS ICD 2.1, sections 4.3 and 5.1 (tables 42 to 47, 66, 87 to 91).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from air.gnss.bits import SEMICIRCLE, Layout, bits_of, joined, signed, split, unsigned
from air.gnss.gnss_time import WEEK_NS, from_week, nearest, to_week
from air.gnss.lnav import ORBIT_AND_CLOCK
from common.crc24q import crc24q
from common.measurements import KeplerEphemeris

WORD_BITS = 128
FIRST_WEEK = 1024
"""GPS week in which Galileo's week 0 was."""
_HALF_BITS, _WORDS = 128, 8
_CRC_BITS = 196

EPHEMERIS = Layout(
    5,
    WORD_BITS,
    (
        unsigned("type1", 1, (1, 1, 6)),
        unsigned("iodnav1", 1, (1, 7, 10)),
        unsigned("toe", 60, (1, 17, 14)),
        signed("m0", 2**-31 * SEMICIRCLE, (1, 31, 32)),
        unsigned("e", 2**-33, (1, 63, 32)),
        unsigned("sqrt_a", 2**-19, (1, 95, 32)),
        unsigned("type2", 1, (2, 1, 6)),
        unsigned("iodnav2", 1, (2, 7, 10)),
        signed("omega0", 2**-31 * SEMICIRCLE, (2, 17, 32)),
        signed("i0", 2**-31 * SEMICIRCLE, (2, 49, 32)),
        signed("omega", 2**-31 * SEMICIRCLE, (2, 81, 32)),
        signed("idot", 2**-43 * SEMICIRCLE, (2, 113, 14)),
        unsigned("type3", 1, (3, 1, 6)),
        unsigned("iodnav3", 1, (3, 7, 10)),
        signed("omega_dot", 2**-43 * SEMICIRCLE, (3, 17, 24)),
        signed("delta_n", 2**-43 * SEMICIRCLE, (3, 41, 16)),
        signed("cuc", 2**-29, (3, 57, 16)),
        signed("cus", 2**-29, (3, 73, 16)),
        signed("crc", 2**-5, (3, 89, 16)),
        signed("crs", 2**-5, (3, 105, 16)),
        unsigned("sisa", 1, (3, 121, 8)),
        unsigned("type4", 1, (4, 1, 6)),
        unsigned("iodnav4", 1, (4, 7, 10)),
        unsigned("svid", 1, (4, 17, 6)),
        signed("cic", 2**-29, (4, 23, 16)),
        signed("cis", 2**-29, (4, 39, 16)),
        unsigned("toc", 60, (4, 55, 14)),
        signed("af0", 2**-34, (4, 69, 31)),
        signed("af1", 2**-46, (4, 100, 21)),
        signed("af2", 2**-59, (4, 121, 6)),
        unsigned("type5", 1, (5, 1, 6)),
        signed("bgd_e5a", 2**-32, (5, 48, 10)),
        signed("bgd_e5b", 2**-32, (5, 58, 10)),
        unsigned("e5b_health", 1, (5, 68, 2)),
        unsigned("e1b_health", 1, (5, 70, 2)),
        unsigned("e5b_data", 1, (5, 72, 1)),
        unsigned("e1b_data", 1, (5, 73, 1)),
        unsigned("week", 1, (5, 74, 12)),
        unsigned("tow", 1, (5, 86, 20)),
    ),
)
"""Words 1 to 5."""
_TIME = Layout(
    1,
    WORD_BITS,
    (
        unsigned("type", 1, (1, 1, 6)),
        unsigned("valid", 1, (1, 7, 2)),
        unsigned("week", 1, (1, 97, 12)),
        unsigned("tow", 1, (1, 109, 20)),
    ),
)
"""Word 0."""
_UTC = Layout(
    1,
    WORD_BITS,
    (unsigned("type", 1, (1, 1, 6)), signed("leap_s", 1, (1, 63, 8)), unsigned("tow", 1, (1, 106, 20))),
)
"""Word 6: of GST against UTC, only whole seconds are read and written."""
_TIME_VALID = 0b10


def word(words: Sequence[int]) -> int | None:
    """The 128 bits of the word in a page, from the receiver's eight words of 32 bits: even half, then odd half.

    None for alert pages, halves in the wrong order, and where the CRC fails.
    """
    if len(words) < _WORDS:
        return None
    page = joined(words[:_WORDS], 32)
    even, odd = page >> _HALF_BITS, page & (1 << _HALF_BITS) - 1
    if bits_of(even, _HALF_BITS, 1, 2) != 0b00 or bits_of(odd, _HALF_BITS, 1, 2) != 0b10:
        return None
    if _crc(even, odd) != bits_of(odd, _HALF_BITS, 83, 24):
        return None
    return bits_of(even, _HALF_BITS, 3, 112) << 16 | bits_of(odd, _HALF_BITS, 3, 16)


def page(word: int) -> tuple[int, ...]:
    """A word of 128 bits in the receiver's words of 32: eight, and an empty one, as an F9P has for E1-B."""
    even = word >> 16 << _HALF_BITS - 114
    odd = 0b10 << _HALF_BITS - 2 | (word & 0xFFFF) << _HALF_BITS - 18
    odd |= _crc(even, odd) << _HALF_BITS - 106
    return (*split(even << _HALF_BITS | odd, _WORDS, 32), 0)


def _crc(even: int, odd: int) -> int:
    """The CRC over the first 114 bits of the even and the first 82 of the odd half."""
    covered = bits_of(even, _HALF_BITS, 1, 114) << 82 | bits_of(odd, _HALF_BITS, 1, 82)
    return crc24q(covered.to_bytes(math.ceil(_CRC_BITS / 8), "big"))


def word_type(bits: int) -> int:
    """Which word it is, 0 to 63."""
    return bits_of(bits, WORD_BITS, 1, 6)


def ephemeris(parts: Sequence[int], satellite: str, t_ns: int) -> KeplerEphemeris | None:
    """The ephemeris of words 1 to 5, received at about `t_ns` (GPST); None while they are of different issues."""
    v = EPHEMERIS.read(parts)
    if not v["iodnav1"] == v["iodnav2"] == v["iodnav3"] == v["iodnav4"] or v["svid"] != int(satellite[1:]):
        return None
    week = FIRST_WEEK + int(v["week"])
    sent_ns = from_week(week, v["tow"])
    if max(v["toe"], v["toc"]) >= 604_800:
        return None
    # As in RINEX: E1-B data, E1-B signal, (E5a is not in this message,) E5b data, E5b signal.
    health = int(v["e1b_data"]) | int(v["e1b_health"]) << 1 | int(v["e5b_data"]) << 6 | int(v["e5b_health"]) << 7
    return KeplerEphemeris(
        t_ns=t_ns,
        satellite=satellite,
        source="INAV",
        toe_ns=nearest(from_week(week, v["toe"]), WEEK_NS, sent_ns),
        toc_ns=nearest(from_week(week, v["toc"]), WEEK_NS, sent_ns),
        iode=int(v["iodnav1"]),
        iodc=int(v["iodnav1"]),
        group_delay=(v["bgd_e5a"], v["bgd_e5b"]),
        accuracy=sisa_m(int(v["sisa"])),
        health=health,
        **{name: v[name] for name in ORBIT_AND_CLOCK},
    )


def pages(eph: KeplerEphemeris, sent_ns: int) -> list[tuple[int, ...]]:
    """Pages with words 1 to 5 of an ephemeris, the last sent at a time in GPST, ns, a whole second.

    Raises ValueError naming a value that the message cannot hold.
    """
    week, tow_s = to_week(sent_ns)
    values = {name: getattr(eph, name) for name in ORBIT_AND_CLOCK} | {
        **{f"type{i}": i for i in range(1, 6)},
        **{f"iodnav{i}": eph.iode for i in range(1, 5)},
        "svid": int(eph.satellite[1:]),
        "sisa": sisa_index(eph.accuracy),
        "bgd_e5a": eph.group_delay[0],
        "bgd_e5b": eph.group_delay[1],
        "e1b_data": eph.health & 1,
        "e1b_health": eph.health >> 1 & 3,
        "e5b_data": eph.health >> 6 & 1,
        "e5b_health": eph.health >> 7 & 3,
        "toe": to_week(eph.toe_ns)[1],
        "toc": to_week(eph.toc_ns)[1],
        "week": week - FIRST_WEEK,
        "tow": tow_s,
    }
    return [page(word) for word in EPHEMERIS.write(values)]


def time_page(sent_ns: int) -> tuple[int, ...]:
    """The page with word 0, which tells week and time, sent at a time in GPST, ns, a whole second."""
    week, tow_s = to_week(sent_ns)
    (word,) = _TIME.write({"type": 0, "valid": _TIME_VALID, "week": week - FIRST_WEEK, "tow": tow_s})
    return page(word)


def utc_page(leap_s: int, sent_ns: int) -> tuple[int, ...]:
    """The page with word 6, which tells GPST minus UTC, sent at a time in GPST, ns, a whole second."""
    (word,) = _UTC.write({"type": 6, "leap_s": leap_s, "tow": to_week(sent_ns)[1]})
    return page(word)


def sisa_m(index: int) -> float:
    """Signal-in-space accuracy, m, of its index; NaN where none is predicted."""
    for first, start, step in ((100, 2.0, 0.16), (75, 1.0, 0.04), (50, 0.5, 0.02), (0, 0.0, 0.01)):
        if index >= first:
            return start + step * (index - first) if index <= 125 else math.nan
    return math.nan


def sisa_index(accuracy: float) -> int:
    """The smallest index whose accuracy is at least as large, m; 255 (none predicted) for NaN."""
    return next((i for i in range(126) if sisa_m(i) >= accuracy - 1e-9), 255)
