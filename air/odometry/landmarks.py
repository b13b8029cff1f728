"""Points on the ground and elsewhere: where rays meet, and which observations do not belong.

All gates are relative: angles between rays and errors in sigmas, never metres, so they hold at any height.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from air.alignment.geometry import triangulate
from common.arrays import F64, I64
from common.se3 import SE3


@dataclass(frozen=True, eq=False)
class View:
    """What one frame sees: its pose, and ideal image points (2,) px by point."""

    T_world_cam: SE3
    xy: Mapping[int, F64]


def locate(
    views: Sequence[View], ids: Sequence[int], focal: float, min_angle: float, limit_px: float
) -> dict[int, F64]:
    """Points (3,) m in world, by id, that rays from at least two views determine.

    Their rays open by `min_angle` rad at least, they lie before all cameras, and appear within `limit_px` of where they
    were seen.
    """
    seen = _gather(views, ids)
    if not len(seen.row):
        return {}
    rays = np.column_stack([seen.xy / focal, np.ones(len(seen.xy))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R, t = np.array([v.T_world_cam.R for v in views])[seen.view], np.array([v.T_world_cam.t for v in views])[seen.view]
    points, angles = triangulate(np.einsum("nij,nj->ni", R, rays), t, seen.row, len(ids))
    worst = np.zeros(len(ids))
    np.maximum.at(worst, seen.row, _errors(R, t, points[seen.row], seen.xy, focal))
    good = (angles >= min_angle) & (worst <= limit_px) & (np.bincount(seen.row, minlength=len(ids)) >= 2)
    return {ids[i]: points[i] for i in np.flatnonzero(good).tolist()}


def outliers(views: Sequence[View], points: Mapping[int, F64], focal: float, limit_px: float) -> list[tuple[int, int]]:
    """Observations, as index of the view and id, further than `limit_px` from where their point should appear."""
    ids = list(points)
    seen = _gather(views, ids)
    if not len(seen.row):
        return []
    R, t = np.array([v.T_world_cam.R for v in views])[seen.view], np.array([v.T_world_cam.t for v in views])[seen.view]
    error = _errors(R, t, np.array(list(points.values()))[seen.row], seen.xy, focal)
    return [(int(seen.view[i]), ids[seen.row[i]]) for i in np.flatnonzero(~(error <= limit_px)).tolist()]


def depths(points: Mapping[int, F64], T_world_cam: SE3) -> dict[int, float]:
    """Distance m along the camera's axis of points (3,) m in world, by id; those before the camera."""
    if not points:
        return {}
    z = T_world_cam.inverse().apply(np.array(list(points.values())))[:, 2]
    return {i: float(d) for i, d in zip(points, z, strict=True) if d > 0}


def rms_px(views: Sequence[View], points: Mapping[int, F64], focal: float) -> float:
    """Root mean square distance px between where points should appear and were seen; 0 without any."""
    square, count = 0.0, 0
    for view in views:
        ids = [i for i in view.xy if i in points]
        if ids:
            p = view.T_world_cam.inverse().apply(np.array([points[i] for i in ids]))
            miss = focal * p[:, :2] / p[:, 2:] - np.array([view.xy[i] for i in ids])
            square, count = square + float(np.sum(miss**2)), count + len(ids)
    return float(np.sqrt(square / count)) if count else 0.0


@dataclass(frozen=True, eq=False)
class _Seen:
    """M observations: index of the view, row of the id, ideal image point px."""

    view: I64
    row: I64
    xy: F64


def _gather(views: Sequence[View], ids: Sequence[int]) -> _Seen:
    found = [(v, row, view.xy[i]) for row, i in enumerate(ids) for v, view in enumerate(views) if i in view.xy]
    if not found:
        return _Seen(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    view, row, xy = zip(*found, strict=True)
    return _Seen(np.array(view), np.array(row), np.array(xy))


def _errors(R: F64, t: F64, p_world: F64, xy: F64, focal: float) -> F64:
    """Distances (M,) px in the image; ∞ behind the camera."""
    p_cam = np.einsum("nji,nj->ni", R, p_world - t)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(focal * p_cam[:, :2] / p_cam[:, 2:] - xy, axis=1)
    return np.asarray(np.where((p_cam[:, 2] > 0) & np.isfinite(error), error, np.inf))
