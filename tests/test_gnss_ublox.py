"""The u-blox driver: frames among other bytes, raw measurements against pyubx2 and RTKLIB, settings, corrections."""

from __future__ import annotations

import io
import math
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyubx2
from hypothesis import given, settings
from hypothesis import strategies as st
from ubx_samples import EPOCH, FRAMES, STREAM, epochs, solutions

from air.gnss.gnss_time import GPS_EPOCH_NS, SECOND_NS, WEEK_NS
from air.sensors import ubx
from air.sensors.gnss_ublox import UbloxReceiver
from air.sensors.ublox_settings import Port
from air.sensors.ublox_settings import settings as receiver_settings
from air.sensors.ubx_messages import ACK_ACK, ACK_NAK, CFG_VALSET, NAV_PVT, RXM_RAWX, RXM_SFRBX, pack_sfrbx, parse_sfrbx
from air.sensors.ubx_pvt import pack_pvt, parse_pvt
from air.sensors.ubx_rawx import pack_rawx, parse_rawx
from air.sources.device_file import DeviceFile
from air.sources.source import open_source
from common import rtcm
from common.errors import SourceError
from common.measurements import FixKind, GnssEpoch, Measurement, ReceiverSolution

RECORDINGS = ("nhm.ubx", "16dBatt_no_interference_coldstart.ubx")
each_recording = pytest.mark.parametrize("name", RECORDINGS)


def assert_same(a: Any, b: Any) -> None:
    """Equal but for what decimal steps lose in binary."""
    for field in fields(a):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, np.ndarray | float):
            assert np.allclose(one, other, rtol=1e-14, atol=1e-12, equal_nan=True), field.name
        else:
            assert one == other, field.name


def fed(data: bytes, step: int = 1 << 20) -> tuple[UbloxReceiver, list[Measurement]]:
    driver = UbloxReceiver()
    return driver, [m for at in range(0, len(data), step) for m in driver.feed(data[at : at + step], 0)]


# Time


@given(st.integers(1, 90), st.integers(1, 4000), st.sampled_from([None, 460_800]))
def test_an_epoch_was_sent_when_its_first_byte_left(signals: int, step: int, baud: int | None) -> None:
    """Whatever the number of signals, for its solution too, and however a port's driver cuts the bytes."""
    rows = [i % len(EPOCH.satellites) for i in range(signals)]
    many = {f.name: v[rows] for f in fields(EPOCH) if isinstance(v := getattr(EPOCH, f.name), np.ndarray)}
    names = {key: tuple(getattr(EPOCH, key)[i] for i in rows) for key in ("satellites", "signals")}
    data = ubx.frame(RXM_RAWX, pack_rawx(replace(EPOCH, **many, **names))) + FRAMES[2]  # type: ignore[arg-type]
    driver, byte_ns, begun_ns = UbloxReceiver(baud=baud), 10e9 / (baud or 1e12), 7_000_000_000
    for at in range(0, len(data), step):
        piece = data[at : at + step]
        if driver.feed(piece, begun_ns + round((at + len(piece)) * byte_ns)):
            assert abs(driver.sent_ns - begun_ns) <= (1 if baud else 50_000)


# Payloads, both ways


@given(epochs())
def test_epochs_are_read_as_they_were_written(epoch: GnssEpoch) -> None:
    found = parse_rawx(pack_rawx(epoch), "gnss")
    assert found is not None
    assert_same(found, epoch)


@given(solutions, st.integers(0, 40))
def test_solutions_are_read_as_they_were_written(solution: ReceiverSolution, leap_s: int) -> None:
    found = parse_pvt(pack_pvt(solution, leap_s), "gnss")
    assert found is not None
    assert_same(found, solution)


@given(st.binary(max_size=200))
def test_payloads_of_any_bytes_are_read_or_refused(payload: bytes) -> None:
    parse_rawx(payload, "gnss")
    parse_pvt(payload, "gnss")
    bits = parse_sfrbx(payload)
    if bits is not None:
        again = parse_sfrbx(pack_sfrbx(bits))
        assert again is not None
        assert (again.satellite, again.signal, again.words) == (bits.satellite, bits.signal, bits.words)


def test_an_epoch_of_a_receiver_that_does_not_know_the_week_is_refused() -> None:
    nothing, t_ns = pack_rawx(EPOCH), GPS_EPOCH_NS + 18 * SECOND_NS
    assert parse_rawx(nothing, "gnss") is not None
    assert parse_rawx(pack_rawx(replace(EPOCH, t_ns=t_ns)), "gnss") is None


