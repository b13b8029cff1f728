"""Intrinsics of a camera from images of a chessboard (core: no file)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import cv2
import numpy as np

from air.calibration.jackknife import groups, jackknife
from common.arrays import F32, F64, U8
from common.camera import CameraModel
from common.errors import CalibrationError

MIN_VIEWS = 6
REJECT = 3.0
"""A view with so many times the median error is left out."""
REJECT_ABOVE_PX = 0.5
"""Below this, no view is left out."""
GROUPS = 12
"""Groups of views, of which one at a time is left out for the standard deviations."""
CELLS = (8, 6)
MIN_COVERAGE = 0.5
MIN_TILT_DEG = 15.0
REFINE_SHARE, REFINE_PX = 0.4, (2, 15)
"""How far around a corner its gradients count: a share of the distance to the next one, within limits in px."""
_UNTIL = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class Board:
    """A chessboard by its inner corners, columns × rows, and the side of a square in m."""

    columns: int
    rows: int
    square: float

    @property
    def points(self) -> F32:
        """Corners (N, 3) in the frame of the board, m, row by row."""
        grid = np.mgrid[0 : self.columns, 0 : self.rows].T.reshape(-1, 2)
        return np.asarray(np.column_stack([grid, np.zeros(len(grid))]) * self.square, np.float32)


@dataclass(frozen=True, eq=False)
class View:
    """Corners (N, 2) px of the board in one image."""

    name: str
    corners: F32


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A camera and how well it is known.

    `sigma` gives one standard deviation by parameter (px, distortion unitless), from leaving out views; `error` px is
    the rms reprojection error; `errors` px those of the views, `rejected` those that were left out; `coverage` is
    the share of the image in which there were corners, `tilt_deg` how far the board was tilted at most; `warnings`
    say what weakens the result.
    """

    camera: CameraModel
    sigma: dict[str, float]
    error: float
    errors: dict[str, float]
    rejected: dict[str, float]
    coverage: float
    tilt_deg: float
    warnings: tuple[str, ...]


def find_board(name: str, grey: U8, board: Board) -> View | None:
    """The corners of a board in a grey image, None where it is not seen whole.

    Found by the whole pattern (A. Duda, U. Frese, Accurate Detection and Localization of Checkerboard Corners, 2018,
    in OpenCV), then refined by the gradients around each: five times as accurate on rendered boards.
    """
    shape = (board.columns, board.rows)
    found, corners = cv2.findChessboardCornersSB(grey, shape, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    grid = np.asarray(corners, np.float32).reshape(board.rows, board.columns, 2)
    spacing = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))
    reach = int(np.clip(REFINE_SHARE * spacing, *REFINE_PX))
    refined = cv2.cornerSubPix(grey, grid.reshape(-1, 1, 2), (reach, reach), (-1, -1), _UNTIL)
    return View(name, np.asarray(refined, np.float32).reshape(-1, 2))


def calibrate_camera(views: Sequence[View], size: tuple[int, int], board: Board) -> Intrinsics:
    """The camera that took the views, of images of `size` (width, height) px.

    Raises CalibrationError when too few views remain, or when no view is tilted: the focal length is then not known.
    """
    kept, rejected = list(views), {}
    while True:
        if len(kept) < MIN_VIEWS:
            raise CalibrationError(
                f"{len(kept)} usable images of the board; {MIN_VIEWS} at least, 20 and more are better"
            )
        camera, error, errors, tilts_deg = _fit(kept, size, board)
        limit = max(REJECT * float(np.median(errors)), REJECT_ABOVE_PX)
        worst = int(np.argmax(errors))
        if errors[worst] <= limit:
            break
        rejected[kept.pop(worst).name] = float(errors[worst])
    if max(tilts_deg) < MIN_TILT_DEG:
        raise CalibrationError(
            f"the board was never tilted by more than {max(tilts_deg):.0f}°; tilt it by 30 to 45° in some images, "
            "else focal length and distance cannot be told apart"
        )

    def parameters(parts: Sequence[list[View]]) -> F64:
        camera = _fit(list(chain.from_iterable(parts)), size, board)[0]
        return np.array([getattr(camera, name) for name in NAMES])

    sigma = jackknife(groups(kept, GROUPS), parameters)
    covered = _coverage(kept, size)
    return Intrinsics(
        camera=camera,
        sigma=dict(zip(NAMES, sigma.tolist(), strict=True)),
        error=error,
        errors={view.name: float(e) for view, e in zip(kept, errors, strict=True)},
        rejected=rejected,
        coverage=covered,
        tilt_deg=max(tilts_deg),
        warnings=tuple(_warnings(covered, len(kept))),
    )


def _fit(views: Sequence[View], size: tuple[int, int], board: Board) -> tuple[CameraModel, float, F64, list[float]]:
    """Camera, rms error px, errors (V,) px and tilts of the board in degrees."""
    points, corners = [board.points] * len(views), [view.corners for view in views]
    error, K, distortion, turns, _, _, _, errors = cv2.calibrateCameraExtended(
        points, corners, size, None, None, flags=cv2.CALIB_FIX_K3
    )
    k1, k2, p1, p2 = np.ravel(distortion)[:4].tolist()
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    camera = CameraModel(size[0], size[1], fx, fy, cx, cy, k1, k2, p1, p2)
    normals = [abs(float(cv2.Rodrigues(turn)[0][2, 2])) for turn in turns]
    return camera, float(error), np.ravel(errors).astype(float), np.degrees(np.arccos(np.clip(normals, 0, 1))).tolist()


def _coverage(views: Sequence[View], size: tuple[int, int]) -> float:
    """Share of the cells of the image in which any view has a corner."""
    corners = np.concatenate([view.corners for view in views])
    cells = np.clip((corners / size * CELLS).astype(int), 0, np.array(CELLS) - 1)
    return len({tuple(cell) for cell in cells.tolist()}) / (CELLS[0] * CELLS[1])


def _warnings(coverage: float, views: int) -> list[str]:
    found = []
    if coverage < MIN_COVERAGE:
        found.append(f"corners cover {coverage:.0%} of the image: distortion is not known near its edges")
    if views < 2 * MIN_VIEWS:
        found.append(f"only {views} images: take 20 and more")
    return found
