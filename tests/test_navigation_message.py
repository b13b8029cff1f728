"""What satellites broadcast is read as it was meant: against its own encoding, RINEX files and RTKLIB."""

from __future__ import annotations

import math
import random
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from broadcast_samples import (
    GLONASS,
    LEAP_S,
    SENT_NS,
    SIGNAL,
    SOME,
    Words,
    beidous,
    glonasses,
    inavs,
    ionospheres,
    lnavs,
    pieces_of,
    typical,
)
from hypothesis import given
from hypothesis import strategies as st

from air.gnss import beidou_d1_d2, glonass_strings, inav, lnav
from air.gnss.bits import Field, Layout, signed, unsigned
from air.gnss.gnss_time import SECOND_NS, from_week, to_week
from air.gnss.navigation_message import Broadcast, NavigationMessages
from air.sensors import ubx
from air.sensors.ubx_messages import RXM_RAWX, RXM_SFRBX, NavigationBits, pack_sfrbx
from air.sensors.ubx_rawx import pack_rawx
from air.sources.source import open_source
from common.measurements import GlonassEphemeris, GnssEpoch, Ionosphere, KeplerEphemeris


def heard(satellite: str, pieces: list[Words], into: NavigationMessages | None = None) -> list[Broadcast]:
    into = into or NavigationMessages()
    signal, channel = SIGNAL[satellite[0]], 5 if satellite[0] == "R" else 0
    return [m for words in pieces for m in into.add(satellite, signal, words, channel, SENT_NS, LEAP_S)]


# Encoding and decoding

RESOLUTION: dict[str, tuple[Field, ...]] = {
    "LNAV": lnav.EPHEMERIS.fields,
    "INAV": inav.EPHEMERIS.fields,
    "D1": beidou_d1_d2.D1.fields,
    "D2": beidou_d1_d2.D2.fields,
}
EPHEMERIDES = st.one_of(lnavs(), lnavs("J02"), inavs(), beidous("C21"), beidous("C03"))


@given(EPHEMERIDES)
def test_an_ephemeris_is_heard_as_it_was_sent_within_half_of_its_last_bits(sent: KeplerEphemeris) -> None:
    (found,) = (m for m in heard(sent.satellite, pieces_of(sent)) if isinstance(m, KeplerEphemeris))
    steps = {field.name: field.scale for field in RESOLUTION[sent.source]}
    for field in fields(sent):
        was, read = getattr(sent, field.name), getattr(found, field.name)
        if field.name in lnav.ORBIT_AND_CLOCK:
            assert abs(read - was) <= 0.5000001 * steps[field.name], field.name
        elif field.name == "group_delay":
            assert np.allclose(read, was, rtol=0, atol=2.4e-10)  # half of GPS's last bit, the coarsest
        elif isinstance(was, float) and math.isnan(was):
            assert math.isnan(read)
        else:
            assert read == was, field.name
    assert pieces_of(found) == pieces_of(sent)


@given(glonasses())
def test_a_glonass_state_is_heard_as_it_was_sent_within_half_of_its_last_bits(sent: GlonassEphemeris) -> None:
    (found,) = heard(sent.satellite, pieces_of(sent))
    assert isinstance(found, GlonassEphemeris)
    for name, step in (
        ("position", 0.5),
        ("velocity", 1e-3),
        ("acceleration", 1e-6),
        ("tau", 2**-30),
        ("gamma", 2**-40),
    ):
        assert np.allclose(getattr(found, name), getattr(sent, name), rtol=0, atol=0.51 * step), name
    for name in ("toe_ns", "satellite", "channel", "age_days", "health"):
        assert getattr(found, name) == getattr(sent, name), name
    assert pieces_of(found) == pieces_of(sent)


@given(ionospheres("G"), ionospheres("C"))
def test_ionospheres_are_heard_as_they_were_sent(gps: Ionosphere, beidou: Ionosphere) -> None:
    (found,) = heard("G05", [lnav.ionosphere_words(gps, SENT_NS)])
    _, other = heard("C03", beidou_d1_d2.ephemeris_words(SOME["D2"], beidou, SENT_NS + 14 * SECOND_NS))
    for sent, read in ((gps, found), (beidou, other)):
        assert isinstance(read, Ionosphere)
        assert read.system == sent.system
        assert np.allclose(read.alpha, sent.alpha, rtol=0, atol=[2**-31, 2**-28, 2**-25, 2**-25])
        assert np.allclose(read.beta, sent.beta, rtol=0, atol=[2**10, 2**13, 2**15, 2**15])


def test_a_value_that_does_not_fit_is_named() -> None:
    with pytest.raises(ValueError, match=r"af0 is 0\.5; allowed: -0\.000976"):
        lnav.ephemeris_words(replace(SOME["LNAV"], af0=0.5), SENT_NS)


@given(st.integers(0, 2**40 - 1))
def test_a_layout_writes_what_it_reads(bits: int) -> None:
    layout = Layout(
        2, 20, (unsigned("a", 3, (1, 1, 5), (2, 16, 5)), signed("b", 0.5, (1, 6, 15)), signed("c", 1, (2, 1, 15)))
    )
    parts = [bits >> 20, bits & 0xFFFFF]
    assert layout.write(layout.read(parts)) == parts


