"""Where a freely reconstructed block lies in the world: the similarity that fits its cameras to what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from air.alignment.bundle import DOWN, HUBER, PosePrior
from common.arrays import F64
from common.se3 import SE3, rotation_vector_to_matrix, skew

ITERATIONS = 15
JUDGE_FROM = 5
"""Fixes from which their own scatter tells how good they are."""
RAYLEIGH_MEDIAN, NORMAL_MEDIAN = 1.1774, 0.6745
"""Median length of a two-dimensional error of sigma one, and median size of a one-dimensional one."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """Map `p ↦ scale · R p + t` from a free frame into the world."""

    scale: float
    R: F64
    t: F64

    def points(self, p: F64) -> F64:
        """Points (..., 3) in the world, m."""
        return np.asarray(self.scale * (p @ self.R.T) + self.t)

    def pose(self, T: SE3) -> SE3:
        """A camera pose of the free frame in the world."""
        return SE3(self.R @ T.R, self.points(T.t))


@dataclass(frozen=True, eq=False)
class Georeference:
    """The similarity, and by which factor (≥ 1) the fixes are worse than they say, horizontally and vertically."""

    similarity: Similarity
    horizontal_factor: float
    vertical_factor: float


def georeference(poses: Sequence[SE3], priors: Sequence[PosePrior]) -> Georeference | None:
    """The similarity that brings the cameras to their priors; None with fewer than two distinct positions.

    Upright by where the cameras say down is, turned and scaled by the horizontal
    positions: a start that one straight strip determines and that heights cannot spoil. Then Gauss–Newton on all
    priors with Huber weights, in which the scatter of the fixes decides how much they count (variance components):
    receivers in cameras drift by tens of metres in height while they say nothing of it.
    """
    located = [i for i, p in enumerate(priors) if p.p_world is not None]
    if len(located) < 2:
        return None
    start = _start(poses, priors, located)
    return None if start is None else _refine(start, poses, priors, located)


def _start(poses: Sequence[SE3], priors: Sequence[PosePrior], located: list[int]) -> Similarity | None:
    down = sum((T.R @ p.down_cam / p.down_sigma**2 for T, p in zip(poses, priors, strict=True)), np.zeros(3))
    R_up = _rotation_between(down / np.linalg.norm(down), DOWN)
    free = np.array([R_up @ poses[i].t for i in located])
    fixes = np.array([priors[i].p_world for i in located])
    free_mid, fix_mid = np.median(free, axis=0), np.median(fixes, axis=0)
    a, b = free - free_mid, fixes - fix_mid
    power = float(np.sum(a[:, :2] ** 2))
    if power < 1e-12:
        return None
    cosine = float(np.sum(a[:, :2] * b[:, :2])) / power
    sine = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) / power
    scale = float(np.hypot(cosine, sine))
    if scale < 1e-9:
        return None
    R = rotation_vector_to_matrix(np.array([0.0, 0.0, np.arctan2(sine, cosine)])) @ R_up
    return Similarity(scale, R, fix_mid - scale * (R @ R_up.T @ free_mid))


def _refine(
    start: Similarity, poses: Sequence[SE3], priors: Sequence[PosePrior], located: list[int]
) -> Georeference | None:
    scale, R = start.scale, start.R
    middle = np.mean([poses[i].t for i in located], axis=0)
    centre = start.points(middle)
    free = np.array([poses[i].t for i in located]) - middle
    fixes = np.array([priors[i].p_world for i in located])
    sigma = np.array([priors[i].p_sigma for i in located])
    factors = np.ones(3)
    for _ in range(ITERATIONS):
        arm = scale * free @ R.T
        residual: F64 = arm + centre - fixes
        factors = _factors(residual / sigma)
        J, r = _position_rows(arm, residual, sigma * factors)
        J_att, r_att = _attitude_rows(R, poses, priors)
        J, r = np.vstack([J, J_att]), np.concatenate([r, r_att])
        step = np.asarray(np.linalg.lstsq(J, -r, rcond=None)[0], np.float64)
        R = rotation_vector_to_matrix(step[:3]) @ R
        scale *= float(np.exp(np.clip(step[3], -0.5, 0.5)))
        centre = np.asarray(centre + step[4:], np.float64)
    similarity = Similarity(scale, R, centre - scale * (R @ middle))
    return Georeference(similarity, float(factors[0]), float(factors[2]))


def _factors(whitened: F64) -> F64:
    """How many times larger than stated the residuals (N, 3) are on their axes, at least 1; robust."""
    if len(whitened) < JUDGE_FROM:
        return np.ones(3)
    horizontal = float(np.median(np.linalg.norm(whitened[:, :2], axis=1))) / RAYLEIGH_MEDIAN
    vertical = float(np.median(np.abs(whitened[:, 2]))) / NORMAL_MEDIAN
    return np.array([max(1.0, horizontal), max(1.0, horizontal), max(1.0, vertical)])


def _position_rows(arm: F64, residual: F64, sigma: F64) -> tuple[F64, F64]:
    """Jacobian (3N, 7) by rotation, log scale and centre, and residuals (3N,), whitened and weighted."""
    J = np.zeros((len(arm), 3, 7))
    for row, a in zip(J, arm, strict=True):
        row[:, :3] = -skew(a)
    J[:, :, 3] = arm
    J[:, :, 4:] = np.eye(3)
    white = residual / sigma
    size = np.stack([np.hypot(white[:, 0], white[:, 1])] * 2 + [np.abs(white[:, 2])], axis=1)
    weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(size, 1e-9)))
    return (J * (weight / sigma)[:, :, None]).reshape(-1, 7), (white * weight).ravel()


def _attitude_rows(R: F64, poses: Sequence[SE3], priors: Sequence[PosePrior]) -> tuple[F64, F64]:
    rows, residuals = [], []
    for T, prior in zip(poses, priors, strict=True):
        down = R @ T.R @ prior.down_cam
        r, J = down[:2] / prior.down_sigma, -skew(down)[:2] / prior.down_sigma
        weight = np.sqrt(min(1.0, HUBER / max(float(np.linalg.norm(r)), 1e-9)))
        rows.append(np.hstack([J, np.zeros((2, 4))]) * weight)
        residuals.append(r * weight)
    return np.vstack(rows), np.concatenate(residuals)


def _rotation_between(a: F64, b: F64) -> F64:
    """The smallest rotation (3, 3) that turns the unit vector a (3,) into b (3,)."""
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return rotation_vector_to_matrix(axis / sine * np.arctan2(sine, cosine))
