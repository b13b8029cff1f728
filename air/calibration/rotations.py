"""How a camera turned between its frames, from tracked features alone."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from common.arrays import F64, U8
from common.camera import CameraModel
from common.se3 import rotation_vector, rotation_vector_to_matrix, skew

FEATURES = 400
MIN_TRACKS = 30
"""Tracks without which a turn is not believed."""
RETURN_PX = 0.5
"""A track that does not come back so close to where it began is wrong."""
INLIER_PX = 1.0
ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Turn:
    """How the camera turned between two frames: `rotation` (3,) rad maps directions of the later one to the earlier."""

    begin_ns: int
    end_ns: int
    rotation: F64


class TurnTracker:
    """Grey images in the order of time → the turn from each to the next."""

    def __init__(self, camera: CameraModel) -> None:
        self._camera = camera
        self._last: tuple[int, U8] | None = None

    def add(self, t_ns: int, grey: U8) -> Turn | None:
        """The turn since the image before, None where too little could be tracked."""
        last, self._last = self._last, (t_ns, grey)
        if last is None or grey.shape != last[1].shape or t_ns <= last[0]:
            return None
        before, after = _tracks(last[1], grey)
        if len(before) < MIN_TRACKS:
            return None
        rotation = turn_between(self._camera.rays(before), self._camera.rays(after), INLIER_PX / self._camera.fx)
        return None if rotation is None else Turn(last[0], t_ns, rotation)


def _tracks(before: U8, after: U8) -> tuple[F64, F64]:
    """Pixels (N, 2) of the same points in both images, by Lucas–Kanade there and back."""
    start = cv2.goodFeaturesToTrack(before, FEATURES, 0.01, 12)
    if start is None:
        return np.empty((0, 2)), np.empty((0, 2))
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, start, None, winSize=(21, 21), maxLevel=4)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None, winSize=(21, 21), maxLevel=4)
    start, there, back = (np.asarray(points, float).reshape(-1, 2) for points in (start, there, back))
    good = (found.ravel() == 1) & (returned.ravel() == 1) & (np.linalg.norm(back - start, axis=1) < RETURN_PX)
    return start[good], there[good]


def turn_between(before: F64, after: F64, inlier: float) -> F64 | None:
    """Rotation vector (3,) rad that maps rays `after` (N, 3), z = 1, into the frame of `before`; None without one.

    The essential matrix, then Gauss–Newton on Sampson's distance with rotation and direction of travel (Hartley &
    Zisserman, section 11.4). Without travel its direction is arbitrary, and the rotation still right.
    """
    E, mask = cv2.findEssentialMat(before[:, :2], after[:, :2], np.eye(3), cv2.USAC_ACCURATE, 0.999, inlier)
    if E is None or E.shape != (3, 3) or mask is None or mask.sum() < MIN_TRACKS:
        return None
    used = mask.ravel() > 0
    # Of the two rotations of an essential matrix the other one is half a turn away, which no frame is from the next.
    R, twisted, travel = (np.asarray(part) for part in cv2.decomposeEssentialMat(E))
    R = min((R, twisted), key=lambda R: -np.trace(R)).T
    return rotation_vector(_refined(R, -R @ travel.ravel(), before[used], after[used]))


def turn_alone(before: F64, after: F64) -> F64:
    """Rotation vector (3,) rad that maps rays `after` (N, 3) into the frame of `before`, small, of a far scene.

    Least squares with Cauchy's weights, which forget what is near and moves otherwise.
    """
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (before, after))
    J = np.cross(np.eye(3), b[:, None, :]).transpose(0, 2, 1)  # how each ray moves with the turn
    weight, turn = np.ones(len(a)), np.zeros(3)
    for _ in range(ROUNDS):
        H = np.einsum("nji,n,njk->ik", J, weight, J)
        turn = np.linalg.solve(H, np.einsum("nji,n,nj->i", J, weight, a - b))
        off = np.linalg.norm(a - b - J @ turn, axis=1)
        weight = 1.0 / (1.0 + (off / (np.median(off) + 1e-9)) ** 2)
    return np.asarray(turn)


def _refined(R: F64, travel: F64, before: F64, after: F64) -> F64:
    """The rotation after Gauss–Newton with Cauchy's weights, which forget tracks that are far off."""
    for _ in range(ROUNDS):
        aside = np.linalg.svd(travel[None])[2][1:]  # two directions across the travel
        residual = _sampson(R, travel, before, after)
        steps = [(rotation_vector_to_matrix(1e-6 * axis) @ R, travel) for axis in np.eye(3)]
        steps += [(R, travel + 1e-6 * axis) for axis in aside]
        J = np.stack([(_sampson(*step, before, after) - residual) / 1e-6 for step in steps], axis=1)
        scale = 2.0 * np.median(np.abs(residual)) + 1e-9
        weight = 1.0 / (1.0 + (residual / scale) ** 2)
        H = J.T @ (J * weight[:, None])
        change = -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(5), J.T @ (weight * residual))
        R = rotation_vector_to_matrix(change[:3]) @ R
        travel = travel + change[3:] @ aside
        travel = travel / np.linalg.norm(travel)
    return R


def _sampson(R: F64, travel: F64, before: F64, after: F64) -> F64:
    """Signed distances (N,) of the pairs from the epipolar geometry, to first order."""
    E = skew(travel) @ R
    line, back = after @ E.T, before @ E
    size = np.sqrt(line[:, 0] ** 2 + line[:, 1] ** 2 + back[:, 0] ** 2 + back[:, 1] ** 2)
    return np.asarray(np.sum(before * line, axis=1) / np.maximum(size, 1e-12))
