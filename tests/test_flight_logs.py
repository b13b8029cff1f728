"""Logs of autopilots as sources: PX4 (ULog), ArduPilot (DataFlash), and images beside a telemetry log."""

from __future__ import annotations

import io
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_samples import FORMATS, UTC_S, write_log, write_ulog
from PIL import Image
from pymavlink import DFReader, mavutil
from pyulog import ULog

from air.gnss.gnss_time import from_week
from air.sources import ulog
from air.sources.cuav import time_of
from air.sources.dataflash import LogScanner
from air.sources.imported import Faults
from air.sources.source import open_source
from common import ned
from common.counts import Counts
from common.errors import SourceError
from common.measurements import CameraFrame, FixKind, ImuSample, ReceiverSolution, VehicleState
from common.se3 import quaternion_to_matrix

# Frames


def test_an_airframe_that_looks_east_and_up_is_turned_into_our_frames() -> None:
    R = quaternion_to_matrix(ned.attitude_of_angles(0.0, math.radians(30), math.radians(90)))
    np.testing.assert_allclose(R[:, 0], [math.cos(math.radians(30)), 0.0, 0.5], atol=1e-12)  # forward
    np.testing.assert_allclose(R[:, 1], [0.0, 1.0, 0.0], atol=1e-12)  # left is north
    rolled = quaternion_to_matrix(ned.attitude_of_angles(math.radians(10), 0.0, 0.0))
    assert rolled[2, 1] == pytest.approx(math.sin(math.radians(10)))  # rolling right lifts the left
    np.testing.assert_array_equal(ned.enu([1.0, 2.0, 3.0]), [2.0, 1.0, -3.0])
    np.testing.assert_array_equal(ned.flu([[1.0, 2.0, 3.0]]), [[1.0, -2.0, -3.0]])


@pytest.mark.parametrize("q", [[0.0] * 4, [math.nan, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]])
def test_what_is_no_attitude_is_none(q: list[float]) -> None:
    assert ned.attitude(q) is None


# DataFlash


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "flight.bin"
    path.write_bytes(write_log())
    return path


def of(items, kind: type) -> list:
    return [item for item in items if isinstance(item, kind)]


def test_an_ardupilot_log_gives_imu_gps_and_states_on_gnss_time(log: Path) -> None:
    source = open_source(f"ardupilot:{log}")
    items = list(source)
    assert source.problems == ()
    assert [len(of(items, kind)) for kind in (ImuSample, ReceiverSolution, VehicleState)] == [200, 10, 20]
    stamps = [item.t_ns for item in items]
    assert stamps == sorted(stamps)
    sample, fix, state = (of(items, kind)[0] for kind in (ImuSample, ReceiverSolution, VehicleState))
    # What was logged at 1.0 s after boot belongs, by its GPS, to 215 999.9 s of the week.
    assert sample.t_ns == fix.t_ns == from_week(2122, 215_999.9)
    np.testing.assert_allclose([sample.accel, sample.gyro], [[1, -2, 9.81], [0.1, -0.2, -0.3]], rtol=1e-6)
    assert (fix.kind, fix.satellites) == (FixKind.FIX_3D, 17)
    assert (fix.latitude_deg, fix.longitude_deg, fix.height) == pytest.approx((47.5, 8.5, 547.0))
    assert fix.sigma_horizontal == pytest.approx(0.4)
    assert fix.sigma_vertical > 10  # above the sea, not above the ellipsoid
    np.testing.assert_allclose(fix.v_enu, [5.0, 0.0, 1.0], atol=1e-6)
    R = quaternion_to_matrix(state.q_enu_body)
    np.testing.assert_allclose(R[:, 0], [math.sqrt(0.75), 0.0, 0.5], atol=1e-6)  # east, 30° up
    assert (state.armed, state.text, state.height_home) == (True, "Plane V4.5", 40.0)
    assert (state.voltage_v, state.battery) == pytest.approx((15.2, 0.65))


def test_messages_equal_those_of_pymavlinks_reader(log: Path) -> None:
    wanted = frozenset(FORMATS)
    mine = list(LogScanner(wanted, Counts()).feed(log.read_bytes()))
    reader = DFReader.DFReader_binary(str(log))
    theirs = []
    while (m := reader.recv_msg()) is not None:
        if m.get_type() in wanted:
            theirs.append(m)
    assert [m.name for m in mine] == [m.get_type() for m in theirs]
    for a, b in zip(mine, theirs, strict=True):
        for column, value in a.values.items():
            expected = getattr(b, column)
            if isinstance(value, bytes):
                assert value.rstrip(b"\0").decode() == expected
            else:
                assert value == pytest.approx(expected, rel=1e-12)


def test_a_log_without_gps_counts_from_the_start_and_says_so(tmp_path: Path) -> None:
    (tmp_path / "f.bin").write_bytes(write_log(gps=False))
    source = open_source(f"ardupilot:{tmp_path / 'f.bin'}")
    assert of(source, ImuSample)[0].t_ns == 1_000_000_000
    assert any("no GNSS time" in problem.text for problem in source.problems)


WHOLE = write_log()


