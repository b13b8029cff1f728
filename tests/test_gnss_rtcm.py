"""A base station's RTCM: against RTKLIB and pyrtcm on the same bytes, and as it was measured; damage is counted."""

from __future__ import annotations

import io
import random
import shutil
import subprocess
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import pyubx2
from gnss_scene import BASE_ECEF
from hypothesis import given
from hypothesis import strategies as st
from rtcm_samples import measured, sent
from ubx_samples import epochs

from air.gnss.calendar import from_calendar, to_calendar
from air.gnss.gnss_time import DAY_NS, SECOND_NS, to_week
from air.gnss.msm import lock_ms, parse_msm
from air.gnss.msm_writer import MsmWriter
from air.gnss.signals import LIGHT, frequencies
from air.sensors.gnss_rtcm import RtcmReceiver
from air.sources.source import open_source
from common import rtcm
from common.measurements import GnssEpoch

SECONDS = 12.0
NEAR_NS = measured(SECONDS)[0].t_ns + DAY_NS
"""Known to a day."""
SENT = b"".join(frame for _, frame in sent(SECONDS))


def heard(data: bytes, step: int = 1 << 20) -> tuple[RtcmReceiver, list[GnssEpoch]]:
    driver = RtcmReceiver(near_ns=NEAR_NS)
    found = [m for at in range(0, len(data), step) for m in driver.feed(data[at : at + step], 0)]
    return driver, [m for m in found if isinstance(m, GnssEpoch)]


def rows_of(epoch: GnssEpoch) -> dict[tuple[str, str], int]:
    return {key: i for i, key in enumerate(zip(epoch.satellites, epoch.signals, strict=True))}


def test_a_base_is_heard_as_it_measured() -> None:
    """Steps of the message: 0.6 mm, 0.0007 cycles, 0.1 mm/s; lock within 1/32. Its time is rounded to milliseconds."""
    driver, found = heard(SENT, 97)
    told = measured(SECONDS)
    assert len(found) == len(told) == SECONDS
    assert driver.counts.dropped_bytes == driver.counts.refused == 0
    for ours, theirs in zip(found, told, strict=True):
        rows = rows_of(theirs)
        which = [rows[key] for key in rows_of(ours)]
        assert len(which) == len(rows)
        ahead_s = (theirs.t_ns - ours.t_ns) / SECOND_NS
        f = frequencies(ours.satellites, ours.signals, ours.channel)
        np.testing.assert_allclose(ours.pseudorange, theirs.pseudorange[which] - LIGHT * ahead_s, atol=6e-4)
        np.testing.assert_allclose(ours.doppler, theirs.doppler[which], atol=3e-4)
        np.testing.assert_allclose(ours.cn0, theirs.cn0[which], atol=0.04)
        np.testing.assert_allclose(ours.lock_s, theirs.lock_s[which], rtol=1 / 31, atol=2e-3)
        np.testing.assert_array_equal(ours.half_cycle, theirs.half_cycle[which])
        np.testing.assert_array_equal(ours.channel, theirs.channel[which])
        cycles = ours.carrier_phase - (theirs.carrier_phase[which] - f * ahead_s)
        np.testing.assert_array_equal(np.isnan(ours.carrier_phase), np.isnan(theirs.carrier_phase[which]))
        assert np.nanmax(np.abs(cycles - np.round(cycles))) < 7e-4
        assert ours.p_ecef is not None
        np.testing.assert_allclose(ours.p_ecef, BASE_ECEF, atol=1e-4)


def test_whole_cycles_stay_while_a_carrier_is_locked() -> None:
    _, found = heard(SENT)
    last: dict[tuple[str, str], tuple[float, float]] = {}
    for ours, theirs in zip(found, measured(SECONDS), strict=True):
        f = frequencies(ours.satellites, ours.signals, ours.channel)
        for key, i in rows_of(ours).items():
            k = rows_of(theirs)[key]
            ahead_s = (theirs.t_ns - ours.t_ns) / SECOND_NS
            cycles = round(ours.carrier_phase[i] - theirs.carrier_phase[k] + f[i] * ahead_s)
            before = last.get(key)
            if before is not None and theirs.lock_s[k] > before[1]:
                assert cycles == before[0]
            last[key] = cycles, float(theirs.lock_s[k])


