"""The legacy navigation message (LNAV) of GPS and QZSS: words of 30 bits ⇄ ephemeris and ionosphere.

Source: IS-GPS-200, section 20.3 (figure 20-1, tables 20-I, 20-III, 20-X, 20-XIV); IS-QZSS-PNT, section 4.
"""

from __future__ import annotations

from collections.abc import Sequence

from air.gnss.bits import SEMICIRCLE, Layout, bits_of, joined, signed, split, unsigned, ura_index, ura_m
from air.gnss.gnss_time import WEEK_NS, from_week, nearest, to_week
from common.measurements import Ionosphere, KeplerEphemeris

WORDS, WORD_BITS = 10, 30
SUBFRAME_BITS = WORDS * WORD_BITS
PREAMBLE = 0x8B
ROLLOVER_WEEKS = 1024
KLOBUCHAR_PAGE = 56
"""SV id of subframe 4, page 18, which holds the ionosphere."""

EPHEMERIS = Layout(
    3,
    SUBFRAME_BITS,
    (
        unsigned("week", 1, (1, 61, 10)),
        unsigned("ura", 1, (1, 73, 4)),
        unsigned("health", 1, (1, 77, 6)),
        unsigned("iodc", 1, (1, 83, 2), (1, 211, 8)),
        signed("tgd", 2**-31, (1, 197, 8)),
        unsigned("toc", 2**4, (1, 219, 16)),
        signed("af2", 2**-55, (1, 241, 8)),
        signed("af1", 2**-43, (1, 249, 16)),
        signed("af0", 2**-31, (1, 271, 22)),
        unsigned("iode", 1, (2, 61, 8)),
        signed("crs", 2**-5, (2, 69, 16)),
        signed("delta_n", 2**-43 * SEMICIRCLE, (2, 91, 16)),
        signed("m0", 2**-31 * SEMICIRCLE, (2, 107, 8), (2, 121, 24)),
        signed("cuc", 2**-29, (2, 151, 16)),
        unsigned("e", 2**-33, (2, 167, 8), (2, 181, 24)),
        signed("cus", 2**-29, (2, 211, 16)),
        unsigned("sqrt_a", 2**-19, (2, 227, 8), (2, 241, 24)),
        unsigned("toe", 2**4, (2, 271, 16)),
        signed("cic", 2**-29, (3, 61, 16)),
        signed("omega0", 2**-31 * SEMICIRCLE, (3, 77, 8), (3, 91, 24)),
        signed("cis", 2**-29, (3, 121, 16)),
        signed("i0", 2**-31 * SEMICIRCLE, (3, 137, 8), (3, 151, 24)),
        signed("crc", 2**-5, (3, 181, 16)),
        signed("omega", 2**-31 * SEMICIRCLE, (3, 197, 8), (3, 211, 24)),
        signed("omega_dot", 2**-43 * SEMICIRCLE, (3, 241, 24)),
        unsigned("iode3", 1, (3, 271, 8)),
        signed("idot", 2**-43 * SEMICIRCLE, (3, 279, 14)),
    ),
)
KLOBUCHAR = Layout(
    1,
    SUBFRAME_BITS,
    (
        unsigned("page", 1, (1, 63, 6)),
        signed("alpha0", 2**-30, (1, 69, 8)),
        signed("alpha1", 2**-27, (1, 77, 8)),
        signed("alpha2", 2**-24, (1, 91, 8)),
        signed("alpha3", 2**-24, (1, 99, 8)),
        signed("beta0", 2**11, (1, 107, 8)),
        signed("beta1", 2**14, (1, 121, 8)),
        signed("beta2", 2**16, (1, 129, 8)),
        signed("beta3", 2**16, (1, 137, 8)),
    ),
)
_HEADER = Layout(
    1,
    SUBFRAME_BITS,
    (unsigned("preamble", 1, (1, 1, 8)), unsigned("tow", 6, (1, 31, 17)), unsigned("id", 1, (1, 50, 3))),
)

_PARITY_MASKS = tuple(
    sum(1 << 24 - bit for bit in bits)
    for bits in (
        (1, 2, 3, 5, 6, 10, 11, 12, 13, 14, 17, 18, 20, 23),
        (2, 3, 4, 6, 7, 11, 12, 13, 14, 15, 18, 19, 21, 24),
        (1, 3, 4, 5, 7, 8, 12, 13, 14, 15, 16, 19, 20, 22),
        (2, 4, 5, 6, 8, 9, 13, 14, 15, 16, 17, 20, 21, 23),
        (1, 3, 5, 6, 7, 9, 10, 14, 15, 16, 17, 18, 21, 22, 24),
        (3, 5, 6, 8, 9, 10, 11, 13, 15, 19, 22, 23, 24),
    )
)
"""Data bits in parity bits 25 to 30, each with bit 29 or 30 of the word before (IS-GPS-200, table 20-XIV)."""
_BIT_29_BEFORE = 0b101001
"""The parity bits with bit 29 of the word before; the others have its bit 30."""


def parity(data: int, before: int) -> int:
    """The six parity bits of 24 data bits after the word `before`, all with their polarity resolved.

    A word is sent inverted, parity and all, when the last bit sent before it is 1. Resolved words are as if that bit
    were always 0; what is left of the word before is whether its last two bits differ.
    """
    out = 0
    for mask in _PARITY_MASKS:
        out = out << 1 | (data & mask).bit_count() & 1
    return out ^ (_BIT_29_BEFORE if (before ^ before >> 1) & 1 else 0)


