"""Flights as EuRoC folders, RINEX and calibration files, and back."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import rtklib
from recording_samples import frame as moving_picture

from air.config import AirConfig
from air.conversion.calibrations import euroc_camera, euroc_imu, kalibr_cameras
from air.conversion.convert import convert
from air.conversion.euroc import EurocWriter
from air.sensors.calibration import Calibration, read_calibration
from air.sensors.h264 import image_of
from air.simulate import simulate
from air.sources.known import Known, read_known
from air.sources.source import open_source
from common.camera import CameraModel
from common.errors import ConfigError, ExportError, SourceError
from common.export.trajectory import read_tum
from common.geo import T_ecef_enu
from common.measurements import CameraFrame, Encoding, GlonassEphemeris, GnssEpoch, ImuSample, KeplerEphemeris
from common.se3 import SE3

URL = "sim:plain?duration=34&flight.start=air&imu.precision=float64"
CALIBRATION = Calibration(
    CameraModel(1280, 720, 641.0, 642.0, 639.5, 359.5, -0.05, 0.04, -0.0005, 0.0004),
    SE3.from_quaternion([0.1, 0.7, -0.7, 0.02], [0.1, 0.0, -0.08]),
    0.003,
    20e-6,
)


@pytest.fixture(scope="module")
def converted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("flight") / "out"
    convert(URL, "euroc+rinex", out)
    return out


def test_imu_samples_come_back_as_they_were(converted: Path) -> None:
    flown = [m for m in open_source(URL) if isinstance(m, ImuSample)]
    read = list(open_source(f"euroc:{converted}"))
    assert len(read) == len(flown) > 5000
    for sample, back in zip(flown, read, strict=True):
        assert isinstance(back, ImuSample)
        assert back.t_ns == sample.t_ns
        np.testing.assert_array_equal(back.accel, sample.accel)
        np.testing.assert_array_equal(back.gyro, sample.gyro)


@pytest.mark.parametrize("receiver", ["gnss", "base"])
def test_epochs_come_back_as_far_as_rinex_has_digits(converted: Path, receiver: str) -> None:
    flown = [m for m in open_source(URL) if isinstance(m, GnssEpoch) and m.receiver == receiver]
    rinex = converted / "rinex"
    read = [m for m in open_source(f"rinex:{rinex / receiver}.obs,{rinex}/broadcast.nav") if isinstance(m, GnssEpoch)]
    assert len(read) == len(flown) > 30
    for epoch, back in zip(flown, read, strict=True):
        assert abs(back.t_ns - epoch.t_ns) <= 50
        order = np.lexsort((epoch.signals, epoch.satellites))
        other = np.lexsort((back.signals, back.satellites))
        assert [epoch.satellites[i] for i in order] == [back.satellites[i] for i in other]
        for name, step in (("pseudorange", 5e-4), ("carrier_phase", 5e-4), ("doppler", 5e-4), ("cn0", 5e-4)):
            np.testing.assert_allclose(
                getattr(back, name)[other], getattr(epoch, name)[order], rtol=0, atol=1.01 * step, equal_nan=True
            )
        np.testing.assert_array_equal(back.channel[other], epoch.channel[order])


def test_what_was_broadcast_comes_back(converted: Path) -> None:
    flown = {(m.satellite, m.toe_ns) for m in open_source(URL) if isinstance(m, KeplerEphemeris | GlonassEphemeris)}
    nav = converted / "rinex" / "broadcast.nav"
    read = {(m.satellite, m.toe_ns) for m in open_source(f"rinex:{nav}") if hasattr(m, "toe_ns")}
    assert read == flown
    assert len({satellite[0] for satellite, _ in flown}) >= 3


def test_the_truth_stands_beside_the_measurements_at_200_hz(converted: Path) -> None:
    truth = read_tum(converted / "truth.tum")
    table = np.loadtxt(converted / "mav0" / "state_groundtruth_estimate0" / "data.csv", delimiter=",")
    assert len(truth.t_ns) == len(table) == 34 * 200 + 1
    np.testing.assert_allclose(table[:, 1:4], truth.positions, atol=1e-8)
    assert table.shape[1] == 17
    # Their columns are position, attitude, velocity, biases: the velocity is the derivative of the position.
    rate = np.gradient(table[:, 1:4], 1 / 200, axis=0)[1:-1]
    np.testing.assert_allclose(rate, table[1:-1, 8:11], atol=2e-4)


def test_rtklib_fixes_the_exported_flight_where_its_antenna_was(tmp_path: Path) -> None:
    """The phase of the rover against the base, carried by a body that leans and turns, to 3 cm of the truth."""
    url = "sim:plain?duration=100&imu=off&mavlink=off"
    convert(url, "rinex", tmp_path)
    folder, aircraft = tmp_path / "rinex", open_source(url).aircraft
    nav = folder / "broadcast.nav"
    found = rtklib.kinematic(folder, folder / "gnss.obs", folder / "base.obs", nav, aircraft.p_base_ecef)
    fixed = [solution for solution in found if solution.fixed]
    assert len(fixed) > 0.4 * len(found) > 200
    motion = aircraft.trajectory.at(np.array([s.t_ns - aircraft.start_ns for s in fixed]) * 1e-9)
    antenna = motion.p_world + motion.R_world_body @ aircraft.extrinsics.p_body_antenna
    told = T_ecef_enu(aircraft.datum).inverse().apply(np.array([s.position for s in fixed]))
    assert np.linalg.norm(told - antenna, axis=1).max() < 0.03


def test_a_recording_converts_like_the_flight_itself(converted: Path, tmp_path: Path) -> None:
    """With truth, and with what was calibrated: both were written when it was recorded."""
    simulate(AirConfig(), URL, tmp_path / "flight.mcap")
    convert(str(tmp_path / "flight.mcap"), "euroc+rinex", tmp_path / "out")
    files = {path.relative_to(converted) for path in converted.rglob("*") if path.is_file()}
    assert files == {path.relative_to(tmp_path / "out") for path in (tmp_path / "out").rglob("*") if path.is_file()}
    for file in files:
        assert (tmp_path / "out" / file).read_bytes() == (converted / file).read_bytes(), file


def test_the_real_recording_comes_back(real_data: Callable[[str], Path], tmp_path: Path) -> None:
    url = f"euroc:{real_data('euroc_v101_micro')}"
    done = convert(url, "euroc", tmp_path)
    assert (done.counts["frames"], done.counts["IMU samples"]) == (95, 29_120)
    for before, after in zip(open_source(url), open_source(f"euroc:{tmp_path}"), strict=True):
        assert before.t_ns == after.t_ns
        if isinstance(before, CameraFrame):
            assert before == after
    calibrations = open_source(url).calibrations["cam0"], open_source(f"euroc:{tmp_path}").calibrations["cam0"]
    assert calibrations[0].camera == calibrations[1].camera
    np.testing.assert_allclose(calibrations[0].T_body_cam.matrix, calibrations[1].T_body_cam.matrix, atol=1e-12)


# Frames


def test_raw_frames_lose_nothing_and_what_does_not_decode_is_counted(tmp_path: Path) -> None:
    bgr = [moving_picture(i) for i in range(3)]
    mono = CameraFrame(7, "side", 0, 64, 48, Encoding.MONO8, bytes(range(256)) * 12)
    jpeg = cv2.imencode(".jpg", image_of(bgr[0]))[1].tobytes()
    packed = CameraFrame(8, "side", 1, 64, 48, Encoding.JPEG, jpeg)
    damaged = CameraFrame(9, "side", 2, 64, 48, Encoding.JPEG, b"no image")
    with EurocWriter(tmp_path) as euroc:
        for frame in (*bgr, mono, packed, damaged):
            euroc.add_frame(frame, CALIBRATION if frame.camera == "front" else None)
    assert [(p.name, p.text) for p in euroc.problems] == [("side", "1 frames cannot be decoded; left out")]
    assert euroc.cameras == {"front": "cam0", "side": "cam1"}
    source = open_source(f"euroc:{tmp_path}")
    frames = list(source)
    assert [frame.t_ns for frame in frames] == [7, 8, *(frame.t_ns for frame in bgr)]
    assert all(earlier.t_ns < later.t_ns for earlier, later in pairwise(frames))
    for frame, back in zip((mono, *bgr), (frames[0], *frames[2:]), strict=True):
        pixels = cv2.imdecode(np.frombuffer(back.data, np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(pixels, image_of(frame))
    assert source.calibrations["cam0"].camera == CALIBRATION.camera


# Calibrations


def test_calibrations_come_back_from_euroc_and_kalibr(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(euroc_camera(CALIBRATION))
    (tmp_path / "camchain.yaml").write_text(kalibr_cameras({"cam0": CALIBRATION}))
    (tmp_path / "bare.yaml").write_text(kalibr_cameras({"cam0": Calibration(CALIBRATION.camera)}))
    euroc, kalibr = (read_calibration(tmp_path / name) for name in ("sensor.yaml", "camchain.yaml"))
    assert euroc.camera == kalibr.camera == CALIBRATION.camera
    for found in (euroc, kalibr):
        np.testing.assert_allclose(found.T_body_cam.matrix, CALIBRATION.T_body_cam.matrix, atol=1e-12)
    assert kalibr.time_offset_s == CALIBRATION.time_offset_s
    assert read_calibration(tmp_path / "bare.yaml").T_body_cam is None
    assert "gyroscope_noise_density: 0.000174" in euroc_imu()


def test_what_is_known_of_an_aircraft_comes_back(tmp_path: Path) -> None:
    known = Known({"down": CALIBRATION}, np.array([-0.1, 0.0, 0.2]), np.array([1.5, 2.5, 3.5]), {"imu": 0.003})
    known.write(tmp_path)
    back = read_known(tmp_path)
    assert back.cameras["down"].camera == CALIBRATION.camera
    np.testing.assert_array_equal(back.p_body_antenna, known.p_body_antenna)
    np.testing.assert_array_equal(back.p_base_ecef, known.p_base_ecef)
    assert back.delays_s["imu"] == 0.003
    assert read_known(tmp_path / "nothing").p_body_antenna is None
    (tmp_path / "aircraft.toml").write_text("p_body_antenna = [1.0]\n")
    with pytest.raises(SourceError, match=r"p_body_antenna is \[1.0\]; allowed: three numbers"):
        read_known(tmp_path)
    (tmp_path / "aircraft.toml").write_text("lever_arm = [1.0]\n")
    with pytest.raises(ConfigError, match="lever_arm is not a setting"):
        read_known(tmp_path)


def test_an_unknown_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"format 'euroc\+bag' is unknown; allowed: euroc, rinex, joined by \+"):
        convert(URL, "euroc+bag", tmp_path)
