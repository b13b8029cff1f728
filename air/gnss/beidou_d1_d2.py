"""The D1 and D2 messages of BeiDou (B1I, B2I, B3I): words of 30 bits ⇄ ephemeris and ionosphere.

D1 comes from satellites in medium and inclined orbits, three subframes of 6 s; D2 from geostationary ones, ten pages
of subframe 1, one each 3 s. Source: BeiDou B1I ICD 3.0, section 5 (tables 5-6 to 5-9; figures 5-8 and 5-12).
"""

from __future__ import annotations

from collections.abc import Sequence

from air.gnss.bits import SEMICIRCLE, Field, Layout, bits_of, joined, signed, split, unsigned, ura_index, ura_m
from air.gnss.gnss_time import BEIDOU_EPOCH_NS, WEEK_NS, nearest
from air.gnss.lnav import ORBIT_AND_CLOCK
from common.measurements import Ionosphere, KeplerEphemeris

WORDS, WORD_BITS = 10, 30
SUBFRAME_BITS = WORDS * WORD_BITS
PREAMBLE = 0x712
GEOSTATIONARY = frozenset(f"C{number:02d}" for number in (*range(1, 6), *range(59, 64)))

_KLOBUCHAR_NAMES = (*(f"alpha{i}" for i in range(4)), *(f"beta{i}" for i in range(4)))
_KLOBUCHAR_SCALES = (2.0**-30, 2.0**-27, 2.0**-24, 2.0**-24, 2.0**11, 2.0**14, 2.0**16, 2.0**16)


def _klobuchar(*spans: tuple[tuple[int, int, int], ...]) -> tuple[Field, ...]:
    items = zip(_KLOBUCHAR_NAMES, _KLOBUCHAR_SCALES, spans, strict=True)
    return tuple(signed(name, scale, *places) for name, scale, places in items)


D1 = Layout(
    3,
    SUBFRAME_BITS,
    (
        unsigned("sow", 1, (1, 19, 8), (1, 31, 12)),
        unsigned("health", 1, (1, 43, 1)),
        unsigned("aodc", 1, (1, 44, 5)),
        unsigned("ura", 1, (1, 49, 4)),
        unsigned("week", 1, (1, 61, 13)),
        unsigned("toc", 8, (1, 74, 9), (1, 91, 8)),
        signed("tgd1", 1e-10, (1, 99, 10)),
        signed("tgd2", 1e-10, (1, 109, 4), (1, 121, 6)),
        *_klobuchar(
            ((1, 127, 8),),
            ((1, 135, 8),),
            ((1, 151, 8),),
            ((1, 159, 8),),
            ((1, 167, 6), (1, 181, 2)),
            ((1, 183, 8),),
            ((1, 191, 8),),
            ((1, 199, 4), (1, 211, 4)),
        ),
        signed("af2", 2**-66, (1, 215, 11)),
        signed("af0", 2**-33, (1, 226, 7), (1, 241, 17)),
        signed("af1", 2**-50, (1, 258, 5), (1, 271, 17)),
        unsigned("aode", 1, (1, 288, 5)),
        unsigned("sow2", 1, (2, 19, 8), (2, 31, 12)),
        signed("delta_n", 2**-43 * SEMICIRCLE, (2, 43, 10), (2, 61, 6)),
        signed("cuc", 2**-31, (2, 67, 16), (2, 91, 2)),
        signed("m0", 2**-31 * SEMICIRCLE, (2, 93, 20), (2, 121, 12)),
        unsigned("e", 2**-33, (2, 133, 10), (2, 151, 22)),
        signed("cus", 2**-31, (2, 181, 18)),
        signed("crc", 2**-6, (2, 199, 4), (2, 211, 14)),
        signed("crs", 2**-6, (2, 225, 8), (2, 241, 10)),
        unsigned("sqrt_a", 2**-19, (2, 251, 12), (2, 271, 20)),
        unsigned("toe", 8, (2, 291, 2), (3, 43, 10), (3, 61, 5)),
        unsigned("sow3", 1, (3, 19, 8), (3, 31, 12)),
        signed("i0", 2**-31 * SEMICIRCLE, (3, 66, 17), (3, 91, 15)),
        signed("cic", 2**-31, (3, 106, 7), (3, 121, 11)),
        signed("omega_dot", 2**-43 * SEMICIRCLE, (3, 132, 11), (3, 151, 13)),
        signed("cis", 2**-31, (3, 164, 9), (3, 181, 9)),
        signed("idot", 2**-43 * SEMICIRCLE, (3, 190, 13), (3, 211, 1)),
        signed("omega0", 2**-31 * SEMICIRCLE, (3, 212, 21), (3, 241, 11)),
        signed("omega", 2**-31 * SEMICIRCLE, (3, 252, 11), (3, 271, 21)),
    ),
)
"""Subframes 1 to 3."""

