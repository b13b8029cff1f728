"""The pinhole camera with Brown–Conrady distortion, as OpenCV and gtsam's Cal3DS2 define it.

Pixel (0, 0) is the centre of the upper left pixel. Camera frame: x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from common.arrays import F64, AnyFloat


@dataclass(frozen=True)
class CameraModel:
    """Intrinsics of an image of `width` × `height` px: focal lengths and principal point in px, distortion unitless."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def K(self) -> F64:
        """Calibration matrix (3, 3), px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> F64:
        """OpenCV's coefficients (4,): k1, k2, p1, p2."""
        return np.array([self.k1, self.k2, self.p1, self.p2])

    def scaled(self, factor: float) -> CameraModel:
        """The same camera for an image resized by `factor` (pixel centres at integers)."""
        return replace(
            self,
            width=round(self.width * factor),
            height=round(self.height * factor),
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
        )

    def distort(self, xy: AnyFloat) -> F64:
        """Distorted normalised coordinates (..., 2) of ideal ones (..., 2)."""
        x, y = np.asarray(xy[..., 0], float), np.asarray(xy[..., 1], float)
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * self.k2)
        return np.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def undistort(self, xy_distorted: AnyFloat, iterations: int = 8) -> F64:
        """Ideal normalised coordinates (..., 2) of distorted ones, by fixed-point iteration as in OpenCV."""
        target = np.asarray(xy_distorted, float)
        xy = target.copy()
        for _ in range(iterations):
            xy = xy + (target - self.distort(xy))
        return xy

    def project(self, p_cam: AnyFloat) -> F64:
        """Pixels (..., 2) of points (..., 3) m in the camera frame; NaN where a point is not in front."""
        z = np.asarray(p_cam[..., 2:3], float)
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(z > 1e-9, p_cam[..., :2] / z, np.nan)
        return self.distort(xy) * [self.fx, self.fy] + [self.cx, self.cy]

    def rays(self, uv: AnyFloat) -> F64:
        """Directions (..., 3) with z = 1 in the camera frame through pixels (..., 2)."""
        xy = self.undistort((np.asarray(uv, float) - [self.cx, self.cy]) / [self.fx, self.fy])
        return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
