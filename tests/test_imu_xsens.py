"""The MTi driver: real recording against a second reading of it, every output and precision, damage, time, set-up."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from air.sensors.driver import TimeScale
from air.sensors.imu_xsens import TICK_NS, XsensImu
from air.sensors.mtdata2 import NED, NWU, DataId, Precision, pack, unpack
from air.sensors.xbus import MessageId, frame
from air.sources.source import open_source
from common.errors import SourceError
from common.measurements import ImuSample
from common.se3 import quaternion_to_matrix, rotation_vector, rotation_vector_to_matrix

RECORDING = "xsens/20260503_204234_xsensmti_with_gnss_recording.bin"


def samples_of(data: bytes, chunk: int = 256, driver: XsensImu | None = None) -> list[ImuSample]:
    driver = driver or XsensImu()
    samples = [s for at in range(0, len(data), chunk) for s in driver.feed(data[at : at + chunk], 0)]
    assert all(isinstance(s, ImuSample) for s in samples)
    return samples  # type: ignore[return-value]


def message(counter: int, ticks: int, **more: tuple[float, ...]) -> bytes:
    packets = {
        DataId.PACKET_COUNTER: (counter % 2**16,),
        DataId.SAMPLE_TIME_FINE: (ticks % 2**32,),
        DataId.ACCELERATION: (0.1, -0.2, 9.8),
        DataId.RATE_OF_TURN: (0.01, 0.02, -0.03),
    }
    packets |= {DataId[name]: values for name, values in more.items()}
    return frame(MessageId.MT_DATA2, pack(packets))


# The real recording


@pytest.fixture
def recording(real_data: Callable[[str], Path]) -> bytes:
    return real_data(RECORDING).read_bytes()


def test_every_sample_of_the_recording_equals_a_second_reading(recording: bytes) -> None:
    layout = np.dtype(
        [("", ">u1", 3), ("counter", ">u2"), ("", ">u1", 3), ("ticks", ">u4"), ("", ">u1", 3), ("q", ">f4", 4)]
        + [("", ">u1", 3), ("accel", ">f4", 3), ("", ">u1", 3), ("gyro", ">f4", 3), ("", ">u1", 3), ("status", ">u4")]
    )
    found = re.findall(rb"\xfa\xff\x36\x44(\x10\x20.{66})", recording, re.DOTALL)
    rows = np.frombuffer(b"".join(found), layout)
    samples = samples_of(recording)
    assert len(samples) == len(rows) == 4746
    np.testing.assert_array_equal([s.accel for s in samples], rows["accel"])
    np.testing.assert_array_equal([s.gyro for s in samples], rows["gyro"])
    half_ns = int(np.diff(rows["ticks"]).min()) * TICK_NS // 2
    stamps = rows["ticks"].astype(np.int64) * TICK_NS - half_ns  # a sample is the mean over the period before it
    np.testing.assert_array_equal([s.t_ns for s in samples][1:], stamps[1:])
    q = np.array([s.q_enu_body for s in samples])
    np.testing.assert_allclose(np.abs(np.sum(q * rows["q"], axis=1)), 1.0, atol=1e-6)  # float32, then normalised
    assert not any(s.saturated for s in samples)


def test_the_recording_is_read_without_loss_whatever_the_pieces(recording: bytes) -> None:
    driver = XsensImu()
    samples = samples_of(recording, 1 << 20, driver)
    assert driver.counts.frames == {"MTData2": 4746, "MTData2 GnssPvtData": 190}
    assert (driver.counts.dropped_bytes, driver.counts.bursts, driver.counts.refused) == (22, 1, 0)
    assert driver.counts.missing == 0
    assert [s.t_ns for s in samples_of(recording, 7)] == [s.t_ns for s in samples]


def test_gyroscope_and_accelerometer_of_the_recording_agree_with_its_own_attitude(recording: bytes) -> None:
    samples = samples_of(recording)
    attitudes = [quaternion_to_matrix(s.q_enu_body) for s in samples if s.q_enu_body is not None]
    turned, believed = [], []
    for first in range(0, len(samples) - 20, 20):
        R = np.eye(3)
        for s in samples[first + 1 : first + 21]:
            R = R @ rotation_vector_to_matrix(s.gyro * 0.01)
        turned.append(rotation_vector(R))
        believed.append(rotation_vector(attitudes[first].T @ attitudes[first + 20]))
    bias = (np.array(turned) - believed).mean(axis=0) / 0.2
    assert np.degrees(np.abs(bias)).max() < 0.5  # of the gyroscope, which the attitude filter takes off
    for axis in range(3):
        assert np.corrcoef(np.array(turned)[:, axis], np.array(believed)[:, axis])[0, 1] > 0.999
    up = np.mean([R @ s.accel for R, s in zip(attitudes, samples, strict=True)], axis=0)
    assert up[2] == pytest.approx(9.8, abs=0.25)  # this device reads 2 % too little
    assert np.hypot(up[0], up[1]) < 0.7  # 4°: real motion, and an accelerometer with an offset


def test_a_file_is_a_source_that_tells_what_was_wrong(tmp_path: Path) -> None:
    file = tmp_path / "imu.bin"
    file.write_bytes(b"junk" + b"".join(message(i, 50 * i) for i in (0, 1, 2, 5)) + b"\xfa\xff")
    source = open_source(f"xbus:{file}")
    assert len(list(source)) == len(list(source)) == 4
    dropped, missing = (problem.text for problem in source.problems)
    assert dropped.startswith("bytes of no frame: 4 of ")
    assert missing == "frames that the device numbered and that never came: 2"
    with pytest.raises(SourceError, match=r"mission\.bin"):
        open_source(f"xbus:{tmp_path / 'mission.bin'}")


# Values


@pytest.mark.parametrize("precision", Precision)
@given(values=st.tuples(*[st.floats(-2047, 2047)] * 3))
def test_what_is_packed_is_read_again(precision: Precision, values: tuple[float, ...]) -> None:
    packets = {DataId.ACCELERATION: values, DataId.MAGNETIC_FIELD: values, DataId.STATUS_WORD: (0x80001,)}
    unpacked = unpack(pack(packets, precision))
    assert unpacked is not None
    assert unpacked[0][DataId.STATUS_WORD] == (0x80001,)
    step = {Precision.FLOAT32: 2**-13, Precision.FP12_20: 2**-21, Precision.FP16_32: 2**-33, Precision.FLOAT64: 0}
    np.testing.assert_allclose(unpacked[0][DataId.MAGNETIC_FIELD], values, rtol=0, atol=step[precision])


def test_the_manuals_fixed_point_puts_the_fraction_first() -> None:
    """1.5 as FP16.32 is 80000000 0001, −1.25 as FP12.20 is FFEC0000."""
    payload = bytes.fromhex("4022 12 800000000001 000000000000 400000000000".replace(" ", ""))
    assert unpack(payload) == ({DataId.ACCELERATION: (1.5, 0.0, 0.25)}, [])
    payload = bytes.fromhex("4021 0c ffec0000 00100000 00000000".replace(" ", ""))
    assert unpack(payload) == ({DataId.ACCELERATION: (-1.25, 1.0, 0.0)}, [])


@pytest.mark.parametrize(
    ("system", "nose"),
    [(0, np.array([1.0, 0.0, 0.0])), (NED, np.array([0.0, 1.0, 0.0])), (NWU, np.array([0.0, 1.0, 0.0]))],
)
def test_attitude_comes_in_enu_from_every_reference_system(system: int, nose: np.ndarray) -> None:
    """With the identity of a system, the device's x axis lies along the system's first axis: east or north."""
    packets = {DataId.SAMPLE_TIME_FINE: (1,), DataId.ACCELERATION: (0, 0, 9.8), DataId.RATE_OF_TURN: (0, 0, 0)}
    packets[DataId.QUATERNION | system] = (-1.0, 0.0, 0.0, 0.0)  # type: ignore[index]
    (sample,) = samples_of(frame(MessageId.MT_DATA2, pack(packets)))
    assert sample.q_enu_body is not None
    assert sample.q_enu_body[0] >= 0
    R_enu_body = quaternion_to_matrix(sample.q_enu_body)
    np.testing.assert_allclose(R_enu_body[:, 0], nose, atol=1e-12)
    np.testing.assert_allclose(R_enu_body[2, 2], -1.0 if system == NED else 1.0, atol=1e-12)


def test_status_magnetic_field_and_temperature_come_with_the_sample() -> None:
    data = message(0, 0, TEMPERATURE=(31.5,), MAGNETIC_FIELD=(0.5, 0.0, -0.25), STATUS_WORD=(1 | 1 << 11,))
    data += message(1, 50, STATUS_WORD=(1,)) + message(2, 100, STATUS_WORD=(0,))
    driver = XsensImu()
    first, second, _ = samples_of(data, driver=driver)
    assert first.magnetic is not None
    assert first.magnetic.tolist() == [0.5, 0.0, -0.25]
    assert (first.saturated, second.saturated) == (True, False)
    assert first.temperature_c == second.temperature_c == 31.5
    assert driver.faults == ("the self test at power-up failed",)


def test_increments_serve_where_rates_are_absent() -> None:
    """A turn of 0.004 rad about z and 0.049 m/s upwards in each 5 ms; one message is lost on the way."""
    half = 0.002
    increments = {DataId.DELTA_V: (0.0, 0.0, 0.049), DataId.DELTA_Q: (-np.cos(half), 0.0, 0.0, -np.sin(half))}
    data = b"".join(
        frame(MessageId.MT_DATA2, pack({DataId.SAMPLE_TIME_FINE: (50 * i,)} | increments, Precision.FLOAT64))
        for i in (0, 1, 2, 4)
    )
    samples = samples_of(data)
    assert [s.t_ns for s in samples] == [2_500_000, 7_500_000, 17_500_000]  # the middle of each period
    for s in samples:
        np.testing.assert_allclose(s.accel, [0, 0, 9.8], atol=1e-12)
        np.testing.assert_allclose(s.gyro, [0, 0, 0.8], atol=1e-12)


# Time


def test_stamps_run_on_over_a_wrap_of_the_counter_and_missing_messages_are_counted() -> None:
    driver = XsensImu()
    start, counters = 2**32 - 120, [65534, 65535, 0, 3, 4]
    data = b"".join(message(c, start + 50 * ((c + 2) % 2**16)) for c in counters)
    stamps = [s.t_ns // TICK_NS - start for s in samples_of(data, driver=driver)]
    assert stamps == [-25, 25, 75, 225, 275]  # the middle of each period
    assert driver.counts.missing == 2
    assert driver.scale is TimeScale.DEVICE


def test_coarse_seconds_and_fine_ticks_make_one_time() -> None:
    data = b"".join(message(i, 4_009_950 + 50 * i, SAMPLE_TIME_COARSE=(700 + i,)) for i in (0, 1))
    first, second = samples_of(data)
    assert first.t_ns == 700_992_500_000
    assert second.t_ns == 700_997_500_000


def test_a_sample_without_time_or_with_nonsense_is_refused() -> None:
    timeless = {DataId.ACCELERATION: (0.0, 0.0, 9.8), DataId.RATE_OF_TURN: (0.0, 0.0, 0.0)}
    nonsense = timeless | {DataId.SAMPLE_TIME_FINE: (1,), DataId.ACCELERATION: (float("nan"), 0.0, 0.0)}
    ragged = pack(timeless)[:-1]
    driver = XsensImu()
    data = b"".join(frame(MessageId.MT_DATA2, p) for p in (pack(timeless), pack(nonsense), ragged))
    assert samples_of(data, driver=driver) == []
    assert driver.counts.refused == 3


# Damage


@given(st.lists(st.tuples(st.binary(max_size=40), st.booleans()), max_size=12), st.integers(1, 300))
def test_whole_frames_survive_stray_bytes_between_them(parts: list[tuple[bytes, bool]], chunk: int) -> None:
    """Stray bytes hold no preamble here: one may swallow the frame behind it."""
    data, sent, stray = b"", 0, 0
    for noise, whole in parts:
        noise = noise.replace(b"\xfa", b"")
        data, stray = data + noise, stray + len(noise)
        if whole:
            data, sent = data + message(sent, 50 * sent), sent + 1
    driver = XsensImu()
    assert len(samples_of(data, chunk, driver)) == sent
    assert driver.counts.missing == driver.counts.refused == 0
    assert driver.counts.dropped_bytes == stray


def test_a_false_header_costs_no_frame_that_follows_it() -> None:
    for false in (b"\xfa", b"\xfa\xff", b"\xfa\xff\x36\x20", b"\xfa\xff\x36\xff\x07\xff", b"\xfa\xff\x36\xff\xff\xff"):
        data = false + b"".join(message(i, 50 * i) for i in range(60))
        driver = XsensImu()
        assert len(samples_of(data, driver=driver)) == 60, false
        assert driver.counts.dropped_bytes == len(false)
        assert driver.counts.bursts == 1


def test_a_checksum_that_looks_like_a_preamble_is_no_damage() -> None:
    whole = next(f for f in (frame(0x99, bytes([i])) for i in range(256)) if f[-1] == 0xFA)
    driver = XsensImu()
    driver.feed(whole, 0)
    driver.feed(whole, 0)
    assert driver.counts.frames == {"0x99": 2}
    assert driver.counts.dropped_bytes == driver.counts.bursts == 0


@given(st.binary(max_size=3000), st.integers(1, 500))
def test_any_bytes_are_accounted_for(data: bytes, chunk: int) -> None:
    driver = XsensImu()
    samples_of(data, chunk, driver)
    assert driver.counts.received_bytes == len(data)
    assert driver.counts.dropped_bytes <= len(data)


def test_long_frames_have_an_extended_length() -> None:
    for size in (254, 255, 256, 2048):
        driver = XsensImu()
        driver.feed(frame(0x99, bytes(size)), 0)
        assert driver.counts.frames == {"0x99": 1}
        assert driver.counts.dropped_bytes == 0


# Set-up


def test_the_commands_at_start_are_the_manuals_bytes() -> None:
    """GoToConfig and GoToMeasurement as the manual prints them; the outputs as identifier and rate between them."""
    start = XsensImu().start()
    assert start.startswith(bytes.fromhex("faff3000d1"))
    assert start.endswith(bytes.fromhex("faff1000f1"))
    outputs = start[5 + 4 : -5 - 1]
    rates = dict(struct.iter_unpack(">HH", outputs))
    assert rates[0x4020] == rates[0x8020] == rates[0x2010] == 200
    assert rates[0x1020] == rates[0x1060] == rates[0xE020] == 0xFFFF


def test_answers_of_the_device_are_noticed() -> None:
    driver = XsensImu()
    outputs = driver.start()[9:-6]
    answers = frame(MessageId.GO_TO_CONFIG_ACK) + frame(MessageId.SET_OUTPUT_CONFIGURATION_ACK, outputs)
    driver.feed(answers + frame(MessageId.GO_TO_MEASUREMENT_ACK), 0)
    assert driver.counts.frames["SET_OUTPUT_CONFIGURATION_ACK"] == driver.counts.frames["GO_TO_MEASUREMENT_ACK"] == 1
    assert driver.faults == ()
    driver.feed(frame(MessageId.SET_OUTPUT_CONFIGURATION_ACK, outputs.replace(b"\x00\xc8", b"\x00\x64")), 0)
    driver.feed(frame(MessageId.ERROR, b"\x21"), 0)
    assert driver.faults == (
        "the device refuses a command: parameter (33)",
        "the device cannot give acceleration and rate of turn at 200 Hz",
    )
