"""Intrinsics from rendered chessboards whose camera is known exactly."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from air.__main__ import main
from air.calibration.chessboard import NAMES, Board, Intrinsics, View, calibrate_camera, find_board
from air.sensors.calibration import read_calibration
from common.arrays import F64, U8
from common.camera import CameraModel
from common.errors import CalibrationError
from common.se3 import SE3, rotation_vector_to_matrix

BOARD = Board(9, 6, 0.03)
CAMERA = CameraModel(640, 480, 560.0, 555.0, 325.0, 236.0, -0.22, 0.06, 0.0008, -0.0006)


def poses(count: int, seed: int = 1, tilt_deg: float = 40.0) -> list[SE3]:
    """T_cam_board of boards that fill the image in turn, tilted about all axes."""
    random = np.random.default_rng(seed)
    centre = np.append((BOARD.points.max(axis=0) / 2)[:2], 0.0)
    out = []
    while len(out) < count:
        tilt = np.radians(tilt_deg) * random.uniform(-1, 1, 3) * [1, 1, 0.4]
        R = rotation_vector_to_matrix(tilt)
        p_cam = np.array([*random.uniform(-0.16, 0.16, 2) * [1.2, 0.9], random.uniform(0.32, 0.6)])
        pose = SE3(R, p_cam - R @ centre)
        corners = CAMERA.project(pose.apply(outline()))
        if np.all((corners > 8) & (corners < [CAMERA.width - 8, CAMERA.height - 8])):
            out.append(pose)
    return out


def outline() -> F64:
    s = BOARD.square
    x, y = (BOARD.columns + 0.5) * s, (BOARD.rows + 0.5) * s
    return np.array([[-1.5 * s, -1.5 * s, 0], [x, -1.5 * s, 0], [x, y, 0], [-1.5 * s, y, 0]])


def rendered(T_cam_board: SE3) -> U8:
    """The board as the camera sees it: rays through 3 × 3 points of each pixel, met with the plane of the board."""
    step = (np.arange(3) - 1) / 3
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    image = np.zeros((CAMERA.height, CAMERA.width))
    inverse = T_cam_board.inverse()
    for du in step:
        for dv in step:
            rays = CAMERA.rays(np.stack([u + du, v + dv], axis=-1)) @ inverse.R.T
            xy = (inverse.t[:2] - rays[..., :2] * (inverse.t[2] / rays[..., 2:])) / BOARD.square
            inside = np.all((xy > -1) & (xy < [BOARD.columns, BOARD.rows]), axis=-1)
            black = inside & (np.floor(xy).sum(axis=-1) % 2 == 0)
            image += np.where(black, 30.0, 220.0) / 9
    noisy = image + np.random.default_rng(3).normal(0.0, 2.0, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def exact_views(count: int, noise_px: float, seed: int = 1, tilt_deg: float = 40.0) -> list[View]:
    random = np.random.default_rng(seed)
    points = BOARD.points.astype(float)
    views = [CAMERA.project(pose.apply(points)) for pose in poses(count, seed, tilt_deg)]
    noisy = [corners + random.normal(0.0, noise_px, corners.shape) for corners in views]
    return [View(f"{i}.png", corners.astype(np.float32)) for i, corners in enumerate(noisy)]


def off_in_sigmas(found: Intrinsics) -> F64:
    return np.array([(getattr(found.camera, n) - getattr(CAMERA, n)) / found.sigma[n] for n in NAMES])


def test_the_camera_of_rendered_boards_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for i, pose in enumerate(poses(8)):
        cv2.imwrite(str(tmp_path / f"{i}.png"), rendered(pose))
    cv2.imwrite(str(tmp_path / "empty.png"), np.full((480, 640), 128, np.uint8))
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8 no image")
    out = tmp_path / "camera.toml"
    command = ["calibrate", "camera", str(tmp_path), "--board", "9x6", "--square", "0.03", "--out", str(out), "--quiet"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "empty.png: does not show the whole board of 9×6" in said
    assert "broken.jpg: is no image" in said
    found = read_calibration(out).camera
    # Corners of rendered boards are found to about 0.05 px; eight boards leave a pixel of focal length.
    assert found.fx == pytest.approx(CAMERA.fx, abs=1.5)
    assert found.fy == pytest.approx(CAMERA.fy, abs=1.5)
    assert (found.cx, found.cy) == pytest.approx((CAMERA.cx, CAMERA.cy), abs=1.5)
    grid = np.stack(np.meshgrid(np.linspace(60, 580, 7), np.linspace(50, 430, 5)), axis=-1)
    seen = CAMERA.project(found.rays(grid))
    assert np.abs(seen - grid).max() < 0.5


def test_a_corner_is_found_where_it_was_rendered() -> None:
    pose = poses(1, seed=4)[0]
    view = find_board("a", rendered(pose), BOARD)
    assert view is not None
    truth = CAMERA.project(pose.apply(BOARD.points.astype(float)))
    distance = min(np.linalg.norm(view.corners - way, axis=1).max() for way in (truth, truth[::-1]))
    assert distance < 0.25  # aliasing of the rendering


def test_standard_deviations_are_honest() -> None:
    """Over many sets of images, errors are of the size that they are said to be."""
    off = np.array(
        [off_in_sigmas(calibrate_camera(exact_views(16, 0.2, seed), (640, 480), BOARD)) for seed in range(6)]
    )
    # 48 values that are dependent within a set: their rms lies within a factor of two of 1.
    assert 0.5 < np.sqrt(np.mean(off**2)) < 2.0
    assert np.abs(off).max() < 5.0


def test_a_bad_image_is_left_out_and_named() -> None:
    views = exact_views(14, 0.1)
    views[5] = View("bad.png", views[5].corners + np.random.default_rng(2).normal(0, 3, (54, 2)).astype(np.float32))
    found = calibrate_camera(views, (640, 480), BOARD)
    assert list(found.rejected) == ["bad.png"]
    assert found.error < 0.2
    assert np.abs(off_in_sigmas(found)).max() < 6.0


def test_boards_that_are_all_flat_on_are_refused() -> None:
    with pytest.raises(CalibrationError, match=r"never tilted by more than \d+°; tilt it by 30 to 45°"):
        calibrate_camera(exact_views(12, 0.1, tilt_deg=4.0), (640, 480), BOARD)


def test_too_few_images_are_refused() -> None:
    with pytest.raises(CalibrationError, match="3 usable images of the board; 6 at least"):
        calibrate_camera(exact_views(3, 0.1), (640, 480), BOARD)


@pytest.mark.parametrize(
    ("board", "square", "said"), [("9by6", "0.03", "--board is '9by6'"), ("9x6", "30", "--square is 30.0")]
)
def test_an_impossible_board_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], board: str, square: str, said: str
) -> None:
    assert main(["calibrate", "camera", str(tmp_path), "--board", board, "--square", square]) == 1
    assert said in capsys.readouterr().err


def test_a_folder_without_images_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "camera", str(tmp_path), "--board", "9x6", "--square", "0.03"]) == 1
    assert "holds no image" in capsys.readouterr().err
