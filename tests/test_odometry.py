"""The odometry of whole messages: a real recording at rest, damaged frames, what it tells, and its command."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from odometry_scene import aligned_rmse

from air.__main__ import main
from air.odometry.odometry import Odometry, Output, decoded
from air.odometry.settings import OdometrySettings
from air.sensors.calibration import Calibration, to_toml
from air.sources.source import open_source
from common.camera import CameraModel
from common.export.datum import read_datum
from common.export.trajectory import read_tum
from common.measurements import CameraFrame, Encoding, FixKind, ImuSample, ReceiverSolution
from common.messages import EstimatorState, Mode, Pose
from common.se3 import SE3
from common.wire import decode, encode

CAMERA = CameraModel(160, 120, 150.0, 150.0, 79.5, 59.5)
CALIBRATION = Calibration(CAMERA, SE3.identity())
EXCERPT_NS = 1_403_715_277_960_000_000


def standing(seconds: float, rng: np.random.Generator) -> list[ImuSample | CameraFrame]:
    """Samples and frames of an aircraft that stands."""
    image = cv2.GaussianBlur(rng.integers(0, 255, (120, 160), np.uint8), (0, 0), 2.0)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    messages: list[ImuSample | CameraFrame] = []
    for k in range(round(seconds * 100)):
        t_ns = 1_000_000_000 + k * 10_000_000
        messages.append(ImuSample(t_ns, np.array([0.0, 0.0, 9.8]), np.zeros(3)))
        if k % 10 == 5:
            messages.append(CameraFrame(t_ns, "down", k // 10, 160, 120, Encoding.MONO8, image.tobytes()))
    return messages


def fed(odometry: Odometry, messages: list[ImuSample | CameraFrame]) -> list[Output]:
    return [told for message in messages for told in odometry.feed(message)]


def test_euroc_at_rest_stays_within_centimetres_and_gives_the_same_bits(
    real_data: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = real_data("euroc_v101_micro")
    for name in ("once", "twice"):
        assert main(["odometry", f"euroc:{folder}", "--out", str(tmp_path / name), "--quiet"]) == 0
    ours = read_tum(tmp_path / "once" / "trajectory.tum")
    truth = np.loadtxt(folder / "V1_01_easy_original_gt_openvins.txt")
    kept = (ours.t_ns < EXCERPT_NS) & (ours.t_ns > truth[0, 0] * 1e9)
    assert kept.sum() > 600
    expected = np.stack([np.interp(ours.t_ns[kept] * 1e-9, truth[:, 0], truth[:, i]) for i in (1, 2, 3)], axis=1)
    # It stands, shaken by its rotors: the truth itself moves by 2 mm.
    assert aligned_rmse(ours.positions[kept], expected)[0] < 0.01
    once, twice = ((tmp_path / name / "trajectory.tum").read_bytes() for name in ("once", "twice"))
    assert once == twice


def test_what_it_tells_can_be_sent() -> None:
    odometry = Odometry(CALIBRATION, "flight")
    told = fed(odometry, standing(6.0, np.random.default_rng(1)))
    poses = [m for m in told if isinstance(m, Pose)]
    assert len(poses) > 300
    assert {pose.mode for pose in poses} == {Mode.VISUAL_INERTIAL}
    assert np.linalg.norm(poses[-1].T_world_body.t) < 0.01
    assert any(isinstance(m, EstimatorState) for m in told)
    for message in (poses[-1], next(m for m in told if isinstance(m, EstimatorState))):
        assert encode(decode(type(message), encode(message))) == encode(message)


def test_damaged_frames_are_counted_and_skipped() -> None:
    odometry = Odometry(CALIBRATION, "flight")
    messages = standing(3.0, np.random.default_rng(1))
    broken = [replace(m, data=m.data[:100]) if isinstance(m, CameraFrame) and m.index % 3 == 0 else m for m in messages]
    told = fed(odometry, broken)
    assert odometry.refused_frames == 10
    assert any(isinstance(m, Pose) for m in told)


def test_frames_of_another_size_or_out_of_order_are_refused() -> None:
    odometry = Odometry(CALIBRATION, "flight")
    messages = standing(1.0, np.random.default_rng(1))
    first = next(m for m in messages if isinstance(m, CameraFrame))
    fed(odometry, messages)
    fed(odometry, [first, replace(first, t_ns=first.t_ns + 1, width=80, height=240)])
    assert odometry.refused_frames == 2


@settings(max_examples=40)
@given(st.binary(max_size=300), st.sampled_from(Encoding))
def test_any_bytes_are_an_image_or_none(data: bytes, encoding: Encoding) -> None:
    image = decoded(CameraFrame(0, "down", 0, 10, 10, encoding, data))
    assert image is None or image.dtype == np.uint8


def test_frames_wait_for_the_imu_and_are_given_up_when_it_never_comes() -> None:
    odometry = Odometry(CALIBRATION, "flight")
    frames = [m for m in standing(20.0, np.random.default_rng(1)) if isinstance(m, CameraFrame)]
    assert not fed(odometry, list(frames))
    assert len(odometry._waiting) <= 60


def test_a_receiver_tells_gravity_before_it_begins() -> None:
    odometry = Odometry(CALIBRATION, "flight")
    none = np.full(3, np.nan)
    odometry.feed(ReceiverSolution(1, "gnss", FixKind.FIX_3D, 90.0, 0.0, 0.0, 1.0, 1.0, none, np.nan, 0.0, 9))
    assert odometry.estimator._settings.imu.gravity == pytest.approx(9.8322, abs=1e-4)  # at the pole, WGS84


def test_what_a_base_station_says_of_itself_tells_nothing_of_the_aircraft() -> None:
    odometry = Odometry(CALIBRATION, "flight")
    still, none = np.zeros(3), np.full(3, np.nan)
    odometry.feed(ReceiverSolution(1, "base", FixKind.FIX_3D, 90.0, 0.0, 0.0, 1.0, 1.0, none, np.nan, 0.0, 9))
    odometry.feed(ReceiverSolution(2, "base", FixKind.FIX_3D, 90.0, 0.0, 0.0, 1.0, 1.0, still, 0.1, 0.0, 9))
    assert odometry.estimator._settings.imu.gravity == OdometrySettings().imu.gravity
    assert not odometry.estimator._initialization._speeds


def test_a_camera_that_sits_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match="T_body_cam"):
        Odometry(Calibration(CAMERA), "flight")


def test_a_drive_without_a_camera_is_found_by_gnss_and_imu(real_data: Callable[[str], Path], tmp_path: Path) -> None:
    assert main(["odometry", f"comma2k19:{real_data('comma2k19')}", "--out", str(tmp_path), "--smooth", "--quiet"]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["camera"], report["frames"], report["odometry"]["keyframes"]) == ("", 0, 0)
    assert report["odometry"]["world_found_s"] < 20.0
    assert report["odometry"]["modes_s"]["gnss-inertial"] > 40.0
    assert len(read_tum(tmp_path / "trajectory.tum").t_ns) == report["odometry"]["poses"] > 4000
    assert read_datum(tmp_path / "datum.json").latitude_deg == pytest.approx(37.7, abs=0.5)
    assert not (tmp_path / "keyframes.tum").exists()
    told, smoothed = (read_tum(tmp_path / f"{name}.tum") for name in ("trajectory", "smoothed"))
    assert (np.diff(smoothed.t_ns) > 0).all()
    assert smoothed.t_ns[-1] == pytest.approx(told.t_ns[-1], abs=1_100_000_000)
    steps = np.linalg.norm(np.diff(smoothed.positions[-2000:], axis=0), axis=1)
    assert steps.max() < 0.5  # at 100 Hz and 30 m/s


def test_without_a_calibration_frames_are_refused() -> None:
    odometry = Odometry(None, "flight")
    assert not fed(odometry, standing(1.0, np.random.default_rng(1)))
    assert odometry.refused_frames == 10


def test_the_command_says_what_it_misses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"no photo")
    calibration = tmp_path / "camera.toml"
    calibration.write_text(to_toml(CALIBRATION))
    arguments = ["odometry", f"photos:{photos}", "--calibration", str(calibration), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--quiet"]) == 1
    assert "photo" in capsys.readouterr().err


def test_an_open_source_names_its_cameras(real_data: Callable[[str], Path]) -> None:
    source = open_source(f"euroc:{real_data('euroc_v101_micro')}")
    assert source.calibrations["cam0"].T_body_cam is not None  # type: ignore[attr-defined]
