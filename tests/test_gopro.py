"""GPMF, and GoPro videos as a source."""

from __future__ import annotations

import functools
import itertools
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import gpmf_samples as gpmf
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from air.sources import gopro_karma, gopro_telemetry
from air.sources.gopro import read_telemetry
from air.sources.gopro_telemetry import Payload, Telemetry, sample_times
from air.sources.gpmf import Damage, Series, read_series
from air.sources.imported import Faults
from air.sources.source import open_source
from common.clock import GPST_MINUS_UTC_NS
from common.errors import SourceError
from common.measurements import CameraFrame, Encoding, FixKind, ImuSample, ReceiverSolution, VehicleState
from common.se3 import quaternion_to_matrix

KARMA = "karma/karma.mp4"
IMU_EARLY_NS = 18_000_000
"""By how much the IMU's stamps lie before those of the frames: found where the flow follows the gyro best."""
UTC_NS = 1_492_457_277 * 10**9
"""Start of the Karma's video by its own time messages, to a second: 2017-04-17 19:27:57 UTC."""

# GPMF

NUMBERS = {"b": ">i1", "B": ">u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "f": ">f4", "d": ">f8"}


@given(
    kind=st.sampled_from(sorted(NUMBERS)),
    rows=st.integers(0, 20),
    columns=st.integers(1, 9),
    scale=st.integers(1, 30_000),
    seed=st.integers(0, 2**31),
)
def test_samples_come_back_as_they_were_written(kind: str, rows: int, columns: int, scale: int, seed: int) -> None:
    dtype = np.dtype(NUMBERS[kind])
    values = np.random.default_rng(seed).integers(-100 if dtype.kind != "u" else 0, 100, (rows, columns)).astype(dtype)
    samples = gpmf.item("DATA", kind, columns * dtype.itemsize, rows, values.tobytes())
    stream = gpmf.nested("STRM", gpmf.text("STNM", "odd"), gpmf.table("SCAL", "s", ">i2", [scale]), samples)
    damage = Damage()
    (series,) = read_series(gpmf.payload(stream, device="Name"), damage)
    assert (series.device, series.key, series.texts["STNM"]) == ("Name", "DATA", "odd")
    np.testing.assert_allclose(series.values, values.astype(float) / scale, rtol=1e-15)
    assert damage == Damage()


def test_samples_of_several_types_follow_their_type_and_scale() -> None:
    row = struct.pack(">lHf", -5_000_000, 300, 2.5) * 2
    parts = [gpmf.text("TYPE", "lS[1]f"), gpmf.table("SCAL", "l", ">i4", np.array([[10**7], [100], [1]]))]
    (series,) = read_series(gpmf.payload(gpmf.nested("STRM", *parts, gpmf.item("DATA", "?", 10, 2, row))))
    np.testing.assert_allclose(series.values, [[-0.5, 3.0, 2.5]] * 2)


@pytest.mark.parametrize(
    "parts",
    [
        (gpmf.item("DATA", "s", 5, 2, b"0123456789"),),  # no whole numbers
        (gpmf.table("SCAL", "s", ">i2", [0]), gpmf.table("DATA", "s", ">i2", [1, 2])),
        (gpmf.table("SCAL", "s", ">i2", np.ones((3, 1))), gpmf.table("DATA", "s", ">i2", [1, 2])),
        (gpmf.text("TYPE", "l?"), gpmf.item("DATA", "?", 4, 1, b"0123")),
        (gpmf.text("TYPE", "f[99]"), gpmf.item("DATA", "?", 4, 1, b"0123")),
        (gpmf.item("DATA", "?", 4, 1, b"0123"),),
        (gpmf.item("DATA", "x", 4, 1, b"0123"),),
    ],
)
def test_samples_that_do_not_fit_their_description_are_refused(parts: tuple[bytes, ...]) -> None:
    damage = Damage()
    assert not list(read_series(gpmf.payload(gpmf.nested("STRM", *parts)), damage))
    assert damage.refused == 1


def test_a_length_beyond_the_payload_ends_it_and_is_counted() -> None:
    whole = gpmf.payload(gpmf.imu_stream("GYRO", np.ones((4, 3)), 4))
    damage = Damage()
    assert not list(read_series(whole[:-8], damage))
    assert damage.dropped_bytes == len(whole) - 8
    assert len(list(read_series(whole + b"\0" * 40, damage := Damage()))) == 1
    assert damage.dropped_bytes == 0


@given(st.binary(max_size=400), st.integers(0, 400))
def test_any_bytes_are_read_without_complaint(data: bytes, cut: int) -> None:
    whole = gpmf.payload(gpmf.imu_stream("GYRO", np.ones((4, 3)), 4))
    for damaged in (data, whole[:cut] + data, data + whole, whole[:cut]):
        damage = Damage()
        found = list(read_series(damaged, damage))
        assert all(series.values.ndim == 2 and len(series.values) <= len(damaged) for series in found)
        assert 0 <= damage.dropped_bytes <= len(damaged)


# Telemetry


def telemetry(*payloads: bytes, seconds: float = 1.0) -> Telemetry:
    read = [tuple(read_series(data)) for data in payloads]
    return Telemetry([Payload(i * seconds, seconds, series) for i, series in enumerate(read)])


def test_samples_are_spread_at_the_steady_rate_of_all_payloads() -> None:
    # 400 a second that reach the payloads in packets of seven, and a last payload that is not full.
    ends = [7 * (int(400 * (i + 1) - 3) // 7) for i in range(10)]
    counts = np.diff([0, *ends])
    streams = [gpmf.imu_stream("GYRO", np.zeros((n, 3)), t) for n, t in zip(counts, ends, strict=True)]
    last = gpmf.imu_stream("GYRO", np.zeros((14, 3)), ends[-1] + 14)
    times = sample_times(telemetry(*map(gpmf.payload, [*streams, last])).of("GYRO", 3))
    true = np.arange(ends[-1] + 14) / 400
    # A packet of seven lasts 17.5 ms: the end of a payload is uncertain by that, the mean by less.
    assert np.abs(times - true).max() < 0.018
    assert np.ptp(np.diff(times)) < 1e-9


@pytest.mark.parametrize("totals", [(5, 5, 5, 5), (4, 3, 2, 1), (1, 2, 3, 2**32 - 1)])
def test_counts_that_make_no_sense_leave_samples_in_their_payloads(totals: tuple[int, ...]) -> None:
    data = [gpmf.payload(gpmf.imu_stream("GYRO", np.zeros((4, 3)), total)) for total in totals]
    times = sample_times(telemetry(*data).of("GYRO", 3))
    np.testing.assert_allclose(times, np.arange(16) / 4)


@pytest.mark.parametrize("orientation", ["", "ZXY", "YxZ", "xyZ", "XYZ", "zYx"])
def test_axes_are_brought_into_body_by_their_letters(orientation: str) -> None:
    camera = {"X": 1.0, "Y": 2.0, "Z": 3.0}  # left, back, up
    camera |= {letter.lower(): -value for letter, value in camera.items()}
    more = [gpmf.text("ORIN", orientation)] if orientation else []
    sample = [[camera[letter] for letter in orientation or "ZXY"]]
    (series,) = read_series(gpmf.payload(gpmf.imu_stream("ACCL", sample, 1, *more)))
    np.testing.assert_allclose(gopro_telemetry.to_body(series), [[-2.0, 1.0, 3.0]])


def gps9_row(seconds: float) -> bytes:
    days = 8874  # 2024-04-18, counted from 2000-01-01
    return struct.pack(">7lHH", 475_000_000, 85_000_000, 412_500, 1500, 1600, days, round(seconds * 1000), 180, 3)


def test_a_camera_gps_gives_time_and_positions() -> None:
    scale = gpmf.table("SCAL", "l", ">i4", np.array([[10**7], [10**7], [1000], [1000], [100], [1], [1000], [100], [1]]))
    data = []
    for i in range(4):
        rows = b"".join(gps9_row(3600 + i + 0.1 * k) for k in range(10))
        stream = (gpmf.text("TYPE", "lllllllSS"), scale, gpmf.item("GPS9", "?", 32, 10, rows))
        data.append(gpmf.payload(gpmf.nested("STRM", gpmf.table("TSMP", "L", ">u4", [10 * i + 10]), *stream)))
    found = telemetry(*data)
    utc = (np.datetime64("2024-04-18T01:00:00") - np.datetime64("1970-01-01")) / np.timedelta64(1, "s")
    np.testing.assert_allclose(gopro_telemetry.utc_of_video(found), utc, atol=1e-6)
    solutions = list(gopro_telemetry.solutions(found))
    assert len(solutions) == 40
    first = solutions[0]
    assert (first.kind, first.latitude_deg, first.longitude_deg, first.height) == (FixKind.FIX_3D, 47.5, 8.5, 412.5)


def test_an_older_camera_gps_gives_time_and_positions() -> None:
    row = np.array([[331_253_680, -1_173_310_640, 15_445, 590, 60]])
    scale = gpmf.table("SCAL", "l", ">i4", np.array([[10**7], [10**7], [1000], [1000], [100]]))
    head = (gpmf.table("GPSF", "L", ">u4", [3]), gpmf.item("GPSU", "U", 16, 1, b"170417192757.500"))
    stream = gpmf.nested(
        "STRM", *head, gpmf.table("GPSP", "S", ">u2", [150]), scale, gpmf.table("GPS5", "l", ">i4", row)
    )
    found = telemetry(gpmf.payload(stream))
    assert gopro_telemetry.utc_of_video(found) == [1_492_457_277.5]
    (solution,) = gopro_telemetry.solutions(found)
    assert (solution.latitude_deg, solution.sigma_horizontal) == pytest.approx((33.125368, 4.5))


@given(st.binary(max_size=300), st.data())
def test_hostile_telemetry_gives_finite_measurements_or_none(tail: bytes, data: st.DataObject) -> None:
    value = st.floats(width=64)
    keys = {"ATTD": 8, "GLPI": 9, "GPRI": 10, "SYST": 2, "GYRO": 3, "ACCL": 3, "GPS5": 5, "GPS9": 9}
    streams = [
        gpmf.nested("STRM", gpmf.table("TSMP", "d", ">f8", [data.draw(value)]), gpmf.table(key, "d", ">f8", [row]))
        for key, columns in keys.items()
        for row in [data.draw(st.lists(value, min_size=columns, max_size=columns))]
    ]
    found = telemetry(*[gpmf.payload(*streams) + tail] * 4)
    for reader in (
        gopro_telemetry.imu_samples,
        gopro_telemetry.solutions,
        gopro_karma.solutions,
        gopro_karma.vehicle_states,
    ):
        for item in reader(found):
            assert abs(item.t_ns) < 10**15


# The real video


@pytest.fixture
def karma_items(real_data: Callable[[str], Path]) -> list:
    return read_once(real_data(KARMA))


@functools.cache
def read_once(path: Path) -> list:
    """What is in a sound video; of its frames only every other pixel, grey, to keep them all."""
    source = open_source(f"gopro:{path}")
    items = [smaller(item) if isinstance(item, CameraFrame) else item for item in source]
    assert source.problems == ()
    return items


def smaller(frame: CameraFrame) -> CameraFrame:
    pixels = np.frombuffer(frame.data, np.uint8).reshape(frame.height, frame.width, 3)
    return replace(frame, data=pixels[::2, ::2, 1].tobytes(), encoding=Encoding.MONO8)


def of(items: list, kind: type) -> list:
    return [item for item in items if isinstance(item, kind)]


def test_the_karma_video_is_read_whole_and_in_order(karma_items: list) -> None:
    stamps = [item.t_ns for item in karma_items]
    assert stamps == sorted(stamps)
    kinds = (CameraFrame, ImuSample, ReceiverSolution, VehicleState)
    # 362 frames as the container says; 4795 samples of GYRO, 47 of GPRI and ATTD in the file.
    assert [len(of(karma_items, kind)) for kind in kinds] == [362, 4795, 47, 47]
    frame = of(karma_items, CameraFrame)[0]
    assert (frame.width, frame.height) == (854, 480)
    assert frame.exposure_s == pytest.approx(1 / 205, rel=0.01)
    assert abs(frame.t_ns - UTC_NS - GPST_MINUS_UTC_NS) < 2 * 10**9


def test_the_imu_feels_gravity_upwards(karma_items: list) -> None:
    accel = np.mean([sample.accel for sample in of(karma_items, ImuSample)], axis=0)
    # The gimbal keeps the camera level while the drone speeds up a little.
    np.testing.assert_allclose(accel, [0.0, 0.0, 9.75], atol=0.3)


def test_the_gyro_turns_with_the_images(karma_items: list) -> None:
    """Turning left moves the scene to the right, nose down moves it up, and rolling right turns it left."""
    frames, imu = of(karma_items, CameraFrame), of(karma_items, ImuSample)
    grey = [np.frombuffer(f.data, np.uint8).reshape(240, 427) for f in frames]
    right, down, turn = np.array([motion(a, b) for a, b in itertools.pairwise(grey)]).T
    mid = np.array([(a.t_ns + b.t_ns) / 2 for a, b in itertools.pairwise(frames)])
    rates = [smoothed(np.array([sample.gyro[axis] for sample in imu]), 13) for axis in range(3)]
    seen_ns = mid - IMU_EARLY_NS
    roll, pitch, yaw = (np.interp(seen_ns, [sample.t_ns for sample in imu], rate) / 29.97 for rate in rates)
    # Half of 427 px over the tangent of half of 76°, the field of view that the camera was set to.
    assert np.polyfit(yaw, right, 1)[0] == pytest.approx(272, abs=25)
    # The gimbal leaves only vibration about the other axes: it shows in what is quicker than half a second.
    quick = [(values - smoothed(values, 15))[20:-20] for values in (pitch, down, roll, turn)]
    assert np.corrcoef(quick[0], quick[1])[0, 1] < -0.4
    assert np.corrcoef(quick[2], quick[3])[0, 1] < -0.3


def motion(a: np.ndarray, b: np.ndarray) -> tuple[float, float, float]:
    """How the middle of the image moves, right and down, px, and by how much it turns clockwise, rad."""
    corners = cv2.goodFeaturesToTrack(a, 200, 0.01, 8)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None)
    affine, _ = cv2.estimateAffinePartial2D(corners[found == 1], moved[found == 1])
    x, y = affine @ [213, 120, 1] - [213, 120]
    return x, y, np.arctan2(affine[1, 0], affine[0, 0])


def smoothed(values: np.ndarray, n: int) -> np.ndarray:
    return np.convolve(values, np.ones(n) / n, "same")


def test_the_accelerometer_agrees_with_the_speed_of_the_drone(karma_items: list) -> None:
    """The gimbal follows the drone's yaw, so what the drone gains forward the camera feels forward."""
    states = [state for state in of(karma_items, VehicleState) if state.v_enu is not None]
    t = np.array([state.t_ns for state in states])
    forward = np.array([quaternion_to_matrix(state.q_enu_body)[:, 0] for state in states])
    level = forward[:, :2] / np.linalg.norm(forward[:, :2], axis=1, keepdims=True)
    gained = np.gradient(np.array([state.v_enu[:2] for state in states]), (t - t[0]) * 1e-9, axis=0)
    along = np.sum(gained * level, axis=1)[2:-2]
    imu = of(karma_items, ImuSample)
    felt = np.convolve([sample.accel[0] for sample in imu], np.ones(200) / 200, "same")
    there = np.interp(t[2:-2], [sample.t_ns for sample in imu], felt)
    assert np.corrcoef(along, there)[0, 1] > 0.95
    assert along.max() > 1.5  # it did speed up


def test_a_damaged_video_is_read_as_far_as_possible_or_refused(
    real_data: Callable[[str], Path], tmp_path: Path
) -> None:
    whole = real_data(KARMA).read_bytes()
    rng, read, refusals = np.random.default_rng(1), [], []
    for trial in range(6):
        damaged = bytearray(whole if trial % 2 else whole[: int(len(whole) * rng.uniform(0.3, 0.999))])
        for at in rng.integers(0, len(damaged), 300 if trial % 2 else 0):
            damaged[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "d.mp4").write_bytes(damaged)
        try:
            read.append(sum(1 for _ in open_source(f"gopro:{tmp_path / 'd.mp4'}")))
        except SourceError as error:
            refusals.append(str(error))
    assert len(read) + len(refusals) == 6
    assert read
    assert not any("\n" in text for text in refusals)


def test_a_file_that_is_no_video_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "f.mp4").write_bytes(b"no video")
    with pytest.raises(SourceError, match="no readable video"):
        open_source(f"gopro:{tmp_path / 'f.mp4'}")


def test_a_video_without_telemetry_gives_frames_and_says_so(tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "f.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (64, 48))
    for _ in range(5):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    source = open_source(f"gopro:{tmp_path / 'f.mp4'}")
    assert len(list(source)) == 5
    assert any("no GoPro telemetry" in problem.text for problem in source.problems)
    assert read_telemetry(tmp_path / "f.mp4", Faults()).payloads == []


def test_a_series_of_other_devices_does_not_disturb() -> None:
    odd = Series("x", "GYRO", np.zeros((1, 2)), {}, {})
    assert Telemetry([Payload(0.0, 1.0, (odd,))]).of("GYRO", 3) == []