@pytest.mark.parametrize("kind", [4, 5, 6, 7])
def test_rtklib_reads_the_same(tmp_path: Path, kind: int) -> None:
    """RINEX rounds to 1 mm, 0.001 cycles, 0.001 Hz. Messages without rates tell no channels of GLONASS either: RTKLIB
    remembers those of another message, ours are left out."""
    if shutil.which("convbin") is None:
        pytest.skip("RTKLIB's convbin is not installed (Debian: apt install rtklib)")
    writer, path, out = MsmWriter(kind=kind), tmp_path / "base.rtcm3", tmp_path / "base.obs"
    data = b"".join(rtcm.frame(message) for epoch in measured(SECONDS) for message in writer.messages(epoch))
    path.write_bytes(data)
    day = to_calendar(NEAR_NS)
    near = ["-tr", f"{day:%Y/%m/%d}", f"{day:%H:%M:%S}"]
    subprocess.run(["convbin", "-r", "rtcm3", *near, "-od", "-os", "-o", out, path], capture_output=True, check=True)
    theirs = {round(m.t_ns, -6): m for m in open_source(f"rinex:{out}") if isinstance(m, GnssEpoch)}
    _, found = heard(data)
    assert len(found) == len(theirs) == SECONDS
    for ours in found:
        told = theirs[ours.t_ns]
        rows = {key: i for key, i in rows_of(told).items() if kind in (5, 7) or key[0][0] != "R"}
        assert rows_of(ours).keys() == rows.keys()
        which = [rows[key] for key in rows_of(ours)]
        for name, step in (("pseudorange", 6e-4), ("carrier_phase", 6e-4), ("doppler", 7e-4), ("cn0", 0.07)):
            if name != "doppler" or kind in (5, 7):
                np.testing.assert_allclose(getattr(ours, name), getattr(told, name)[which], rtol=0, atol=step)


def test_pyrtcm_reads_the_same_fields() -> None:
    _, (first, *_) = heard(SENT)
    reader = pyubx2.UBXReader(io.BytesIO(SENT), protfilter=pyubx2.RTCM3_PROTOCOL)
    place, gps = (parsed for _, parsed in (reader.read() for _ in range(2)))
    assert (place.identity, gps.identity, gps.DF003) == ("1006", "1077", 1)
    assert first.p_ecef is not None
    np.testing.assert_allclose([place.DF025, place.DF026, place.DF027], first.p_ecef, atol=1e-6)
    assert round(to_week(first.t_ns)[1] * 1e3) == gps.DF004
    cells = [(getattr(gps, f"CELLPRN_{i:02d}"), getattr(gps, f"CELLSIG_{i:02d}")) for i in range(1, gps.NCell + 1)]
    assert cells == [(f"0{name[1:]}", signal) for name, signal in rows_of(first) if name[0] == "G"]


# Time


