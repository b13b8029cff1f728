"""What `luojia-air calibrate` does: reads images or a recording, calibrates, writes, and tells."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from air.calibration.chessboard import Board, Intrinsics, View, calibrate_camera, find_board
from air.calibration.imu_camera import ImuCamera, calibrate_imu_camera
from air.calibration.rotations import Turn, TurnTracker
from air.sensors.calibration import Calibration, read_calibration, to_toml
from air.sources.source import open_source
from common.arrays import F64, U8
from common.camera import CameraModel
from common.errors import CalibrationError, ConfigError
from common.measurements import CameraFrame, Encoding, ImuSample
from common.se3 import SE3

IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")


def calibrate_from_images(folder: Path, board: str, square: float, out: Path | None, quiet: bool) -> str:
    """A report of the camera that took a folder of images of a board "9x6"; written to `out` as our TOML.

    Raises ConfigError for an impossible board, CalibrationError for images that cannot tell.
    """
    shape = _board(board, square)
    views, size, unseen = _views(folder, shape, quiet)
    found = calibrate_camera(views, size, shape)
    write_calibration(out, to_toml(Calibration(found.camera), found.sigma))
    return "\n".join(_camera_report(found, unseen, out))


def calibrate_from_recording(url: str, calibration: Path, out: Path | None, quiet: bool) -> str:
    """A report of how the camera of a source sits on its IMU; written to `out` as our TOML.

    Raises SourceError, ConfigError, and CalibrationError for a recording that cannot tell.
    """
    known = read_calibration(calibration)
    stamps, rates, turns = _turns(url, known.camera, quiet)
    found = calibrate_imu_camera(stamps, np.array(rates, float).reshape(-1, 3), turns)
    t = np.zeros(3) if known.T_body_cam is None else known.T_body_cam.t
    result = replace(known, T_body_cam=SE3(found.R_body_cam, t), time_offset_s=found.time_offset_s)
    sigma = {"time_offset_s": found.sigma_offset_s, "rotation_rad": float(found.sigma_rotation.max())}
    write_calibration(out, to_toml(result, sigma))
    return "\n".join(_imu_report(found, result, out))


def _board(text: str, square: float) -> Board:
    match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", text)
    columns, rows = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(columns, rows) < 3:
        raise ConfigError(f"--board is {text!r}; allowed: inner corners, columns x rows, 3x3 at least, for example 9x6")
    if not 0.0005 <= square <= 10.0:
        raise ConfigError(f"--square is {square}; allowed: the side of a square in m, 0.0005 to 10, for example 0.03")
    return Board(columns, rows, square)


def _views(folder: Path, board: Board, quiet: bool) -> tuple[list[View], tuple[int, int], dict[str, str]]:
    """Views of the board, the size of the images, and why others were not used."""
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in IMAGES)
    except OSError as error:
        raise CalibrationError(f"{folder}: cannot be read: {error.strerror}") from error
    if not files:
        raise CalibrationError(f"{folder}: holds no image ({', '.join(IMAGES)})")
    views, unseen = [], {}
    size: tuple[int, int] | None = None
    for file in tqdm(files, unit=" images", leave=False, disable=True if quiet else None):
        grey = _grey(file.read_bytes())
        if grey is None:
            unseen[file.name] = "is no image"
            continue
        size = size or (grey.shape[1], grey.shape[0])
        if (grey.shape[1], grey.shape[0]) != size:
            unseen[file.name] = f"has {grey.shape[1]}×{grey.shape[0]} px, the first one {size[0]}×{size[1]}"
        elif view := find_board(file.name, grey, board):
            views.append(view)
        else:
            unseen[file.name] = f"does not show the whole board of {board.columns}×{board.rows} inner corners"
    if not views:
        raise CalibrationError(f"{folder}: none of {len(files)} images shows the board; is --board right?")
    return views, size or (0, 0), unseen


def _turns(url: str, camera: CameraModel, quiet: bool) -> tuple[list[int], list[list[float]], list[Turn]]:
    """Stamps and rates of the IMU, and turns of the first camera, of a source."""
    tracker, name = TurnTracker(camera), None
    stamps: list[int] = []
    rates: list[list[float]] = []
    turns: list[Turn] = []
    items: Iterable[object] = open_source(url)
    for item in tqdm(items, unit=" items", leave=False, disable=True if quiet else None):
        if isinstance(item, ImuSample):
            stamps.append(item.t_ns)
            rates.append(item.gyro.tolist())
        elif isinstance(item, CameraFrame) and item.camera == (name := name or item.camera):
            grey = decoded_grey(item)
            if grey is not None and grey.shape != (camera.height, camera.width):
                size = f"{grey.shape[1]}×{grey.shape[0]}"
                raise CalibrationError(
                    f"{url}: frames of {size} px, but the calibration is for {camera.width}×{camera.height}"
                )
            if grey is not None and (turn := tracker.add(item.t_ns, grey)) is not None:
                turns.append(turn)
    return stamps, rates, turns


def decoded_grey(frame: CameraFrame) -> U8 | None:
    """Grey levels (H, W) of a frame; None for one that is damaged or H.264."""
    if frame.encoding in (Encoding.JPEG, Encoding.PNG):
        return _grey(frame.data)
    depth = {Encoding.MONO8: 1, Encoding.BGR8: 3}.get(frame.encoding)
    if depth is None or len(frame.data) != frame.height * frame.width * depth:
        return None
    image = np.frombuffer(frame.data, np.uint8).reshape(frame.height, frame.width, depth)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if depth == 3 else image[..., 0])


def _grey(data: bytes) -> U8 | None:
    try:
        # Turned as the sensor sees it: a camera has one calibration however it was held.
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)


def write_calibration(out: Path | None, text: str) -> None:
    """Write a calibration, if there is where to. Raises CalibrationError."""
    if out is None:
        return
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CalibrationError(f"{out}: cannot be written: {error.strerror}") from error


def _camera_report(found: Intrinsics, unseen: dict[str, str], out: Path | None) -> list[str]:
    lines = [f"{name}: {why}" for name, why in unseen.items()]
    lines += [f"{name}: left out, error {error:.2f} px" for name, error in found.rejected.items()]
    lines += [f"{name} = {getattr(found.camera, name):.6g} ± {sigma:.2g}" for name, sigma in found.sigma.items()]
    worst = max(found.errors, key=lambda name: found.errors[name])
    lines.append(
        f"{len(found.errors)} images of {found.camera.width}×{found.camera.height} px: reprojection error "
        f"{found.error:.3f} px rms, {found.errors[worst]:.3f} px in {worst}; corners cover {found.coverage:.0%} of the "
        f"image, tilts up to {found.tilt_deg:.0f}°"
    )
    return lines + [f"warning: {warning}" for warning in found.warnings] + _written(out)


def _imu_report(found: ImuCamera, known: Calibration, out: Path | None) -> list[str]:
    return [
        *imu_lines(known, found.sigma_rotation, found.sigma_offset_s, found.bias),
        f"{found.turns} turns, of which {np.degrees(found.residual):.3f}° rms are not explained",
        *_written(out),
    ]


def imu_lines(known: Calibration, sigma_rotation: F64, sigma_offset_s: float, bias: F64) -> list[str]:
    """Lines on how a camera sits on its IMU; sigma (3,) rad about the axes of the body, bias (3,) rad/s."""
    assert known.T_body_cam is not None
    wxyz = ", ".join(f"{q:.6f}" for q in known.T_body_cam.wxyz)
    x, y, z = np.degrees(sigma_rotation)
    return [
        f"R_body_cam, wxyz = {wxyz} ± {x:.2f}°, {y:.2f}°, {z:.2f}° about the axes of the body",
        f"time of the IMU = time of the camera {1e3 * known.time_offset_s:+.2f} ± {1e3 * sigma_offset_s:.2f} ms",
        f"bias of the gyroscope = {', '.join(f'{b:.5f}' for b in bias)} rad/s",
    ]


def _written(out: Path | None) -> list[str]:
    return [] if out is None else [f"written: {out}"]
