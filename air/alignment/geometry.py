"""Two-view geometry, resection and triangulation: first values for the adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import F64, I64, Bool
from common.camera import CameraModel
from common.se3 import SE3

CONFIDENCE = 0.999
NEARLY_ALL = 0.9
"""Share of the most matches that a rival pose must explain to be a rival."""


@dataclass(frozen=True, eq=False)
class PairPrior:
    """What is known of two views without their matches: where down is in each camera, and how steep the step is.

    Unit vectors `down_a`, `down_b` (3,) with `down_sigma` rad; `descent` is the part of the step from a to b that
    points down, of a step of length one, with `descent_sigma`.
    """

    down_a: F64
    down_b: F64
    down_sigma: float
    descent: float
    descent_sigma: float

    def cost(self, T_a_b: SE3) -> float:
        """How far a relative pose is from what is known, in squared sigmas."""
        tilt = np.arccos(np.clip(self.down_a @ T_a_b.R @ self.down_b, -1.0, 1.0)) / self.down_sigma
        descent = (self.down_a @ T_a_b.t - self.descent) / self.descent_sigma
        return float(tilt**2 + descent**2)


def relative_pose(
    camera_a: CameraModel, camera_b: CameraModel, uv_a: F64, uv_b: F64, threshold_px: float, prior: PairPrior
) -> tuple[SE3, Bool] | None:
    """`T_a_b` with a translation of length one and the mask (M,) of matches that agree; None if there is none.

    Flat ground has two explanations that fit equally well (Longuet-Higgins, 1986), so the essential matrix (five
    points, USAC) and the homography are both taken apart, and of all the poses that explain nearly as many matches as
    the best the one nearest to the prior is chosen.
    """
    xy_a, xy_b = camera_a.rays(uv_a)[:, :2], camera_b.rays(uv_b)[:, :2]
    threshold = threshold_px / camera_a.fx
    candidates = [(T_a_b, _agreeing(T_a_b, xy_a, xy_b, threshold)) for T_a_b in _pose_candidates(xy_a, xy_b, threshold)]
    most = max((int(mask.sum()) for _, mask in candidates), default=0)
    good = [c for c in candidates if c[1].sum() > NEARLY_ALL * most]
    return min(good, key=lambda c: prior.cost(c[0])) if most else None


def _pose_candidates(xy_a: F64, xy_b: F64, threshold: float) -> list[SE3]:
    cv2.setRNGSeed(0)
    R_b_a: list[tuple[F64, F64]] = []
    E, _ = cv2.findEssentialMat(xy_a, xy_b, np.eye(3), cv2.USAC_MAGSAC, CONFIDENCE, threshold, maxIters=3000)
    if E is not None and E.shape == (3, 3):
        R1, R2, t = cv2.decomposeEssentialMat(E)
        R_b_a += [(R, sign * t) for R in (R1, R2) for sign in (1.0, -1.0)]
    H, _ = cv2.findHomography(xy_a, xy_b, cv2.USAC_MAGSAC, threshold, maxIters=3000, confidence=CONFIDENCE)
    if H is not None:
        _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
        R_b_a += [(R, t / np.linalg.norm(t)) for R, t in zip(rotations, translations, strict=True) if t.any()]
    return [SE3(R, t.ravel()).inverse() for R, t in R_b_a]


def _agreeing(T_a_b: SE3, xy_a: F64, xy_b: F64, threshold: float) -> Bool:
    """Matches (M,) whose triangulated point lies in front of both cameras and appears where it was seen."""
    homogeneous = [np.column_stack([xy, np.ones(len(xy))]) for xy in (xy_a, xy_b)]
    p_a, _ = triangulate_pair(T_a_b, *homogeneous)
    p_b = T_a_b.inverse().apply(p_a)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = [np.linalg.norm(p[:, :2] / p[:, 2:] - xy, axis=1) for p, xy in ((p_a, xy_a), (p_b, xy_b))]
        return np.asarray((np.maximum(*error) < threshold) & (p_a[:, 2] > 0) & (p_b[:, 2] > 0))


def resect(camera: CameraModel, p_world: F64, uv: F64, threshold_px: float) -> tuple[SE3, Bool] | None:
    """`T_world_cam` from points (M, 3) m seen at (M, 2) px, with the mask (M,) of those that agree; None if none.

    Perspective-n-point in RANSAC, refined on the inliers.
    """
    cv2.setRNGSeed(0)
    centre = p_world.mean(axis=0)
    xy = camera.rays(uv)[:, :2]
    found, rvec, tvec, inliers = cv2.solvePnPRansac(
        p_world - centre,
        xy,
        np.eye(3),
        None,
        iterationsCount=500,
        reprojectionError=threshold_px / camera.fx,
        confidence=CONFIDENCE,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None:
        return None
    mask = np.zeros(len(uv), bool)
    mask[inliers.ravel()] = True
    rvec, tvec = cv2.solvePnPRefineLM(p_world[mask] - centre, xy[mask], np.eye(3), None, rvec, tvec)
    R = cv2.Rodrigues(rvec)[0]
    T_centre_cam = SE3(R, tvec.ravel()).inverse()
    return SE3(T_centre_cam.R, T_centre_cam.t + centre), mask


def triangulate(rays: F64, centres: F64, point: I64, count: int) -> tuple[F64, F64]:
    """Points (count, 3) nearest to their rays, and the angle (count,) rad that the rays of each open.

    Unit rays (M, 3) through centres (M, 3) belong to points `point` (M,). Least squares of the distances to the rays;
    NaN and angle 0 where the rays do not meet.
    """
    projectors = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    A, b, mean = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    np.add.at(A, point, projectors)
    np.add.at(b, point, np.einsum("nij,nj->ni", projectors, centres))
    np.add.at(mean, point, rays)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    # Twice the widest deviation from the mean direction: exact for two rays, a close bound for more.
    widest = np.zeros(count)
    np.maximum.at(widest, point, np.arccos(np.clip(np.sum(rays * mean[point], axis=1), -1.0, 1.0)))
    meet = np.linalg.det(A) > 1e-12
    points = np.full((count, 3), np.nan)
    points[meet] = np.linalg.solve(A[meet], b[meet][..., None])[..., 0]
    return points, np.where(meet, 2.0 * widest, 0.0)


def triangulate_pair(T_a_b: SE3, rays_a: F64, rays_b: F64) -> tuple[F64, F64]:
    """Points (M, 3) in frame a from rays (M, 3) of a and of b, and the angles (M,) rad between them.

    Midpoint of the common perpendicular. NaN where the rays are parallel.
    """
    a = rays_a / np.linalg.norm(rays_a, axis=1, keepdims=True)
    b = (rays_b / np.linalg.norm(rays_b, axis=1, keepdims=True)) @ T_a_b.R.T
    cosine = np.clip(np.sum(a * b, axis=1), -1.0, 1.0)
    sine2 = 1.0 - cosine**2
    along_a, along_b = a @ T_a_b.t, b @ T_a_b.t
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (along_a - cosine * along_b) / sine2
        t = (cosine * along_a - along_b) / sine2
    points = 0.5 * (s[:, None] * a + T_a_b.t + t[:, None] * b)
    points[(sine2 < 1e-10) | (s <= 0) | (t <= 0)] = np.nan
    return points, np.arccos(cosine)


def reprojection_error(camera: CameraModel, T_world_cam: SE3, p_world: F64, uv: F64) -> F64:
    """Distance (M,) px between where points (M, 3) m should appear and where they were seen; ∞ behind the camera."""
    projected = camera.project(T_world_cam.inverse().apply(p_world))
    error = np.linalg.norm(projected - uv, axis=1)
    return np.asarray(np.where(np.isfinite(error), error, np.inf))