@given(st.integers(from_calendar(datetime(2015, 1, 1)) // 1_000_000, from_calendar(datetime(2040, 1, 1)) // 1_000_000))
def test_a_time_is_found_to_the_millisecond_in_every_system(t_ms: int) -> None:
    """Also around the ends of weeks and days; GLONASS days are those of Moscow, in UTC."""
    t_ns = t_ms * 1_000_000
    for message in MsmWriter().messages(replace(measured(1.0)[0], t_ns=t_ns)):
        for late_ns in (-3 * DAY_NS, 0, 3 * DAY_NS):
            part = parse_msm(message, t_ns + late_ns, "base")
            assert part is not None
            if part.satellites[0][0] != "R" or to_calendar(t_ns).year >= 2018:  # the near time tells the leap seconds
                assert part.t_ns == t_ns


def test_locks_grow_with_their_indicators() -> None:
    """Source: RTCM 10403.3, tables 3.5-74 and 3.5-75, whose first, some, and last rows these are."""
    assert lock_ms(np.array([0, 1, 2, 15]), 4).tolist() == [0, 32, 64, 524_288]
    told = [0, 63, 64, 95, 96, 127, 128, 703, 704]
    assert lock_ms(np.array(told), 10).tolist() == [0, 63, 64, 126, 128, 252, 256, 66_060_288, 67_108_864]
    assert np.all(np.diff(lock_ms(np.arange(705), 10)) > 0)


# What goes wrong


def test_before_the_time_is_known_there_are_no_epochs() -> None:
    driver = RtcmReceiver()
    assert driver.feed(SENT, 0) == []
    assert driver.counts.refused == 4 * SECONDS
    driver.near_ns = NEAR_NS
    assert driver.feed(b"".join(frame for _, frame in sent(SECONDS)[-4:]), 0)


def test_a_lost_message_costs_its_system_alone() -> None:
    frames = [frame for _, frame in sent(SECONDS)]
    last = [i for i, frame in enumerate(frames) if rtcm.message_number(frame) == 1127][4]
    _, found = heard(b"".join(frames[:last] + frames[last + 1 :]))
    assert len(found) == SECONDS
    assert {name[0] for name in found[4].satellites} == set("GRE")


def test_epochs_that_come_again_or_late_are_refused() -> None:
    driver, found = heard(SENT)
    assert driver.feed(SENT, 0) == []
    assert driver.counts.refused == 4 * len(found)


def test_another_station_is_refused_and_one_without_place_is_said() -> None:
    other = MsmWriter(station=2)
    data = b"".join(rtcm.frame(message) for epoch in measured(SECONDS) for message in other.messages(epoch))
    driver, found = heard(sent(SECONDS)[0][1] + data)
    assert not found
    assert driver.counts.refused == 4 * SECONDS
    driver, found = heard(data)
    assert len(found) == SECONDS
    assert found[0].p_ecef is None
    assert "1005" in driver.faults[0]


@given(epochs())
def test_any_epoch_is_read_as_it_was_written(epoch: GnssEpoch) -> None:
    """Whatever does not fit into a message becomes unknown, never something else."""
    for message in MsmWriter().messages(epoch) if len(epoch.satellites) <= 16 else []:
        part = parse_msm(message, epoch.t_ns, "base")
        assert part is not None
        rows = rows_of(epoch)
        assert set(rows_of(part)) <= set(rows)


@given(st.binary(max_size=300), st.integers(0, 2**32))
def test_any_bytes_are_read_and_counted(data: bytes, seed: int) -> None:
    rng = random.Random(seed)
    damaged = bytearray(SENT)
    for _ in range(30):
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
    begin = rng.randrange(len(damaged))
    driver, found = heard(data + bytes(damaged[begin:]) + data + SENT[:2000], rng.randrange(1, 3000))
    assert len(found) <= SECONDS
    assert driver.counts.dropped_bytes <= driver.counts.received_bytes


@given(st.sampled_from([1074, 1087, 1096, 1117, 1127, 1077, 1005, 1006]), st.binary(max_size=600))
def test_any_message_in_a_whole_frame_is_read_or_refused(number: int, body: bytes) -> None:
    payload = bytes([number >> 4, (number & 15) << 4]) + body
    heard(rtcm.frame(payload))


@given(st.floats(6.31e6, 6.49e6), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_a_place_is_read_to_a_tenth_of_a_millimetre(radius: float, lat: float, lon: float) -> None:
    p_ecef = radius * np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    told = rtcm.parse_place(rtcm.pack_place(7, p_ecef))
    assert told is not None
    np.testing.assert_allclose(told, p_ecef, atol=5.1e-5)


def test_a_station_that_does_not_know_its_place_tells_none() -> None:
    assert rtcm.parse_place(rtcm.pack_place(7, np.zeros(3))) is None
