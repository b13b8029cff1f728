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
    """What one frame sees: its pose, and ideal image points (N, 2) px of the points `ids` (N,)."""

    T_world_cam: SE3
    ids: I64
    xy: F64


@dataclass(frozen=True, eq=False)
class Misses:
    """M observations: index of the view, id of the point, distance px from where it should appear (∞ behind)."""

    view: I64
    id: I64
    error: F64


def locate(views: Sequence[View], ids: I64, focal: float, min_angle: float, limit_px: float) -> dict[int, F64]:
    """Points (3,) m in world, by id, that rays from at least two views determine. `ids` rise.

    Their rays open by `min_angle` rad at least, they lie before all cameras, and appear within `limit_px` of where they
    were seen.
    """
    seen = _gather(views, ids)
    if not len(seen.row):
        return {}
    rays = np.column_stack([seen.xy / focal, np.ones(len(seen.xy))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    R, t = _poses(views, seen.view)
    points, angles = triangulate(np.einsum("nij,nj->ni", R, rays), t, seen.row, len(ids))
    worst = np.zeros(len(ids))
    np.maximum.at(worst, seen.row, _errors(R, t, points[seen.row], seen.xy, focal))
    good = (angles >= min_angle) & (worst <= limit_px) & (np.bincount(seen.row, minlength=len(ids)) >= 2)
    return {int(ids[i]): points[i] for i in np.flatnonzero(good)}


def misses(views: Sequence[View], ids: I64, points: F64, focal: float) -> Misses:
    """How far points (N, 3) m in world, whose `ids` (N,) rise, appear from where they were seen."""
    seen = _gather(views, ids)
    R, t = _poses(views, seen.view)
    return Misses(seen.view, ids[seen.row], _errors(R, t, points[seen.row], seen.xy, focal))


def depths(points: Mapping[int, F64], T_world_cam: SE3) -> dict[int, float]:
    """Distance m along the camera's axis of points (3,) m in world, by id; those before the camera."""
    if not points:
        return {}
    z = T_world_cam.inverse().apply(np.array(list(points.values())))[:, 2]
    return {i: float(d) for i, d in zip(points, z, strict=True) if d > 0}


@dataclass(frozen=True, eq=False)
class _Seen:
    """M observations: index of the view, row of the id, ideal image point px."""

    view: I64
    row: I64
    xy: F64


def _gather(views: Sequence[View], ids: I64) -> _Seen:
    view, row, xy = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros((0, 2))]
    for v, one in enumerate(views):
        rows = np.searchsorted(ids, one.ids)
        found = np.flatnonzero(np.isin(one.ids, ids))
        view.append(np.full(len(found), v))
        row.append(rows[found])
        xy.append(one.xy[found])
    return _Seen(np.concatenate(view), np.concatenate(row), np.concatenate(xy))


def _poses(views: Sequence[View], view: I64) -> tuple[F64, F64]:
    """`R_world_cam` (M, 3, 3) and positions (M, 3) m of the views of M observations."""
    R = np.array([v.T_world_cam.R for v in views]).reshape(-1, 3, 3)
    return R[view], np.array([v.T_world_cam.t for v in views]).reshape(-1, 3)[view]


def _errors(R: F64, t: F64, p_world: F64, xy: F64, focal: float) -> F64:
    """Distances (M,) px in the image; ∞ behind the camera."""
    p_cam = np.einsum("nji,nj->ni", R, p_world - t)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(focal * p_cam[:, :2] / p_cam[:, 2:] - xy, axis=1)
    return np.asarray(np.where((p_cam[:, 2] > 0) & np.isfinite(error), error, np.inf))