def test_what_has_no_name_is_left_out_of_an_epoch() -> None:
    payload = bytearray(pack_rawx(EPOCH))
    payload[16 + 21] = 255  # the first row's satellite
    found = parse_rawx(bytes(payload), "gnss")
    assert found is not None
    assert found.satellites == EPOCH.satellites[1:]
    assert np.array_equal(found.pseudorange, EPOCH.pseudorange[1:])


# Frames among other bytes


def test_every_frame_is_counted_by_its_name_and_none_dropped() -> None:
    driver, found = fed(STREAM)
    assert [type(m) for m in found] == [GnssEpoch, ReceiverSolution]
    counted = {"RXM-RAWX": 1, "NMEA": 1, "NAV-PVT": 1, "RTCM-1077": 1, "MON-VER": 1}
    assert dict(driver.counts.frames) == counted
    assert (driver.counts.received_bytes, driver.counts.dropped_bytes, driver.counts.refused) == (len(STREAM), 0, 0)


@given(st.integers(1, 40))
def test_the_size_of_the_pieces_does_not_matter(step: int) -> None:
    driver, found = fed(STREAM, step)
    assert len(found) == 2
    assert driver.counts == fed(STREAM)[0].counts


@given(st.lists(st.binary(max_size=60), min_size=len(FRAMES) + 1, max_size=len(FRAMES) + 1))
def test_frames_are_found_among_stray_bytes(gaps: list[bytes]) -> None:
    """A stray byte may look like the beginning of a frame, which costs time but no frame once more bytes come."""
    stream = b"".join(gap + frame for gap, frame in zip(gaps, [*FRAMES, b""], strict=True)) + bytes(9000)
    driver, found = fed(stream)
    assert [type(m) for m in found] == [GnssEpoch, ReceiverSolution]
    assert sum(driver.counts.frames.values()) >= len(FRAMES)
    assert driver.counts.dropped_bytes <= len(stream) - len(STREAM)


def test_unbroken_runs_of_dropped_bytes_are_bursts() -> None:
    driver, _ = fed(b"garbage" + FRAMES[0] + b"more" + b"\xb5\x62" + FRAMES[2] + bytes(9000))
    assert (driver.counts.bursts, driver.counts.dropped_bytes) == (3, 7 + 6 + 9000)


