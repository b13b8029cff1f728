"""Which photos to match with which: the geometry of a pair, judged over flat ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from air.mapping.settings import MappingSettings
from common.arrays import F64
from common.messages import Keyframe

# Beyond this angle between the optical axes, windows look too different to compare them.
MAX_AXES_ANGLE = np.radians(25.0)
# A camera must look down at least this steeply everywhere: rays nearer to the horizon meet no known ground.
MIN_RAY_DESCENT = 0.25
# Baseline ratios that differ by this factor (natural logarithm) from the best one lose 1 - 1/e of their score.
BASELINE_SPREAD = 0.7


@dataclass(frozen=True)
class PairGeometry:
    """How two photos see the same ground.

    `baseline_ratio` baseline over mean height above ground, `overlap` share of the smaller footprint,
    `direction` (2,) unit vector in world from the first to the second camera, `score` in [0, 1].
    """

    baseline_ratio: float
    overlap: float
    direction: F64
    score: float


def footprint(keyframe: Keyframe, ground_height: float) -> F64 | None:
    """Corners (4, 2) m in world of the photo on the plane z = `ground_height`, None where it sees the horizon."""
    camera = keyframe.camera
    u, v = camera.width - 1.0, camera.height - 1.0
    rays = camera.rays(np.array([[0, 0], [u, 0], [u, v], [0, v]])) @ keyframe.T_world_cam.R.T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    height = keyframe.T_world_cam.t[2] - ground_height
    if height <= 0 or not np.all(rays[:, 2] < -MIN_RAY_DESCENT):
        return None
    return np.asarray(keyframe.T_world_cam.t[:2] + rays[:, :2] * (height / -rays[:, 2:3]))


def pair_geometry(a: Keyframe, b: Keyframe, ground_height: float, settings: MappingSettings) -> PairGeometry | None:
    """Geometry of the pair over flat ground, or None where matching it would be of no use."""
    baseline = b.T_world_cam.t - a.T_world_cam.t
    length = float(np.linalg.norm(baseline))
    heights = [k.T_world_cam.t[2] - ground_height for k in (a, b)]
    if not np.isfinite(length) or min(heights) <= 0:
        return None
    ratio = length / float(np.mean(heights))
    if not settings.min_baseline_ratio <= ratio <= settings.max_baseline_ratio or max(heights) > 1.5 * min(heights):
        return None
    if a.T_world_cam.R[:, 2] @ b.T_world_cam.R[:, 2] < np.cos(MAX_AXES_ANGLE):
        return None
    overlap = _overlap(footprint(a, ground_height), footprint(b, ground_height))
    if overlap < settings.min_overlap:
        return None
    stretch = np.log(ratio / settings.best_baseline_ratio) / BASELINE_SPREAD
    horizontal = baseline[:2] / max(float(np.linalg.norm(baseline[:2])), 1e-9)
    return PairGeometry(ratio, overlap, horizontal, overlap * float(np.exp(-(stretch**2))))


def choose_partners(
    keyframe: Keyframe, others: Sequence[Keyframe], ground_height: float, settings: MappingSettings
) -> list[Keyframe]:
    """The best partners of a keyframe, at most `settings.partners`, best first.

    A partner in a direction that is already served counts half, so that one ahead and one behind are preferred to
    two ahead: together they see more of the photo.
    """
    reach = settings.max_baseline_ratio * (keyframe.T_world_cam.t[2] - ground_height) * 1.5
    candidates: list[tuple[Keyframe, PairGeometry]] = []
    for other in others:
        near = np.linalg.norm(other.T_world_cam.t - keyframe.T_world_cam.t) <= reach
        geometry = pair_geometry(keyframe, other, ground_height, settings) if near else None
        if geometry is not None and other.index != keyframe.index:
            candidates.append((other, geometry))
    chosen: list[tuple[Keyframe, PairGeometry]] = []
    while candidates and len(chosen) < settings.partners:
        best = max(candidates, key=lambda c: (_score_beside(c[1], [g for _, g in chosen]), -c[0].index))
        candidates.remove(best)
        chosen.append(best)
    return [other for other, _ in chosen]


def _score_beside(geometry: PairGeometry, chosen: Sequence[PairGeometry]) -> float:
    served = any(float(geometry.direction @ other.direction) > np.cos(np.radians(60.0)) for other in chosen)
    return geometry.score * (0.5 if served else 1.0)


def _overlap(a: F64 | None, b: F64 | None) -> float:
    """Common area of two convex quadrilaterals as a share of the smaller one."""
    if a is None or b is None:
        return 0.0
    local_a, local_b = ((corners - a[0]).astype(np.float32) for corners in (a, b))
    smaller = min(cv2.contourArea(local_a), cv2.contourArea(local_b))
    common, _ = cv2.intersectConvexConvex(local_a, local_b)
    return float(common / smaller) if smaller > 0 else 0.0
