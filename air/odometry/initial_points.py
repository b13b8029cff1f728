"""The points from which a beginning in flight is told: those near enough to show how the aircraft moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from air.odometry.tracker import TrackedFrame
from common.arrays import F64, I64

MIN_POINTS, MIN_VIEWS = 20, 3
NEAR = 1 / 3
"""Points whose rays open less than this share of the parallax that is asked for are far."""
ASTRAY_PX, ROUNDS = 3.0, 10


@dataclass(frozen=True, eq=False)
class InitialPoints:
    """M observations of P points: index of the frame and of the point, unit direction (M, 3) in the first body frame,
    the time (M,) s of its row after its frame's; the angle (P,) rad that the rays of each point open."""

    frame: I64
    point: I64
    direction: F64
    row_dt_s: F64
    angle: F64


def near_points(
    frames: Sequence[TrackedFrame], R_first_cam: F64, parallax: float, focal: float
) -> tuple[InitialPoints | None, float]:
    """The near points of frames whose cameras turned as `R_first_cam` (N, 3, 3), and the median angle rad they open.

    None where that is below `parallax`, or where there are too few. Far points tell how the camera turned, which the
    gyroscope knows better, and points that leave the plane of their ray and the direction of travel move themselves.
    """
    frame = np.concatenate([np.full(len(f.ids), i) for i, f in enumerate(frames)])
    ids, rays = np.concatenate([f.ids for f in frames]), np.concatenate([f.rays for f in frames])
    direction = np.einsum("nij,nj->ni", R_first_cam[frame], rays)
    known, first, point, counts = np.unique(ids, return_index=True, return_inverse=True, return_counts=True)
    last = len(ids) - 1 - np.unique(ids[::-1], return_index=True)[1]
    angle = np.arccos(np.clip(np.sum(direction[first] * direction[last], axis=1), -1.0, 1.0))
    moving = _moving(frames, [direction[frame == i] for i in range(len(frames))], ASTRAY_PX / focal)
    near = (counts >= MIN_VIEWS) & (angle > NEAR * parallax) & ~np.isin(known, moving)
    if near.sum() < MIN_POINTS:
        return None, float(np.median(angle[counts >= MIN_VIEWS])) if (counts >= MIN_VIEWS).any() else 0.0
    opened = float(np.median(angle[near]))
    if opened < parallax:
        return None, opened
    used = near[point]
    kept, point = np.unique(point[used], return_inverse=True)
    row_dt_s = np.concatenate([f.row_dt_s for f in frames])[used]
    return InitialPoints(frame[used], point, direction[used], row_dt_s, angle[kept]), opened


def _moving(frames: Sequence[TrackedFrame], directions: Sequence[F64], limit: float) -> I64:
    """Ids of the points that miss, by more than `limit` rad between successive frames, where travel leads them."""
    ids = [np.zeros(0, np.int64)]
    for (a, seen_a), (b, seen_b) in pairwise(zip(frames, directions, strict=True)):
        common, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
        if len(common) >= MIN_POINTS:
            ids.append(common[_miss(seen_a[in_a], seen_b[in_b]) > limit])
    return np.unique(np.concatenate(ids))


def _miss(a: F64, b: F64) -> F64:
    """Angles (M,) rad by which rays (M, 3) and (M, 3) miss the planes through one direction of travel."""
    normals, weight, miss = np.cross(a, b), np.ones(len(a)), np.zeros(len(a))
    for _ in range(ROUNDS):
        travel = np.linalg.eigh((normals * weight[:, None]).T @ normals)[1][:, 0]
        sine = np.maximum(np.linalg.norm(np.cross(a, travel), axis=1), 1e-3)
        miss = np.abs(normals @ travel) / sine / np.sqrt(2.0)
        weight = 1.0 / (1.0 + (miss / max(1.5 * float(np.median(miss)), 1e-9)) ** 2)
    return miss