@given(st.data())
def test_a_flipped_bit_costs_the_frame_that_it_is_in_and_no_other(data: st.DataObject) -> None:
    at = data.draw(st.integers(0, 8 * len(FRAMES[0]) - 1))
    broken = bytearray(FRAMES[0])
    broken[at // 8] ^= 1 << at % 8
    _, found = fed(bytes(broken) + FRAMES[2] + bytes(9000))
    assert [type(m) for m in found] == [ReceiverSolution]


@settings(max_examples=30)
@given(st.binary(min_size=1, max_size=9))
def test_no_more_than_a_frame_is_held(unit: bytes) -> None:
    for beginning in (b"", b"\xb5\x62\x02\x15\xff\x1f", b"$GN", b"\xd3\x03\xff\x43\x50"):
        driver, _ = fed(beginning + unit * (30_000 // len(unit)), 1000)
        assert driver.counts.dropped_bytes >= 20_000


# Against other programs


def peers_messages(recording: Path, message: int) -> Iterator[Any]:
    for raw, _ in pyubx2.UBXReader(io.BytesIO(recording.read_bytes()), protfilter=pyubx2.UBX_PROTOCOL, parsing=False):
        if raw[2:4] == message.to_bytes(2, "big"):
            yield pyubx2.UBXReader.parse(raw)


@each_recording
def test_raw_measurements_equal_pyubx2s(real_data: Callable[[str], Path], name: str) -> None:
    recording = real_data("gnss") / name
    ours = [m for m in open_source(f"ubx:{recording}") if isinstance(m, GnssEpoch)]
    theirs = [m for m in peers_messages(recording, RXM_RAWX) if m.week]
    assert len(ours) == len(theirs) > 100
    for epoch, message in zip(ours, theirs, strict=True):
        assert epoch.t_ns == GPS_EPOCH_NS + message.week * WEEK_NS + round(message.rcvTow * 1e9)
        assert epoch.leap_s == (message.leapS if message.leapSec else None)
        assert epoch.clock_reset == bool(message.clkReset)
        column = {
            field: np.array([getattr(message, f"{field}_{i:02d}") for i in range(1, message.numMeas + 1)])
            for field in (
                *("prMes", "cpMes", "doMes", "gnssId", "svId", "sigId", "freqId", "locktime", "cno"),
                *("prStd", "cpStd", "doStd", "prValid", "cpValid", "halfCyc"),
            )
        }
        letters = np.array(list("GSEC?JR"))[column["gnssId"]]
        numbers = column["svId"] - np.where(letters == "S", 100, 0)
        assert epoch.satellites == tuple(f"{c}{n:02d}" for c, n in zip(letters, numbers, strict=True))
        assert np.array_equal(epoch.pseudorange, np.where(column["prValid"], column["prMes"], np.nan), equal_nan=True)
        assert np.array_equal(epoch.carrier_phase, np.where(column["cpValid"], column["cpMes"], np.nan), equal_nan=True)
        assert np.array_equal(epoch.doppler, column["doMes"])
        assert np.array_equal(epoch.cn0, column["cno"])
        assert np.allclose(epoch.lock_s, column["locktime"] / 1000, rtol=1e-15)
        assert np.array_equal(epoch.half_cycle, column["halfCyc"] == 0)
        assert np.allclose(epoch.sigma_pseudorange, 0.01 * 2.0 ** column["prStd"])
        phase_sigma = np.where(column["cpStd"] == 15, np.nan, 0.004 * column["cpStd"])
        assert np.allclose(epoch.sigma_carrier_phase, phase_sigma, equal_nan=True)
        assert np.allclose(epoch.sigma_doppler, 0.002 * 2.0 ** column["doStd"])
        assert np.array_equal(epoch.channel, np.where(letters == "R", column["freqId"] - 7, 0))


@each_recording
def test_solutions_equal_pyubx2s(real_data: Callable[[str], Path], name: str) -> None:
    recording = real_data("gnss") / name
    ours = [m for m in open_source(f"ubx:{recording}") if isinstance(m, ReceiverSolution)]
    theirs = [m for m in peers_messages(recording, NAV_PVT) if m.validDate and m.validTime]
    assert len(ours) == len(theirs) > 100
    for solution, message in zip(ours, theirs, strict=True):
        t_ms = (solution.t_ns - GPS_EPOCH_NS) % WEEK_NS / 1e6
        assert abs(t_ms - message.iTOW) < 0.51
        assert np.allclose(
            (solution.latitude_deg, solution.longitude_deg), (message.lat, message.lon), rtol=0, atol=1e-9
        )
        assert np.isclose(solution.height, message.height / 1000)
        assert np.allclose(solution.v_enu, np.array([message.velE, message.velN, -message.velD]) / 1000)
        assert np.isclose(solution.sigma_time, message.tAcc * 1e-9)
        assert solution.satellites == message.numSV
        assert (solution.kind is FixKind.NONE) == (not message.gnssFixOk)


@each_recording
def test_raw_measurements_equal_rtklibs_to_the_printed_digits(
    real_data: Callable[[str], Path], name: str, tmp_path: Path
) -> None:
    if shutil.which("convbin") is None:
        pytest.skip("RTKLIB's convbin is not installed")
    recording, out = real_data("gnss") / name, tmp_path / "rtklib.obs"
    command = ["convbin", "-r", "ubx", "-v", "3.04", "-od", "-os", "-o", str(out), str(recording)]
    subprocess.run(command, check=True, capture_output=True)
    theirs = {epoch.t_ns: epoch for epoch in epochs_of(f"rinex:{out}")}
    ours = {epoch.t_ns: epoch for epoch in epochs_of(f"ubx:{recording}") if epoch.satellites}
    assert ours.keys() == theirs.keys()
    compared = 0
    for t_ns, epoch in ours.items():
        rows, peer = table(epoch), table(theirs[t_ns])
        assert rows.keys() >= peer.keys()
        for key, values in peer.items():
            if math.isnan(values[0]):
                continue  # RTKLIB leaves out what its own checks refuse
            for mine, other, digit in zip(rows[key], values, (1e-3, 1e-3, 1e-3, 1e-3), strict=True):
                assert math.isnan(other) or abs(mine - other) <= 0.51 * digit, (key, mine, other)
                compared += not math.isnan(other)
    assert compared > 10_000


def epochs_of(url: str) -> Iterator[GnssEpoch]:
    return (m for m in open_source(url) if isinstance(m, GnssEpoch))


def table(epoch: GnssEpoch) -> dict[tuple[str, str], tuple[float, ...]]:
    columns = (epoch.pseudorange, epoch.carrier_phase, epoch.doppler, epoch.cn0)
    keys = zip(epoch.satellites, epoch.signals, strict=True)
    return dict(zip(keys, zip(*(column.tolist() for column in columns), strict=True), strict=True))


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_whole_recording_is_read_without_dropping_a_byte(real_data: Callable[[str], Path], name: str) -> None:
    source = open_source(f"ubx:{real_data('gnss') / name}")
    assert isinstance(source, DeviceFile)
    assert sum(1 for _ in source) > 200
    assert source.counts.dropped_bytes == 0


# Settings and corrections


def test_the_receiver_is_told_what_to_send_and_its_answer_noticed() -> None:
    driver = UbloxReceiver(port=Port.UART1, rate_hz=10)
    message = pyubx2.UBXReader.parse(driver.start(), msgmode=pyubx2.SET)
    assert message.identity == "CFG-VALSET"
    assert len(receiver_settings(Port.UART1, 10)) <= 64  # the most that one message may hold
    for key, value in (("CFG_RATE_MEAS", 100), ("CFG_MSGOUT_UBX_RXM_RAWX_UART1", 1), ("CFG_UART1OUTPROT_NMEA", 0)):
        assert (key, value) in receiver_settings(Port.UART1, 10)
        identity, _ = pyubx2.cfgname2key(key)
        assert identity.to_bytes(4, "little") in driver.start()
    assert driver.configured is None
    driver.feed(ubx.frame(ACK_NAK, b"\x06\x01"), 0)
    assert driver.configured is None, "the answer to somebody else's message"
    driver.feed(ubx.frame(ACK_NAK, CFG_VALSET.to_bytes(2, "big")), 0)
    assert driver.configured is False
    assert driver.faults
    driver.feed(ubx.frame(ACK_ACK, CFG_VALSET.to_bytes(2, "big")), 0)
    assert driver.configured is True
    assert not driver.faults


@pytest.mark.parametrize("port", Port)
def test_every_setting_is_one_that_the_receiver_knows(port: Port) -> None:
    for key, _ in receiver_settings(port, 10):
        identity, _ = pyubx2.cfgname2key(key)
        assert pyubx2.cfgkey2name(identity)[0] == key


@given(st.lists(st.binary(min_size=2, max_size=300), min_size=1, max_size=4), st.integers(1, 50))
def test_corrections_pass_whole_and_nothing_else_does(bodies: list[bytes], step: int) -> None:
    frames = [rtcm.frame(bytes((0x43, 0x50)) + body) for body in bodies]
    stream = b"noise".join([b"", *frames, b"\xd3\x00\x04\x43\x50\x00\x00wrong" + bytes(20)])
    passing = rtcm.RtcmFilter()
    out = [frame for at in range(0, len(stream), step) for frame in passing.feed(stream[at : at + step])]
    assert out == frames
    assert passing.counts.dropped_bytes == len(stream) - sum(map(len, frames))
    assert passing.counts.frames["RTCM-1077"] == len(frames)


def test_the_checks_of_frames_equal_those_of_other_programs() -> None:
    data = bytes(range(256)) * 4
    assert ubx.checksum(data) == pyubx2.calc_checksum(data)
    assert (
        ubx.frame(NAV_PVT, data[:92]) == pyubx2.UBXMessage("NAV", "NAV-PVT", pyubx2.GET, payload=data[:92]).serialize()
    )
    corrections = rtcm.frame(bytes((0x3E, 0xD0)) + data[:19])
    (raw, _), *_ = pyubx2.UBXReader(io.BytesIO(corrections), protfilter=pyubx2.RTCM3_PROTOCOL, quitonerror=2)
    assert raw == corrections


# The file as a source


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"nothing\.ubx' cannot be read: No such file"):
        open_source(f"ubx:{tmp_path / 'nothing.ubx'}")


def test_what_was_dropped_is_a_problem_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "rover.ubx"
    file.write_bytes(b"noise" + STREAM + ubx.frame(RXM_SFRBX, b"short") + b"!")
    source = open_source(f"ubx:{file}")
    for _ in range(2):  # each iteration plays it anew
        assert len(list(source)) == 2
        assert [problem.text for problem in source.problems] == [
            f"bytes of no frame: 6 of {file.stat().st_size}, bursts: 2",
            "frames that made no sense, or had no time yet: 1",
        ]
