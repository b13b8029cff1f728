"""From stored pixel correspondences to points, with whatever poses and intrinsics are best at the moment.

What was measured are pixels in two photos; the geometry is the model. So a better adjustment needs no new matching.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from air.mapping.matching import DisparityMap
from air.mapping.rectification import Rectification, ray_grid
from common.arrays import F32, F64, U8
from common.messages import Keyframe

I16 = npt.NDArray[np.int16]

# Rays change smoothly over the image: between nodes this far apart linear interpolation errs below 0.01 px.
RAY_STRIDE = 16
DISPARITY_STEPS = 64.0
SIGMA_STEPS = 512.0
UNKNOWN = -32768
# Poses that are wrong together move a whole pair: what remains after a good adjustment, px of the matched image.
POSE_SIGMA_PX = 0.10
# Rays that pass each other at more than this many pixels belong to a wrong pose.
MAX_GAP_PX = 4.0


@dataclass(frozen=True, eq=False)
class Correspondences:
    """What matching measured once for a pair: 6 bytes a pixel, kept as long as the photos may still move.

    `disparity` (h, w) int16 in 1/64 px, `sigma` (h, w) uint8 in 1/512 px, `colour` (h, w, 3) uint8 of the left photo.
    """

    rectification: Rectification
    disparity: I16
    sigma: U8
    colour: U8

    @staticmethod
    def of(rectification: Rectification, result: DisparityMap, colour: U8) -> Correspondences:
        """The disparities packed into few bytes."""
        steps = np.clip(np.nan_to_num(result.disparity) * DISPARITY_STEPS, -32767, 32767)
        disparity = np.where(np.isfinite(result.disparity), np.rint(steps), UNKNOWN).astype(np.int16)
        sigma = np.clip(np.nan_to_num(result.sigma) * SIGMA_STEPS, 1, 255).astype(np.uint8)
        return Correspondences(rectification, disparity, sigma, colour)

    @property
    def share(self) -> float:
        """Share of the canvas that was matched."""
        return float(np.mean(self.disparity != UNKNOWN))


@dataclass(frozen=True, eq=False)
class PointGrid:
    """Points on the pixel grid of a pair, (h, w) or a subset of its rows and columns.

    `p_origin` (h, w, 3) float32 m, world axes, relative to `origin` (3,) float64 m in world; NaN where unknown.
    `sigma` (h, w) float32 m along the vertical; `radius` (h, w) float32, tangent of the angle off the left optical
    axis.
    """

    origin: F64
    p_origin: F32
    sigma: F32
    radius: F32


def triangulate(matches: Correspondences, left: Keyframe, right: Keyframe, step: int = 1) -> PointGrid:
    """Points midway between the rays of both photos, for every `step`-th row and column of the pair's canvas."""
    r = matches.rectification
    points, sigma, radius = _triangulate(
        matches.disparity,
        matches.sigma,
        ray_grid(r.left, r, left.camera, RAY_STRIDE),
        ray_grid(r.right, r, right.camera, RAY_STRIDE),
        np.ascontiguousarray(left.T_world_cam.R),
        np.ascontiguousarray(right.T_world_cam.R),
        right.T_world_cam.t - left.T_world_cam.t,
        r.focal,
        step,
    )
    return PointGrid(left.T_world_cam.t, points, sigma, radius)


def largest_move(before: PointGrid, after: PointGrid) -> float:
    """How far the surface moved, m: the 90 % quantile of the distances; infinite where no point is common."""
    moves = np.linalg.norm(after.p_origin.astype(float) - before.p_origin + (after.origin - before.origin), axis=-1)
    moves = moves[np.isfinite(moves)]
    return float(np.quantile(moves, 0.9)) if len(moves) else np.inf


@njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def _ray(grid: F32, u: float, v: float) -> tuple[float, float]:
    x, y = u / RAY_STRIDE, v / RAY_STRIDE
    j, i = int(x), int(y)
    a, b = x - j, y - i
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    return (
        w00 * grid[i, j, 0] + w01 * grid[i, j + 1, 0] + w10 * grid[i + 1, j, 0] + w11 * grid[i + 1, j + 1, 0],
        w00 * grid[i, j, 1] + w01 * grid[i, j + 1, 1] + w10 * grid[i + 1, j, 1] + w11 * grid[i + 1, j + 1, 1],
    )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _triangulate(
    disparity: I16,
    sigma_px: U8,
    left_rays: F32,
    right_rays: F32,
    R_left: F64,
    R_right: F64,
    baseline: F64,
    focal: float,
    step: int,
) -> tuple[F32, F32, F32]:
    h, w = disparity.shape
    rows, columns = (h + step - 1) // step, (w + step - 1) // step
    points = np.full((rows, columns, 3), np.nan, np.float32)
    sigma = np.full((rows, columns), np.nan, np.float32)
    radius = np.full((rows, columns), np.nan, np.float32)
    length = np.sqrt(baseline[0] ** 2 + baseline[1] ** 2 + baseline[2] ** 2)
    bx, by, bz = baseline[0], baseline[1], baseline[2]
    for i in range(rows):
        v = i * step
        for j in range(columns):
            u = j * step
            steps = disparity[v, u]
            if steps == UNKNOWN:
                continue
            u_right = u - steps / DISPARITY_STEPS
            if u_right < 0 or u_right > w - 1:
                continue
            x, y = _ray(left_rays, u, v)
            ax = R_left[0, 0] * x + R_left[0, 1] * y + R_left[0, 2]
            ay = R_left[1, 0] * x + R_left[1, 1] * y + R_left[1, 2]
            az = R_left[2, 0] * x + R_left[2, 1] * y + R_left[2, 2]
            p, q = _ray(right_rays, u_right, v)
            cx = R_right[0, 0] * p + R_right[0, 1] * q + R_right[0, 2]
            cy = R_right[1, 0] * p + R_right[1, 1] * q + R_right[1, 2]
            cz = R_right[2, 0] * p + R_right[2, 1] * q + R_right[2, 2]
            aa, cc, ac = ax * ax + ay * ay + az * az, cx * cx + cy * cy + cz * cz, ax * cx + ay * cy + az * cz
            ab, cb = ax * bx + ay * by + az * bz, cx * bx + cy * by + cz * bz
            determinant = aa * cc - ac * ac
            if determinant < 1e-9:
                continue
            s = (ab * cc - cb * ac) / determinant
            t = (ab * ac - cb * aa) / determinant
            if s <= 0 or t <= 0:
                continue
            gx, gy, gz = s * ax - bx - t * cx, s * ay - by - t * cy, s * az - bz - t * cz
            if gx * gx + gy * gy + gz * gz > (MAX_GAP_PX * s / focal) ** 2:
                continue
            points[i, j, 0] = s * ax - 0.5 * gx
            points[i, j, 1] = s * ay - 0.5 * gy
            points[i, j, 2] = s * az - 0.5 * gz
            px = sigma_px[v, u] / SIGMA_STEPS
            sigma[i, j] = s * s / (focal * length) * np.sqrt(px * px + POSE_SIGMA_PX * POSE_SIGMA_PX)
            radius[i, j] = np.sqrt(x * x + y * y)
    return points, sigma, radius
