"""Ephemerides as satellites may broadcast them, for tests."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from hypothesis import strategies as st

from air.gnss import beidou_d1_d2, glonass_strings, inav, lnav
from air.gnss.bits import ura_m
from air.gnss.gnss_time import SECOND_NS, from_week
from common.measurements import GlonassEphemeris, Ionosphere, KeplerEphemeris

SENT_NS = from_week(2370, 200_010.0)
"""The begin of a frame in GPST; of one in BDT it is 14 s late."""
LEAP_S = 18
Words = tuple[int, ...]
SIGNAL = {"G": "1C", "J": "1C", "E": "1B", "C": "2I", "R": "1C"}


def within(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit)


def keplers(satellite: str, source: str, step_s: int, **more: Any) -> st.SearchStrategy[KeplerEphemeris]:
    """Ephemerides with values in the ranges that every message can hold, toe and toc in whole steps near SENT_NS."""
    shift_ns = 14 * SECOND_NS if satellite[0] == "C" else 0
    times = st.integers(-3600 // step_s, 7200 // step_s).map(
        lambda n: (SENT_NS // SECOND_NS // step_s + n) * step_s * SECOND_NS + shift_ns
    )
    angle = within(0.999 * math.pi)
    values = {
        "t_ns": st.just(SENT_NS),
        "satellite": st.just(satellite),
        "source": st.just(source),
        "toe_ns": times,
        "toc_ns": times,
        "iode": st.integers(0, 31),
        "af0": within(9e-4),
        "af1": within(1.8e-9),
        "af2": within(1e-17),
        "sqrt_a": st.floats(5000, 6600),
        "e": st.floats(0, 0.4),
        "i0": angle,
        "omega0": angle,
        "omega": angle,
        "m0": angle,
        "delta_n": within(1e-8),
        "idot": within(2e-9),
        "omega_dot": within(1e-8),
        "cuc": within(6e-5),
        "cus": within(6e-5),
        "cic": within(6e-5),
        "cis": within(6e-5),
        "crc": within(1000),
        "crs": within(1000),
        "group_delay": st.tuples(within(5e-8), within(5e-8)),
        "accuracy": st.integers(0, 14).map(ura_m),
        "health": st.integers(0, 1),
    } | more
    return st.fixed_dictionaries(values).map(lambda v: KeplerEphemeris(**{"iodc": v["iode"]} | v))


def lnavs(satellite: str = "G05") -> st.SearchStrategy[KeplerEphemeris]:
    delays = st.tuples(within(5e-8), st.just(0.0))
    return keplers(satellite, "LNAV", 16, group_delay=delays, health=st.integers(0, 63))


def inavs(satellite: str = "E12") -> st.SearchStrategy[KeplerEphemeris]:
    delays = st.tuples(within(1e-7), within(1e-7))
    healths = st.sampled_from([0, 1, 0b110, 1 << 6, 0b11 << 7, 0b111000111])
    accuracies = st.sampled_from([0.0, 0.49, 0.5, 0.98, 1.0, 1.96, 2.0, 3.12, 6.0, math.nan])
    return keplers(satellite, "INAV", 60, group_delay=delays, health=healths, accuracy=accuracies)


def beidous(satellite: str) -> st.SearchStrategy[KeplerEphemeris]:
    return keplers(satellite, "D2" if satellite == "C03" else "D1", 8)


def ionospheres(system: str) -> st.SearchStrategy[Ionosphere]:
    alpha = st.tuples(within(1e-7), within(9e-7), within(7e-6), within(7e-6))
    beta = st.tuples(within(2e5), within(2e6), within(8e6), within(8e6))
    return st.builds(Ionosphere, st.just(SENT_NS), st.just(system), alpha, beta)


def glonasses(satellite: str = "R07") -> st.SearchStrategy[GlonassEphemeris]:
    def triple(limit: float) -> st.SearchStrategy[tuple[float, float, float]]:
        return st.tuples(within(limit), within(limit), within(limit))

    quarter_ns = 900 * SECOND_NS
    middle_ns = SENT_NS // quarter_ns * quarter_ns + LEAP_S * SECOND_NS
    return st.builds(
        GlonassEphemeris,
        t_ns=st.just(SENT_NS),
        satellite=st.just(satellite),
        toe_ns=st.integers(-3, 3).map(lambda n: middle_ns + n * quarter_ns),
        position=triple(2.7e7),
        velocity=triple(4000.0),
        acceleration=triple(1.3e-5),
        tau=within(1.9e-3),
        gamma=within(9e-10),
        channel=st.just(5),
        age_days=st.integers(0, 31),
        health=st.sampled_from([0, 1, 4, 5]),
    )


def typical(satellite: str, source: str, **more: Any) -> KeplerEphemeris:
    """An ephemeris with a value of usual size in every field."""
    toe_ns = from_week(2370, 201_600.0) + (14 * SECOND_NS if satellite[0] == "C" else 0)
    eph = KeplerEphemeris(
        t_ns=SENT_NS,
        satellite=satellite,
        source=source,
        toe_ns=toe_ns,
        toc_ns=toe_ns,
        iode=13,
        iodc=13,
        af0=-3.1234567e-4,
        af1=-1.4567e-11,
        af2=3.4e-18,
        sqrt_a=5440.6123456,
        e=0.0123456789,
        i0=0.9612345678,
        omega0=-2.0123456789,
        omega=1.7123456789,
        m0=-0.4123456789,
        delta_n=4.5123e-9,
        idot=-3.1234e-10,
        omega_dot=-8.1234567e-9,
        cuc=-5.1234e-6,
        cus=9.1234e-6,
        crc=208.09,
        crs=-101.37,
        cic=1.1234e-7,
        cis=-4.4321e-8,
        group_delay=(-9.3e-9, 0.0 if source == "LNAV" else -1.02e-8),
        accuracy=2.0,
        health=0,
    )
    return replace(eph, **more)


GLONASS = GlonassEphemeris(
    t_ns=SENT_NS,
    satellite="R07",
    toe_ns=from_week(2370, 200_700.0) + LEAP_S * SECOND_NS,
    position=(11_618_723.6, -629_885.2, 22_733_784.7),
    velocity=(-1020.4257, 2931.5586, 598.8883),
    acceleration=(0.0, 9.3e-7, -1.8626e-6),
    tau=-4.0439e-5,
    gamma=-9.0949e-13,
    channel=5,
    age_days=1,
    health=0,
)
SOME = {
    "LNAV": typical("G05", "LNAV"),
    "INAV": typical("E12", "INAV"),
    "D1": typical("C21", "D1"),
    "D2": typical("C03", "D2"),
}


def pieces_of(eph: KeplerEphemeris | GlonassEphemeris) -> list[Words]:
    if isinstance(eph, GlonassEphemeris):
        return glonass_strings.strings(eph, SENT_NS, LEAP_S)
    if eph.source == "LNAV":
        return lnav.ephemeris_words(eph, SENT_NS)
    if eph.source == "INAV":
        return inav.pages(eph, SENT_NS)
    return beidou_d1_d2.ephemeris_words(eph, Ionosphere(0, "C", (0.0,) * 4, (0.0,) * 4), SENT_NS + 14 * SECOND_NS)
