"""Points followed from frame to frame: where the ground of the last image is in the next one.

Pyramidal Lucas–Kanade (Bouguet, 2001) from where the gyroscope expects each point, checked by tracking back and by one
epipolar geometry for all; new corners (Shi and Tomasi, CVPR 1994) fill the gaps that a grid finds.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from air.odometry.settings import TrackerSettings
from common.arrays import F32, F64, I64, U8, Bool
from common.camera import CameraModel

CONFIDENCE, ITERATIONS = 0.999, 500
MIN_FOR_GEOMETRY = 12
DETECTION_SCALE, CROWDED = 0.5, 0.5
"""Corners are sought in a smaller image: a quarter of the work, and those found are less prone to blur. Points nearer
than half the spacing are crowded."""
MIN_CONTRAST = 2.0
"""Standard deviation of an image, gray levels, below which nothing is seen in it."""
BRIGHTNESS, CONTRAST = 128.0, 50.0
"""Mean and standard deviation, gray levels, that every image is given: so exposure and gain do not matter. Unlike an
equalisation by tiles this is the same all over the image, and moves no point."""
MAX_FROM_PREDICTION = 0.1
"""A point found further than this from where it was expected, in image widths, was mistaken."""


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """The points seen in one frame.

    `ids` (N,) stay with a point; `rays` (N, 3) are unit vectors in the camera frame, free of distortion; `uv` (N, 2)
    px as seen; `row_dt_s` (N,) is when the row of each point was exposed, from `t_ns` on; `new` (N,) marks points
    that no earlier frame has. `blind` says that the image shows nothing to follow: dark, covered or blurred.
    """

    t_ns: int
    ids: I64
    uv: F64
    rays: F64
    row_dt_s: F64
    new: Bool
    blind: bool


class Tracker:
    """Follows points through the frames of one camera. Gray images (H, W) uint8 in, `TrackedFrame` out."""

    def __init__(self, camera: CameraModel, settings: TrackerSettings | None = None) -> None:
        self._camera = camera
        self._settings = settings or TrackerSettings()
        self._last: U8 | None = None
        self._ids = np.zeros(0, np.int64)
        self._uv = np.zeros((0, 2), np.float32)
        self._next_id = 0

    def track(self, image: U8, t_ns: int, R_last_now: F64, line_time_s: float = 0.0) -> TrackedFrame:
        """The points of the last frame found again, and new ones.

        `R_last_now` (3, 3) is how the camera turned since the last frame, by the gyroscope; the identity will do.
        Raises ValueError for an image of another size than the camera's.
        """
        if image.shape != (self._camera.height, self._camera.width):
            raise ValueError(f"image of {image.shape[1]} × {image.shape[0]} px for a camera of other size")
        mean, sigma = (float(value[0, 0]) for value in cv2.meanStdDev(image))
        dull = sigma < MIN_CONTRAST
        even = _with_contrast(image, mean, max(sigma, MIN_CONTRAST))
        if self._last is not None and len(self._ids):
            self._follow(self._last, even, R_last_now)
        self._last = even
        free = self._thin()
        known = len(self._ids)
        if not dull:
            self._detect(even, free)
        return self._frame(t_ns, line_time_s, known, dull)

    def forget(self, ids: I64) -> None:
        """Stop following points that turned out not to stand still."""
        keep = ~np.isin(self._ids, ids)
        self._ids, self._uv = self._ids[keep], self._uv[keep]

    def _frame(self, t_ns: int, line_time_s: float, known: int, dull: bool) -> TrackedFrame:
        uv = self._uv.astype(np.float64)
        rays = self._camera.rays(uv)
        return TrackedFrame(
            t_ns=t_ns,
            ids=self._ids.copy(),
            uv=uv,
            rays=rays / np.linalg.norm(rays, axis=1, keepdims=True),
            row_dt_s=(uv[:, 1] - (self._camera.height - 1) / 2) * line_time_s,
            new=np.arange(len(uv)) >= known,
            blind=dull or len(uv) < MIN_FOR_GEOMETRY,
        )

    def _follow(self, last: U8, now: U8, R_last_now: F64) -> None:
        """Keep the points that are found again."""
        expected = self._expected(R_last_now)
        found, seen = self._flow(last, now, self._uv, expected)
        returned, back = self._flow(now, last, found, self._uv)
        good = seen & back & self._inside(found)
        good &= np.linalg.norm(returned - self._uv, axis=1) < self._settings.forward_backward
        good &= np.linalg.norm(found - expected, axis=1) < MAX_FROM_PREDICTION * self._camera.width
        rows = np.flatnonzero(good)
        rows = rows[self._agreeing(self._uv[rows], found[rows])]
        self._ids, self._uv = self._ids[rows], found[rows]

    def _expected(self, R_last_now: F64) -> F32:
        """Where the points (N, 2) px appear after a turn of the camera alone."""
        rays = self._camera.rays(self._uv.astype(np.float64)) @ R_last_now
        uv = self._camera.project(rays)
        return np.where(np.isfinite(uv), uv, self._uv).astype(np.float32)

    def _flow(self, a: U8, b: U8, uv: F32, guess: F32) -> tuple[F32, Bool]:
        size = self._settings.window
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            a,
            b,
            uv.reshape(-1, 1, 2),
            guess.reshape(-1, 1, 2).copy(),
            winSize=(size, size),
            maxLevel=self._settings.levels,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return found.reshape(-1, 2), status.ravel().astype(bool)

    def _inside(self, uv: F32) -> Bool:
        border = self._settings.border
        size = np.array([self._camera.width, self._camera.height]) - 1 - border
        return np.asarray(((uv >= border) & (uv <= size)).all(axis=1))

    def _agreeing(self, before: F32, after: F32) -> Bool:
        """Mask (M,) of the points that one epipolar geometry of ideal images explains."""
        if len(before) < MIN_FOR_GEOMETRY:
            return np.ones(len(before), bool)
        f = self._camera.fx
        xy_a, xy_b = (self._camera.rays(uv.astype(np.float64))[:, :2] * f for uv in (before, after))
        cv2.setRNGSeed(0)
        threshold = self._settings.epipolar
        _, mask = cv2.findFundamentalMat(xy_a, xy_b, cv2.USAC_MAGSAC, threshold, CONFIDENCE, ITERATIONS)
        return np.ones(len(before), bool) if mask is None else mask.ravel().astype(bool)

    def _thin(self) -> U8:
        """Let go of points that have come close to older ones, as all do in a climb; 255 where new ones may be.

        Points that crowd in the middle of the image cannot tell tilt from motion.
        """
        height, width = (round(n * DETECTION_SCALE) for n in (self._camera.height, self._camera.width))
        spacing, border = (self._settings.spacing * DETECTION_SCALE, round(self._settings.border * DETECTION_SCALE))
        free = np.zeros((height, width), np.uint8)
        free[border : height - border, border : width - border] = 255
        crowded, kept = np.zeros_like(free), []
        for row in np.argsort(self._ids, kind="stable").tolist():
            u, v = (round(float(x)) for x in self._uv[row] * DETECTION_SCALE)
            if crowded[min(max(v, 0), height - 1), min(max(u, 0), width - 1)]:
                continue
            kept.append(row)
            cv2.circle(crowded, (u, v), round(CROWDED * spacing), 255, -1)
            cv2.circle(free, (u, v), round(spacing), 0, -1)
        self._ids, self._uv = self._ids[kept], self._uv[kept]
        return free

    def _detect(self, image: U8, free: U8) -> None:
        """Add corners where there are none, strongest first, until there are enough."""
        missing = self._settings.features - len(self._ids)
        if missing <= 0:
            return
        small = cv2.resize(image, free.shape[::-1], interpolation=cv2.INTER_AREA)
        spacing = self._settings.spacing * DETECTION_SCALE
        corners = cv2.goodFeaturesToTrack(small, missing, self._settings.quality, spacing, mask=free)
        if corners is None:
            return
        uv = ((corners.reshape(-1, 2) + 0.5) / DETECTION_SCALE - 0.5).astype(np.float32)
        self._uv = np.vstack([self._uv, uv])
        self._ids = np.concatenate([self._ids, self._next_id + np.arange(len(uv))])
        self._next_id += len(uv)


def _with_contrast(image: U8, mean: float, sigma: float) -> U8:
    """The image with the usual brightness and contrast."""
    levels = BRIGHTNESS + (np.arange(256) - mean) * (CONTRAST / sigma)
    return np.asarray(cv2.LUT(image, np.clip(levels, 0, 255).astype(np.uint8)), np.uint8)