# Collecting


UNPREDICTED = replace(SOME["LNAV"], accuracy=math.nan)
ALL = [*SOME.values(), UNPREDICTED, GLONASS]
each = pytest.mark.parametrize("eph", ALL, ids=[*SOME, "no accuracy", "GLONASS"])


@each
def test_what_is_repeated_is_given_once(eph: KeplerEphemeris | GlonassEphemeris) -> None:
    messages = NavigationMessages()
    assert heard(eph.satellite, pieces_of(eph), messages)
    assert not heard(eph.satellite, pieces_of(eph) * 2, messages)
    assert messages.refused == 0


@each
def test_the_order_of_the_pieces_does_not_matter(eph: KeplerEphemeris | GlonassEphemeris) -> None:
    assert heard(eph.satellite, pieces_of(eph)[::-1]) == heard(eph.satellite, pieces_of(eph))


@each
def test_a_piece_with_a_flipped_bit_is_refused(eph: KeplerEphemeris | GlonassEphemeris) -> None:
    width, used = (30, 10) if eph.satellite[0] in "GC" else (32, 8 if eph.satellite[0] == "E" else 2)
    for piece in pieces_of(eph):
        for bit in random.Random(1).sample(range(width * used), 40):
            if eph.satellite[0] == "E" and (114 <= bit < 128 or bit >= 234):
                continue  # the tail of a page half, beyond its CRC
            if eph.satellite[0] == "C" and bit < 15:
                continue  # outside the code: the preamble, and four reserved bits
            words = list(piece)
            words[bit // width] ^= 1 << width - 1 - bit % width
            messages = NavigationMessages()
            assert not heard(eph.satellite, [tuple(words)], messages)
            assert messages.refused == 1, bit


@pytest.mark.parametrize("name", ["LNAV", "INAV"])
def test_issues_do_not_mix(name: str) -> None:
    old, new = SOME[name], replace(SOME[name], iode=(SOME[name].iode + 1) % 32, iodc=(SOME[name].iode + 1) % 32)
    assert not heard(old.satellite, [*pieces_of(old)[:2], *pieces_of(new)[2:]])


@pytest.mark.parametrize("name", ["D1", "D2"])
def test_pieces_of_different_frames_do_not_mix(name: str) -> None:
    eph = SOME[name]
    iono = Ionosphere(0, "C", (0.0,) * 4, (0.0,) * 4)
    later = beidou_d1_d2.ephemeris_words(eph, iono, SENT_NS + 44 * SECOND_NS)
    assert not heard(eph.satellite, [*pieces_of(eph)[:2], *later[2:]])
    assert heard(eph.satellite, [*pieces_of(eph)[:2], *later])


def test_glonass_strings_of_different_frames_do_not_mix() -> None:
    later = glonass_strings.strings(GLONASS, SENT_NS + 30 * SECOND_NS, LEAP_S)
    assert not heard(GLONASS.satellite, [*pieces_of(GLONASS)[:2], *later[2:]])


def test_an_impossible_orbit_is_not_believed() -> None:
    """Satellites that have nothing to say send ones and zeros in turn, with valid parity."""
    assert not heard("G05", pieces_of(replace(SOME["LNAV"], sqrt_a=1000.0)))


def test_signals_with_other_messages_are_left_aside() -> None:
    assert not NavigationMessages().add("G05", "2L", (0x8B1A00D5,) * 10, 0, SENT_NS, LEAP_S)


@pytest.mark.parametrize("weeks", [-1000, -500, 0, 500, 1000])
def test_the_receivers_time_resolves_the_rollover_of_the_week(weeks: int) -> None:
    sent_ns = from_week(2370 + weeks, 200_010.0)
    toe_ns = from_week(2370 + weeks, 201_600.0)
    eph = replace(SOME["LNAV"], toe_ns=toe_ns, toc_ns=toe_ns)
    messages = NavigationMessages()
    pieces = lnav.ephemeris_words(eph, sent_ns)
    near_ns = from_week(2370 + weeks + 400, 0.0)
    (found,) = (m for words in pieces for m in messages.add("G05", "1C", words, 0, near_ns, LEAP_S))
    assert isinstance(found, KeplerEphemeris)
    assert found.toe_ns == toe_ns


def test_times_just_over_the_end_of_the_week_belong_to_the_next() -> None:
    sent_ns, toe_ns = from_week(2370, 604_788.0), from_week(2371, 7200.0)
    eph = replace(SOME["LNAV"], toe_ns=toe_ns, toc_ns=toe_ns)
    (found,) = heard("G05", lnav.ephemeris_words(eph, sent_ns))
    assert isinstance(found, KeplerEphemeris)
    assert (found.toe_ns, found.toc_ns) == (toe_ns, toe_ns)


# Against RINEX and RTKLIB


def issues(source: str) -> dict[tuple[str, int], KeplerEphemeris | GlonassEphemeris]:
    found = (m for m in open_source(source) if isinstance(m, KeplerEphemeris | GlonassEphemeris))
    return {(eph.satellite, eph.toe_ns): eph for eph in found}


def assert_equal_to_the_printed_digits(
    ours: KeplerEphemeris | GlonassEphemeris, theirs: KeplerEphemeris | GlonassEphemeris
) -> None:
    """RINEX prints twelve digits, the longest field of a message has ten; only the reception time may differ."""
    for field in fields(ours):
        a, b = getattr(ours, field.name), getattr(theirs, field.name)
        if field.name == "t_ns":
            assert abs(a - b) < 3600 * SECOND_NS
        elif isinstance(a, int | str):
            assert a == b, (ours.satellite, field.name)
        else:
            assert np.allclose(a, b, rtol=5.1e-12, atol=0, equal_nan=True), (ours.satellite, field.name, a, b)


def converted(recording: Path, folder: Path) -> Path:
    """The navigation file that RTKLIB makes of a UBX file."""
    if shutil.which("convbin") is None:
        pytest.skip("RTKLIB's convbin is not installed")
    out = folder / "rtklib.nav"
    command = ["convbin", "-r", "ubx", "-v", "3.04", "-o", str(folder / "rtklib.obs"), "-n", str(out), str(recording)]
    subprocess.run(command, check=True, capture_output=True)
    return out


def test_ephemerides_equal_the_rinex_that_came_with_the_recording(real_data: Callable[[str], Path]) -> None:
    folder = real_data("gnss")
    name = "16dBatt_no_interference_coldstart"
    ours = issues(f"ubx:{folder / name}.ubx")
    theirs = issues(f"rinex:{folder / name}.nav.gz")
    assert len(ours) == 28
    for key, eph in ours.items():
        assert_equal_to_the_printed_digits(eph, theirs[key])
    missing = {toe_ns for _, toe_ns in theirs.keys() - ours.keys()}
    assert missing == {1_745_563_200 * SECOND_NS}, (
        "the RINEX was made of a longer recording: its last issue is not here"
    )


def test_ephemerides_equal_those_of_rtklib(real_data: Callable[[str], Path], tmp_path: Path) -> None:
    recording = real_data("gnss") / "nhm.ubx"
    ours, theirs = issues(f"ubx:{recording}"), issues(f"rinex:{converted(recording, tmp_path)}")
    assert ours.keys() == theirs.keys()
    assert {satellite[0] for satellite, _ in ours} == set("GREC")
    for key, eph in ours.items():
        assert_equal_to_the_printed_digits(eph, theirs[key])


def as_ubx(pieces: list[tuple[str, Words]]) -> Iterator[bytes]:
    """A recording in which satellites send these pieces, one each second."""
    nothing = np.zeros(0)
    for i, (satellite, words) in enumerate(pieces):
        epoch = GnssEpoch(
            *(SENT_NS + i * SECOND_NS, "", (), (), nothing, nothing, nothing, nothing, nothing, nothing > 0),
            *(nothing, nothing, nothing, nothing.astype(np.int32), LEAP_S),
        )
        yield ubx.frame(RXM_RAWX, pack_rawx(epoch))
        yield ubx.frame(RXM_SFRBX, pack_sfrbx(NavigationBits(satellite, SIGNAL[satellite[0]], 5, words)))


def with_time(pages: list[Words]) -> list[Words]:
    """Words 1 to 5 twice, with words 6 and 0 between, without which RTKLIB takes no others."""
    names = (unsigned("type", 1, (1, 1, 6)), unsigned("valid", 1, (1, 7, 2)), unsigned("week", 1, (1, 97, 12)))
    layout = Layout(1, inav.WORD_BITS, (*names, unsigned("tow", 1, (1, 109, 20))))
    week, tow_s = to_week(SENT_NS)
    time = layout.write({"type": 0, "valid": 0b10, "week": week - inav.FIRST_WEEK, "tow": tow_s})
    utc = layout.write({"type": 6, "valid": 0, "week": 0, "tow": 0})
    return [*pages, inav.page(*utc), inav.page(*time), *pages]


def test_rtklib_reads_what_we_encode(tmp_path: Path) -> None:
    """Also the only judge of D2: no recording here has a geostationary BeiDou satellite's."""
    sent = [*SOME.values(), typical("C59", "D2", e=0.0001), typical("C30", "D1", omega=-1.0), GLONASS]
    pieces = [(eph.satellite, words) for eph in sent if eph.satellite != "E12" for words in pieces_of(eph)]
    pieces += [("E12", words) for words in with_time(pieces_of(SOME["INAV"]))]
    recording = tmp_path / "sent.ubx"
    recording.write_bytes(b"".join(as_ubx(pieces)))
    ours, theirs = issues(f"ubx:{recording}"), issues(f"rinex:{converted(recording, tmp_path)}")
    assert {eph.satellite for eph in sent} == {satellite for satellite, _ in ours}
    assert ours.keys() == theirs.keys()
    for key, eph in ours.items():
        assert_equal_to_the_printed_digits(eph, theirs[key])