def subframe(words: Sequence[int]) -> int | None:
    """The 300 bits of a subframe from its words with resolved polarity; None where preamble or parity fail.

    What a receiver puts above the 30 bits of a word is ignored.
    """
    if len(words) < WORDS:
        return None
    before = 0  # every subframe ends with two zero bits
    for word in words[:WORDS]:
        if parity(word >> 6 & 0xFFFFFF, before) != word & 0x3F:
            return None
        before = word
    bits = joined(words[:WORDS], WORD_BITS)
    return bits if bits_of(bits, SUBFRAME_BITS, 1, 8) == PREAMBLE else None


def subframe_id(bits: int) -> int:
    """Which of the five subframes it is, 1 to 5; other values are never sent."""
    return bits_of(bits, SUBFRAME_BITS, 50, 3)


def ephemeris(parts: Sequence[int], satellite: str, t_ns: int) -> KeplerEphemeris | None:
    """The ephemeris of subframes 1, 2 and 3, received at about `t_ns` (GPST); None while they are of two issues."""
    v = EPHEMERIS.read(parts)
    if not v["iode"] == v["iode3"] == int(v["iodc"]) & 0xFF:
        return None
    sent_ns = nearest(from_week(int(v["week"]), _HEADER.read(parts[:1])["tow"]), ROLLOVER_WEEKS * WEEK_NS, t_ns)
    week, _ = to_week(sent_ns)
    if max(v["toe"], v["toc"]) >= 604_800:
        return None
    return KeplerEphemeris(
        t_ns=t_ns,
        satellite=satellite,
        source="LNAV",
        toe_ns=nearest(from_week(week, v["toe"]), WEEK_NS, sent_ns),
        toc_ns=nearest(from_week(week, v["toc"]), WEEK_NS, sent_ns),
        iode=int(v["iode"]),
        iodc=int(v["iodc"]),
        group_delay=(v["tgd"], 0.0),
        accuracy=ura_m(v["ura"]),
        health=int(v["health"]),
        **{name: v[name] for name in ORBIT_AND_CLOCK},
    )


ORBIT_AND_CLOCK = (
    *("af0", "af1", "af2", "sqrt_a", "e", "i0", "omega0", "omega", "m0", "delta_n", "idot", "omega_dot"),
    *("cuc", "cus", "crc", "crs", "cic", "cis"),
)
"""Fields that every Kepler message gives as they are."""


def ionosphere(bits: int, system: str, t_ns: int) -> Ionosphere | None:
    """The ionosphere in a subframe 4, or None when it is another of its pages."""
    v = KLOBUCHAR.read([bits])
    if v["page"] != KLOBUCHAR_PAGE:
        return None
    alpha, beta = ((v[f"{name}0"], v[f"{name}1"], v[f"{name}2"], v[f"{name}3"]) for name in ("alpha", "beta"))
    return Ionosphere(t_ns, system, alpha, beta)


def ephemeris_words(eph: KeplerEphemeris, sent_ns: int) -> list[tuple[int, ...]]:
    """Subframes 1, 2 and 3 (ten words each), the first sent at a time in GPST, ns, a multiple of 6 s.

    Raises ValueError naming a value that the message cannot hold.
    """
    week, tow_s = to_week(sent_ns)
    values = {name: getattr(eph, name) for name in ORBIT_AND_CLOCK} | {
        "week": week % ROLLOVER_WEEKS,
        "ura": ura_index(eph.accuracy),
        "health": eph.health,
        "iodc": eph.iodc,
        "iode": eph.iode,
        "iode3": eph.iode,
        "tgd": eph.group_delay[0],
        "toe": to_week(eph.toe_ns)[1],
        "toc": to_week(eph.toc_ns)[1],
    }
    parts = EPHEMERIS.write(values)
    return [_words(part, i + 1, tow_s + 6 * i) for i, part in enumerate(parts)]


def ionosphere_words(iono: Ionosphere, sent_ns: int) -> tuple[int, ...]:
    """Subframe 4, page 18 (ten words), sent at a time in GPST, ns. Raises ValueError like `ephemeris_words`."""
    values: dict[str, float] = {"page": KLOBUCHAR_PAGE}
    values |= {f"alpha{i}": value for i, value in enumerate(iono.alpha)}
    values |= {f"beta{i}": value for i, value in enumerate(iono.beta)}
    (part,) = KLOBUCHAR.write(values)
    return _words(part, 4, to_week(sent_ns)[1])


def _words(part: int, number: int, tow_s: float) -> tuple[int, ...]:
    """The words of a subframe with its header and parity; it names the time at which the next one begins."""
    header = {"preamble": PREAMBLE, "tow": (tow_s + 6) % 604_800, "id": number}
    (part,) = _HEADER.write(header, [part])
    words: list[int] = []
    before, inverted = 0, 0
    for i, word in enumerate(split(part, WORDS, WORD_BITS)):
        data = word >> 6
        if i in (1, 9):  # its last two data bits are chosen so that it is sent with two zeros at its end
            data = next(d for d in range(data & ~3, (data | 3) + 1) if parity(d, before) & 3 == 3 * inverted)
        before = data << 6 | parity(data, before)
        inverted ^= before & 1
        words.append(before)
    return tuple(words)