D2 = Layout(
    10,
    SUBFRAME_BITS,
    (
        unsigned("sow", 1, (1, 19, 8), (1, 31, 12)),
        unsigned("health", 1, (1, 47, 1)),
        unsigned("aodc", 1, (1, 48, 5)),
        unsigned("ura", 1, (1, 61, 4)),
        unsigned("week", 1, (1, 65, 13)),
        unsigned("toc", 8, (1, 78, 5), (1, 91, 12)),
        signed("tgd1", 1e-10, (1, 103, 10)),
        signed("tgd2", 1e-10, (1, 121, 10)),
        *_klobuchar(
            ((2, 47, 6), (2, 61, 2)),
            ((2, 63, 8),),
            ((2, 71, 8),),
            ((2, 79, 4), (2, 91, 4)),
            ((2, 95, 8),),
            ((2, 103, 8),),
            ((2, 111, 2), (2, 121, 6)),
            ((2, 127, 8),),
        ),
        signed("af0", 2**-33, (3, 101, 12), (3, 121, 12)),
        signed("af1", 2**-50, (3, 133, 4), (4, 47, 6), (4, 61, 12)),
        signed("af2", 2**-66, (4, 73, 10), (4, 91, 1)),
        unsigned("aode", 1, (4, 92, 5)),
        signed("delta_n", 2**-43 * SEMICIRCLE, (4, 97, 16)),
        signed("cuc", 2**-31, (4, 121, 14), (5, 47, 4)),
        signed("m0", 2**-31 * SEMICIRCLE, (5, 51, 2), (5, 61, 22), (5, 91, 8)),
        signed("cus", 2**-31, (5, 99, 14), (5, 121, 4)),
        unsigned("e", 2**-33, (5, 125, 10), (6, 47, 6), (6, 61, 16)),
        unsigned("sqrt_a", 2**-19, (6, 77, 6), (6, 91, 22), (6, 121, 4)),
        signed("cic", 2**-31, (6, 125, 10), (7, 47, 6), (7, 61, 2)),
        signed("cis", 2**-31, (7, 63, 18)),
        unsigned("toe", 8, (7, 81, 2), (7, 91, 15)),
        signed("i0", 2**-31 * SEMICIRCLE, (7, 106, 7), (7, 121, 14), (8, 47, 6), (8, 61, 5)),
        signed("crc", 2**-6, (8, 66, 17), (8, 91, 1)),
        signed("crs", 2**-6, (8, 92, 18)),
        signed("omega_dot", 2**-43 * SEMICIRCLE, (8, 110, 3), (8, 121, 16), (9, 47, 5)),
        signed("omega0", 2**-31 * SEMICIRCLE, (9, 52, 1), (9, 61, 22), (9, 91, 9)),
        signed("omega", 2**-31 * SEMICIRCLE, (9, 100, 13), (9, 121, 14), (10, 47, 5)),
        signed("idot", 2**-43 * SEMICIRCLE, (10, 52, 1), (10, 61, 13)),
    ),
)
"""Pages 1 to 10 of subframe 1."""

_HEADER = Layout(
    1,
    SUBFRAME_BITS,
    (
        unsigned("preamble", 1, (1, 1, 11)),
        unsigned("id", 1, (1, 16, 3)),
        unsigned("sow", 1, (1, 19, 8), (1, 31, 12)),
    ),
)
_PAGE = Layout(1, SUBFRAME_BITS, (unsigned("page", 1, (1, 43, 4)),))
_GENERATOR = 0b10011
"""Of the code BCH(15, 11, 1): x⁴ + x + 1."""


def _remainder(bits: int, length: int) -> int:
    for i in range(length - 5, -1, -1):
        if bits >> i + 4 & 1:
            bits ^= _GENERATOR << i
    return bits


def _bch(data: int) -> int:
    """The four check bits of eleven data bits."""
    return _remainder(data << 4, 15)


_BCH = tuple(_bch(data) for data in range(1 << 11))


def checks(data: int) -> int:
    """The eight check bits of a word's 22 data bits: four for each half. (On air the halves are interleaved.)"""
    return _BCH[data >> 11] << 4 | _BCH[data & 0x7FF]


def subframe(words: Sequence[int]) -> int | None:
    """The 300 bits of a subframe from the receiver's ten words of 30 bits; None where preamble or a code fail."""
    if len(words) < WORDS:
        return None
    bits = joined(words[:WORDS], WORD_BITS)
    first, *others = split(bits, WORDS, WORD_BITS)
    if _BCH[first >> 4 & 0x7FF] != first & 0xF or any(checks(word >> 8) != word & 0xFF for word in others):
        return None
    return bits if bits_of(bits, SUBFRAME_BITS, 1, 11) == PREAMBLE else None


