"""The navigation message of GLONASS: strings of 85 bits ⇄ ephemeris.

The interface document counts bits from 85 down to 1; here its bit n is bit 86 − n. Source: GLONASS ICD 5.1 (2008),
sections 4.3 to 4.7 (tables 4.5 and 4.13).
"""

from __future__ import annotations

from collections.abc import Sequence

from air.gnss.bits import Layout, bits_of, joined, magnitude, split, unsigned
from air.gnss.gnss_time import DAY_NS, SECOND_NS, nearest
from common.measurements import GlonassEphemeris

STRING_BITS = 85
_WORDS = 3
_PAD = 32 * _WORDS - STRING_BITS
_CHECK_BITS = 8
MOSCOW_MINUS_UTC_S = 3 * 3600

EPHEMERIS = Layout(
    4,
    STRING_BITS,
    (
        unsigned("string1", 1, (1, 2, 4)),
        unsigned("tk_hours", 1, (1, 10, 5)),
        unsigned("tk_minutes", 1, (1, 15, 6)),
        unsigned("tk_seconds", 30, (1, 21, 1)),
        magnitude("vx", 2**-20 * 1e3, (1, 22, 24)),
        magnitude("ax", 2**-30 * 1e3, (1, 46, 5)),
        magnitude("x", 2**-11 * 1e3, (1, 51, 27)),
        unsigned("string2", 1, (2, 2, 4)),
        unsigned("health2", 1, (2, 6, 3)),
        unsigned("tb", 900, (2, 10, 7)),
        magnitude("vy", 2**-20 * 1e3, (2, 22, 24)),
        magnitude("ay", 2**-30 * 1e3, (2, 46, 5)),
        magnitude("y", 2**-11 * 1e3, (2, 51, 27)),
        unsigned("string3", 1, (3, 2, 4)),
        magnitude("gamma", 2**-40, (3, 7, 11)),
        unsigned("health3", 1, (3, 21, 1)),
        magnitude("vz", 2**-20 * 1e3, (3, 22, 24)),
        magnitude("az", 2**-30 * 1e3, (3, 46, 5)),
        magnitude("z", 2**-11 * 1e3, (3, 51, 27)),
        unsigned("string4", 1, (4, 2, 4)),
        magnitude("tau", 2**-30, (4, 6, 22)),
        unsigned("age_days", 1, (4, 33, 5)),
        unsigned("slot", 1, (4, 71, 5)),
    ),
)
"""Strings 1 to 4."""
_UNHEALTHY = 0b100
"""The first bit of Bn; the other two say nothing that a user needs."""


def _check_masks() -> list[int]:
    """The bits that each check bit covers, itself included: a Hamming code, data bits at no powers of two."""
    positions = [n for n in range(1, 128) if n & n - 1][: STRING_BITS - _CHECK_BITS]
    masks = []
    for i in range(_CHECK_BITS - 1):
        data = sum(1 << _CHECK_BITS + k for k, position in enumerate(positions) if position >> i & 1)
        masks.append(data | 1 << i)
    return [*masks, (1 << STRING_BITS) - 1]


_CHECKS = _check_masks()


def string(words: Sequence[int]) -> int | None:
    """The 85 bits of a string from the receiver's words of 32 bits, its first bits first; None where its code fails."""
    if len(words) < _WORDS:
        return None
    bits = joined(words[:_WORDS], 32) >> _PAD
    return None if any((bits & mask).bit_count() & 1 for mask in _CHECKS) else bits


def string_number(bits: int) -> int:
    """Which of the fifteen strings of a frame it is, from 1."""
    return bits_of(bits, STRING_BITS, 2, 4)


def frame_number(words: Sequence[int]) -> int:
    """What tells frames apart in the receiver's fourth word: superframe and frame; 0 where it does not say."""
    return words[_WORDS] if len(words) > _WORDS else 0


def ephemeris(parts: Sequence[int], satellite: str, channel: int, t_ns: int, leap_s: int) -> GlonassEphemeris | None:
    """The ephemeris of strings 1 to 4 of one frame, received at `t_ns` (GPST) with `leap_s` between GPST and UTC.

    None for strings of another satellite, or with an impossible time.
    """
    v = EPHEMERIS.read(parts)
    if v["slot"] not in (0, int(satellite[1:])) or not 0 < v["tb"] < 86_400:
        return None
    time_of_day_ns = round(v["tb"] - MOSCOW_MINUS_UTC_S + leap_s) * SECOND_NS
    return GlonassEphemeris(
        t_ns=t_ns,
        satellite=satellite,
        toe_ns=nearest(time_of_day_ns, DAY_NS, t_ns),
        position=(v["x"], v["y"], v["z"]),
        velocity=(v["vx"], v["vy"], v["vz"]),
        acceleration=(v["ax"], v["ay"], v["az"]),
        tau=-v["tau"],
        gamma=v["gamma"],
        channel=channel,
        age_days=int(v["age_days"]),
        health=int(v["health2"]) & _UNHEALTHY | int(v["health3"]),
    )


def strings(eph: GlonassEphemeris, sent_ns: int, leap_s: int) -> list[tuple[int, ...]]:
    """Strings 1 to 4 of the frame sent at a time in GPST, ns, each in four of the receiver's words of 32 bits.

    The date (N4, NT) is left out. Raises ValueError naming a value that the message cannot hold.
    """
    moscow_s = sent_ns // SECOND_NS - leap_s + MOSCOW_MINUS_UTC_S
    of_day_s = moscow_s % 86_400
    frame = of_day_s // 150 << 16 | of_day_s % 150 // 30 + 1
    values = {
        **{f"string{i}": i for i in range(1, 5)},
        **dict(zip(("x", "y", "z"), eph.position, strict=True)),
        **dict(zip(("vx", "vy", "vz"), eph.velocity, strict=True)),
        **dict(zip(("ax", "ay", "az"), eph.acceleration, strict=True)),
        "tk_hours": of_day_s // 3600,
        "tk_minutes": of_day_s % 3600 // 60,
        "tk_seconds": of_day_s % 60 // 30 * 30,
        "tau": -eph.tau,
        "gamma": eph.gamma,
        "tb": (eph.toe_ns // SECOND_NS + MOSCOW_MINUS_UTC_S - leap_s) % 86_400,
        "age_days": eph.age_days,
        "slot": int(eph.satellite[1:]),
        "health2": eph.health & _UNHEALTHY,
        "health3": eph.health & 1,
    }
    return [(*split(_with_checks(part) << _PAD, _WORDS, 32), frame) for part in EPHEMERIS.write(values)]


def _with_checks(part: int) -> int:
    for mask in _CHECKS[:-1]:
        part |= ((part & mask).bit_count() & 1) * (mask & 0x7F)
    return part | (part.bit_count() & 1) << _CHECK_BITS - 1