@given(st.data())
def test_damage_costs_the_messages_that_it_hits(data: st.DataObject) -> None:
    begin = data.draw(st.integers(2000, len(WHOLE) - 200))
    junk = data.draw(st.binary(min_size=1, max_size=80))
    damaged = WHOLE[:begin] + junk + WHOLE[begin + len(junk) :]
    step = data.draw(st.integers(1, 9999))
    counts = Counts()
    scanner = LogScanner(frozenset(("IMU",)), counts)
    got = [m for at in range(0, len(damaged), step) for m in scanner.feed(damaged[at : at + step])]
    scanner.close()
    assert counts.received_bytes == len(damaged)
    # A length of at most 89 bytes may swallow the beginning of two messages behind the junk.
    assert 400 - 8 <= len(got) <= 400 + 2
    assert counts.dropped_bytes <= 80 + 4 * 92


@given(st.binary(max_size=3000), st.integers(1, 500))
def test_any_bytes_are_accounted_for(data: bytes, step: int) -> None:
    for given_bytes in (data, WHOLE[:900] + data):
        counts = Counts()
        scanner = LogScanner(frozenset(FORMATS), counts)
        for at in range(0, len(given_bytes), step):
            list(scanner.feed(given_bytes[at : at + step]))
        scanner.close()
        assert counts.received_bytes == len(given_bytes)
        assert 0 <= counts.dropped_bytes <= len(given_bytes)


def test_damaged_logs_are_read_and_say_what_is_lost(tmp_path: Path) -> None:
    (tmp_path / "f.bin").write_bytes(WHOLE[:9000] + b"\0" * 777 + WHOLE[9000:-5])
    source = open_source(f"ardupilot:{tmp_path / 'f.bin'}")
    assert len(of(source, ImuSample)) >= 198
    (problem,) = source.problems
    assert "are no messages" in problem.text


# ULog


def test_a_px4_log_is_put_on_gnss_time(tmp_path: Path) -> None:
    (tmp_path / "f.ulg").write_bytes(write_ulog())
    source = open_source(f"ulog:{tmp_path / 'f.ulg'}")
    items = list(source)
    assert source.problems == ()
    assert [len(of(items, kind)) for kind in (ImuSample, ReceiverSolution, VehicleState)] == [200, 10, 100]
    stamps = [item.t_ns for item in items]
    assert stamps == sorted(stamps)
    assert stamps[0] == (UTC_S + 18 - 1) * 10**9
    sample, fix, state = (of(items, kind)[0] for kind in (ImuSample, ReceiverSolution, VehicleState))
    np.testing.assert_allclose([sample.accel, sample.gyro], [[1, -2, 9.81], [0.1, -0.2, -0.3]], rtol=1e-6)
    assert (fix.kind, fix.latitude_deg, fix.height) == (FixKind.FIX_3D, 47.5, 547.0)
    np.testing.assert_allclose(quaternion_to_matrix(state.q_enu_body)[:, 0], [0.0, 1.0, 0.0], atol=1e-12)  # north


def test_the_px4_log_equals_what_pyulog_reads(real_data: Callable[[str], Path]) -> None:
    path = real_data("telemetry/sample.ulg")
    source = open_source(f"ulog:{path}")
    items = list(source)
    table = ULog(str(path), ["sensor_combined"]).get_dataset("sensor_combined").data
    imu = of(items, ImuSample)
    assert len(imu) == len(table["timestamp"]) == 17_070
    assert [sample.t_ns for sample in imu[:3]] == [int(t) * 1000 for t in table["timestamp"][:3]]
    np.testing.assert_allclose([sample.accel[2] for sample in imu], -table["accelerometer_m_s2[2]"])
    np.testing.assert_allclose([sample.gyro[0] for sample in imu], table["gyro_rad[0]"])
    # On the ground and level within a few degrees, so the body's up is up.
    states = of(items, VehicleState)
    assert len(states) == 6461
    assert np.mean([sample.accel[2] for sample in imu]) == pytest.approx(9.7, abs=0.3)
    assert quaternion_to_matrix(states[0].q_enu_body)[2, 2] > 0.97
    assert any("no GNSS time" in problem.text for problem in source.problems)


def table(**columns: Any) -> dict[str, np.ndarray]:
    return {name: np.asarray(values) for name, values in columns.items()}


OLD = table(timestamp=[10**6, 2 * 10**6], time_utc_usec=[0, 1_600_000_000_000_000], lat=[0, 475_000_000])
OLD |= table(lon=[0, 85_000_000], alt_ellipsoid=[0, 547_000], fix_type=[0, 3], satellites_used=[0, 14], eph=[9.0, 0.5])
NEW = table(timestamp=[2 * 10**6], time_utc_usec=[1_600_000_000_000_000], latitude_deg=[47.5], longitude_deg=[8.5])
NEW |= table(altitude_ellipsoid_m=[547.0], fix_type=[6], satellites_used=[14], eph=[0.5], vel_n_m_s=[1.0])
NEW |= table(vel_e_m_s=[2.0], vel_d_m_s=[3.0])