def source(satellite: str) -> str:
    """Which message a satellite sends: D2 when geostationary, else D1."""
    return "D2" if satellite in GEOSTATIONARY else "D1"


def place(bits: int, message: str) -> tuple[int, int, int] | None:
    """Which part of how many of D1 or D2 a subframe is, and when the set began, s of the week; None for other parts."""
    header = _HEADER.read([bits])
    number, sow = int(header["id"]), int(header["sow"])
    if message == "D1":
        return (number, D1.parts, (sow - 6 * (number - 1)) % 604_800) if number <= D1.parts else None
    page = int(_PAGE.read([bits])["page"])
    known = number == 1 and 1 <= page <= D2.parts
    return (page, D2.parts, (sow - 3 * (page - 1)) % 604_800) if known else None


def ephemeris(parts: Sequence[int], satellite: str, t_ns: int) -> tuple[KeplerEphemeris, Ionosphere] | None:
    """What a whole set of parts holds, received at `t_ns` (GPST); None for impossible times."""
    message = source(satellite)
    v = (D1 if message == "D1" else D2).read(parts)
    if max(v["toe"], v["toc"], v["sow"]) >= 604_800:
        return None
    sent_ns = _bdt(v["week"], v["sow"])
    alpha, beta = ((v[f"{name}0"], v[f"{name}1"], v[f"{name}2"], v[f"{name}3"]) for name in ("alpha", "beta"))
    eph = KeplerEphemeris(
        t_ns=t_ns,
        satellite=satellite,
        source=message,
        toe_ns=nearest(_bdt(v["week"], v["toe"]), WEEK_NS, sent_ns),
        toc_ns=nearest(_bdt(v["week"], v["toc"]), WEEK_NS, sent_ns),
        iode=int(v["aode"]),
        iodc=int(v["aodc"]),
        group_delay=(v["tgd1"], v["tgd2"]),
        accuracy=ura_m(v["ura"]),
        health=int(v["health"]),
        **{name: v[name] for name in ORBIT_AND_CLOCK},
    )
    return eph, Ionosphere(t_ns, "C", alpha, beta)


def _bdt(week: float, sow: float) -> int:
    """GPST, ns, of a week and second in BDT."""
    return BEIDOU_EPOCH_NS + int(week) * WEEK_NS + round(sow * 1e9)


def ephemeris_words(eph: KeplerEphemeris, iono: Ionosphere, sent_ns: int) -> list[tuple[int, ...]]:
    """The three subframes of D1 or the ten pages of D2 (ten words each), the first sent at a time in GPST, ns.

    Raises ValueError naming a value that the message cannot hold.
    """
    layout, step_s = (D1, 6) if source(eph.satellite) == "D1" else (D2, 3)
    week, sow_ns = divmod(sent_ns - BEIDOU_EPOCH_NS, WEEK_NS)
    starts = [(sow_ns // 1_000_000_000 + step_s * i) % 604_800 for i in range(layout.parts)]
    values: dict[str, float] = {name: getattr(eph, name) for name in ORBIT_AND_CLOCK}
    values |= {f"alpha{i}": value for i, value in enumerate(iono.alpha)}
    values |= {f"beta{i}": value for i, value in enumerate(iono.beta)}
    values |= {
        "week": week,
        "sow": starts[0],
        "sow2": starts[1],
        "sow3": starts[2],
        "health": eph.health,
        "aodc": eph.iodc,
        "aode": eph.iode,
        "ura": ura_index(eph.accuracy),
        "toe": (eph.toe_ns - BEIDOU_EPOCH_NS) % WEEK_NS * 1e-9,
        "toc": (eph.toc_ns - BEIDOU_EPOCH_NS) % WEEK_NS * 1e-9,
        "tgd1": eph.group_delay[0],
        "tgd2": eph.group_delay[1],
    }
    out = []
    for i, part in enumerate(layout.write(values)):
        header = {"preamble": PREAMBLE, "id": i + 1 if layout is D1 else 1, "sow": starts[i]}
        (part,) = _HEADER.write(header, [part])
        if layout is D2:
            (part,) = _PAGE.write({"page": i + 1}, [part])
        out.append(_words(part))
    return out


def _words(part: int) -> tuple[int, ...]:
    first, *others = split(part, WORDS, WORD_BITS)
    return (first & ~0xF | _BCH[first >> 4 & 0x7FF], *(word & ~0xFF | checks(word >> 8) for word in others))
