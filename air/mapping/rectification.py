"""A pair of photos resampled so that a point of the ground lies on the same row of both.

Own rotation along the baseline instead of cv2.stereoRectify, so that any direction of the baseline and any yaw
between the photos works, and principal points per photo, so that the assumed ground has disparity zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from air.mapping.pairs import footprint
from common.arrays import F32, F64, U8, Bool
from common.camera import CameraModel
from common.messages import Keyframe

# Rays that meet the ground this far from the nadir of the rectified view would blow up its canvas.
MAX_TANGENT = 2.5


@dataclass(frozen=True, eq=False)
class View:
    """One side of a rectified pair: `R_rect_cam` (3, 3), the camera it was resampled with, its principal point px.

    A rectified pixel (u, v) is seen along the direction ((u − cx) / f, (v − cy) / f, 1) in the rectified frame.
    """

    R_rect_cam: F64
    camera: CameraModel
    cx: float


@dataclass(frozen=True, eq=False)
class Rectification:
    """Geometry of a rectified pair of `width` × `height` px with common focal length `focal` px and row offset `cy`.

    A point at depth Z m in the rectified frame has u_left − u_right = `disparity`(Z); `baseline` is in m.
    """

    left: View
    right: View
    width: int
    height: int
    focal: float
    cy: float
    baseline: float

    def disparity(self, depth: float) -> float:
        """Disparity px of a point at `depth` m."""
        return self.focal * self.baseline / depth + self.left.cx - self.right.cx


@dataclass(frozen=True, eq=False)
class RectifiedImages:
    """Left and right grayscale (h, w) uint8, their valid pixels (h, w) bool, and the left colours (h, w, 3) uint8."""

    left: U8
    right: U8
    left_valid: Bool
    right_valid: Bool
    colour: U8


def rectify(left: Keyframe, right: Keyframe, ground_height: float, gsd: float, max_pixels: int) -> Rectification | None:
    """Geometry that covers the ground common to both photos with pixels of about `gsd` m, None where there is none.

    The canvas is made coarser to hold at most `max_pixels`, and never finer than the photos.
    """
    corners = [footprint(k, ground_height) for k in (left, right)]
    if corners[0] is None or corners[1] is None:
        return None
    baseline = right.T_world_cam.t - left.T_world_cam.t
    R_rect_world = _rotation(baseline, left.T_world_cam.R[:, 2] + right.T_world_cam.R[:, 2])
    if R_rect_world is None:
        return None
    common = _common_ground(corners[0], corners[1])
    if common is None:
        return None
    ground = np.column_stack([common, np.full(len(common), ground_height)])
    seen = [(ground - k.T_world_cam.t) @ R_rect_world.T for k in (left, right)]
    if min(s[:, 2].min() for s in seen) <= 0:
        return None
    tangents = [s[:, :2] / s[:, 2:3] for s in seen]
    if max(np.abs(t).max() for t in tangents) > MAX_TANGENT:
        return None
    low, high = tangents[0].min(axis=0), tangents[0].max(axis=0)
    depth = float(np.mean(seen[0][:, 2]))
    area = float(np.prod(high - low))
    native = min(left.camera.fx, right.camera.fx)
    focal = min(depth / gsd, native, float(np.sqrt(max_pixels / max(area, 1e-9))))
    # A multiple of 16, so that each level of the matcher's pyramid has exactly half the pixels.
    width, height = (16 * int(n) for n in np.ceil((high - low) * focal / 16))
    if min(width, height) < 48:
        return None
    cx, cy = -low * focal
    length = float(np.linalg.norm(baseline))
    shift = round(float(focal * length / depth))
    return Rectification(
        View(R_rect_world @ left.T_world_cam.R, left.camera, float(cx)),
        View(R_rect_world @ right.T_world_cam.R, right.camera, float(cx) + shift),
        width,
        height,
        focal,
        float(cy),
        length,
    )


def resample(rectification: Rectification, left: U8, right: U8) -> RectifiedImages:
    """The two photos (H, W, 3) uint8 RGB, maybe smaller than their camera models say, on the rectified canvas."""
    colour, left_valid = _resample(rectification, rectification.left, left)
    other, right_valid = _resample(rectification, rectification.right, cv2.cvtColor(right, cv2.COLOR_RGB2GRAY))
    gray = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
    return RectifiedImages(gray, other, left_valid, right_valid, colour)


def _resample(rectification: Rectification, view: View, image: U8) -> tuple[U8, Bool]:
    scale = image.shape[1] / view.camera.width
    if rectification.focal < 0.75 * view.camera.fx * scale:
        # Reduced first by area averaging: sampling a finer image directly would alias.
        scale = max(rectification.focal / view.camera.fx, 0.5 * scale)
        size = (round(view.camera.width * scale), round(view.camera.height * scale))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    camera = view.camera.scaled(image.shape[1] / view.camera.width)
    K_rect = np.array([[rectification.focal, 0, view.cx], [0, rectification.focal, rectification.cy], [0, 0, 1.0]])
    size = (rectification.width, rectification.height)
    maps = cv2.initUndistortRectifyMap(camera.K, camera.distortion, view.R_rect_cam, K_rect, size, cv2.CV_32FC1)
    u, v = maps
    h, w = image.shape[:2]
    valid = (u >= 0) & (u <= w - 1) & (v >= 0) & (v <= h - 1)
    return cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), valid


def ray_grid(view: View, rectification: Rectification, camera: CameraModel, stride: int) -> F32:
    """Directions x/z, y/z (rows, columns, 2) float32 in the camera frame, at every `stride`-th rectified pixel.

    They are the rays of the photo's own pixels under `camera`, which may differ from the camera that the pair was
    rectified with: what was measured are pixels.
    """
    u = np.arange(0, rectification.width + stride, stride, dtype=float)
    v = np.arange(0, rectification.height + stride, stride, dtype=float)
    uv = np.stack(np.meshgrid(u, v), axis=-1)
    d_rect = np.empty((*uv.shape[:2], 3))
    d_rect[..., 0] = (uv[..., 0] - view.cx) / rectification.focal
    d_rect[..., 1] = (uv[..., 1] - rectification.cy) / rectification.focal
    d_rect[..., 2] = 1.0
    d_cam = d_rect @ view.R_rect_cam
    if camera != view.camera:
        d_cam = camera.rays(view.camera.project(d_cam))
    return np.asarray(d_cam[..., :2] / d_cam[..., 2:3], np.float32)


def _rotation(baseline: F64, axes: F64) -> F64 | None:
    """R_rect_world (3, 3): rows along the baseline, z near the sum of the optical axes; None if they are parallel."""
    x = baseline / max(float(np.linalg.norm(baseline)), 1e-12)
    z = axes - (axes @ x) * x
    norm = float(np.linalg.norm(z))
    if norm < 0.5:
        return None
    z = z / norm
    return np.stack([x, np.cross(z, x), z])


def _common_ground(a: F64, b: F64) -> F64 | None:
    """Corners (M, 2) m of the ground that both footprints cover."""
    origin = a[0]
    area, corners = cv2.intersectConvexConvex((a - origin).astype(np.float32), (b - origin).astype(np.float32))
    if area <= 0 or corners is None:
        return None
    return np.asarray(corners.reshape(-1, 2) + origin, np.float64)