@pytest.mark.parametrize(("gps", "kind"), [(OLD, FixKind.FIX_3D), (NEW, FixKind.RTK_FIXED)])
def test_both_versions_of_px4s_gps_message_are_read(gps: dict[str, np.ndarray], kind: FixKind) -> None:
    boot_ns = ulog.boot_time(gps)
    last = list(ulog.solutions(gps, boot_ns))[-1]
    assert last.t_ns == 1_600_000_018 * 10**9
    assert (last.kind, last.satellites, last.sigma_horizontal) == (kind, 14, 0.5)
    assert (last.latitude_deg, last.longitude_deg, last.height) == pytest.approx((47.5, 8.5, 547.0))
    if gps is NEW:
        np.testing.assert_array_equal(last.v_enu, [2.0, 1.0, -3.0])


def test_a_damaged_px4_log_is_read_as_far_as_possible(real_data: Callable[[str], Path], tmp_path: Path) -> None:
    with real_data("telemetry/sample.ulg").open("rb") as file:
        whole = file.read(400_000)
    rng, read = np.random.default_rng(1), 0
    for trial in range(12):
        damaged = bytearray(whole[: int(rng.integers(20, len(whole)))] if trial % 2 else whole)
        for at in rng.integers(16, len(damaged), 0 if trial % 2 else 40):
            damaged[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "d.ulg").write_bytes(damaged)
        source = open_source(f"ulog:{tmp_path / 'd.ulg'}")
        read += bool(list(source))
        assert source.problems
        assert not any("\n" in problem.text for problem in source.problems)
    assert read > 3


def test_a_log_that_pyulog_gives_up_is_a_problem(tmp_path: Path) -> None:
    (tmp_path / "f.ulg").write_bytes(ULog.HEADER_BYTES + b"\1")
    faults = Faults()
    assert ulog.read_tables(tmp_path / "f.ulg", faults) == {}
    assert "cannot be read" in faults.problems()[0].text


# Images beside a telemetry log


def test_images_are_stamped_by_the_utc_in_their_names() -> None:
    second_ns = (1_533_430_844 + 18) * 10**9  # 2018-08-05 01:00:44 UTC
    assert time_of("2018080501004480Z.jpg") == second_ns + 800_000_000
    assert time_of("20180805010044Z.JPG") == second_ns
    assert [time_of(name) for name in ("IMG_0001.jpg", "2018130501004480Z.jpg", "2018080501004480Z.png")] == [None] * 3


def test_the_flight_over_canberra_is_read_whole(real_data: Callable[[str], Path]) -> None:
    folder = real_data("cuav/testimgs")
    source = open_source(f"cuav:{folder}")
    items = list(source)
    stamps = [item.t_ns for item in items]
    assert stamps == sorted(stamps)
    frames, imu, fixes = (of(items, kind) for kind in (CameraFrame, ImuSample, ReceiverSolution))
    assert (len(frames), frames[0].width, frames[0].height) == (18, 1640, 1232)
    reader, counted = mavutil.mavlink_connection(str(folder / "flight.tlog")), {}
    while (m := reader.recv_match(type=["RAW_IMU", "GPS_RAW_INT"])) is not None:
        counted.setdefault(m.get_type(), []).append(m)
    assert [len(imu), len(fixes)] == [len(counted[name]) for name in ("RAW_IMU", "GPS_RAW_INT")]
    assert imu[5].accel[2] == pytest.approx(-counted["RAW_IMU"][5].zacc * 9.80665e-3)
    assert fixes[5].latitude_deg == pytest.approx(counted["GPS_RAW_INT"][5].lat * 1e-7)
    assert len(of(items, VehicleState)) > 1000
    # The plane circles, pulling somewhat more than its weight.
    assert np.mean([sample.accel[2] for sample in imu]) == pytest.approx(10.3, abs=1.0)


def test_a_folder_needs_images_and_one_log(real_data: Callable[[str], Path], tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"0 images named by UTC and 0 \*\.tlog"):
        open_source(f"cuav:{tmp_path}")
    out = io.BytesIO()
    Image.new("RGB", (8, 6)).save(out, "JPEG")
    (tmp_path / "2018080501004480Z.jpg").write_bytes(out.getvalue())
    (tmp_path / "2018080501004580Z.jpg").write_bytes(b"no image")
    shutil.copy(real_data("cuav/testimgs/flight.tlog"), tmp_path / "a.tlog")
    source = open_source(f"cuav:{tmp_path}")
    assert [frame.index for frame in of(source, CameraFrame)] == [0]
    assert {problem.name for problem in source.problems} == {"2018080501004580Z.jpg"}
    (tmp_path / "b.tlog").write_bytes(b"")
    with pytest.raises(SourceError, match="2 \\*"):
        open_source(f"cuav:{tmp_path}")


@pytest.mark.parametrize(
    ("url", "named"), [("ulog:f", "no ULog"), ("ardupilot:f", "no DataFlash"), ("cuav:f", "a file")]
)
def test_another_file_is_refused_in_one_line(tmp_path: Path, url: str, named: str) -> None:
    (tmp_path / "f").write_bytes(b"something else")
    with pytest.raises(SourceError, match=named):
        open_source(url.replace(":f", f":{tmp_path / 'f'}"))
