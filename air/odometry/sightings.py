"""What frames see of points: where the points are, the poses of the body and the camera's mounting follow from it.

Points that only a few frames know are eliminated at once (the Schur complement of bundle adjustment: B. Triggs et al.,
Bundle Adjustment – A Modern Synthesis, 2000, section 6). All observations are worked out together, in arrays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from air.odometry.mounting import COLUMNS, DELAY, LENS, MOUNTING, SHIFT, TURN, Mounting
from common.arrays import F64, I64, Bool

HUBER = 1.345
"""Residuals beyond so many sigmas lose weight."""
NEAREST = 1e-3
"""Distance m along the camera's axis below which a point counts as behind it."""
BEHIND = 1000.0
"""What such an observation costs: no step should lead there."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What one frame sees: `ids` (N,) rise; `xy` (N, 2) px are ideal image points from the principal point, moved to
    where they were at the frame's time; they would be by `rate` (N, 2) px/s elsewhere if frames were later."""

    ids: I64
    xy: F64
    rate: F64

    @classmethod
    def nothing(cls) -> Seen:
        """Not a single point."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))

    def among(self, ids: I64) -> Seen:
        """Those that are among some points."""
        return self._rows(np.isin(self.ids, ids))

    def without(self, ids: I64) -> Seen:
        """The others."""
        return self._rows(~np.isin(self.ids, ids))

    def corrected(self, mounting: Mounting, focal: float) -> F64:
        """The ideal image points (N, 2) of a lens of `focal` px, were frames in time and the lens as calibrated."""
        zoom, centre = 1.0 + mounting.lens[0] / focal, mounting.lens[1:]
        return np.asarray((self.xy + mounting.delay_s * self.rate - centre) / zoom)

    def _rows(self, rows: Bool) -> Seen:
        return Seen(self.ids[rows], self.xy[rows], self.rate[rows])


@dataclass(frozen=True, eq=False)
class Lens:
    """An ideal camera: focal length and sigma of a point, px, and how it is mounted as far as known beforehand."""

    focal: float
    sigma: float
    nominal: Mounting


@dataclass(frozen=True, eq=False)
class Sightings:
    """M observations of P points from F frames.

    `frames` are keys of poses and `points` of points, of which the first `free` are eliminated; `frame` and `point`
    (M,) say by their indices who saw what, at `xy` and `rate` (M, 2). Each point is held where it is by `weak` (P,)
    1/m², so little that it only keeps the system regular.
    """

    lens: Lens
    frames: Sequence[int]
    points: Sequence[int]
    free: int
    frame: I64
    point: I64
    xy: F64
    rate: F64
    weak: F64

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squares in sigmas, of the larger ones less (Huber)."""
        seen = self._projected(values)
        size = np.linalg.norm(seen.residual, axis=1) / self.lens.sigma
        each = np.where(size < HUBER, size**2 / 2, HUBER * (size - HUBER / 2))
        return float(np.sum(np.where(seen.before, each, BEHIND)))

    def linearised(self, values: gtsam.Values) -> LinearSightings:
        """What they say about the change of everything else, with the free points eliminated."""
        seen = self._projected(values)
        size = np.linalg.norm(seen.residual, axis=1) / self.lens.sigma
        weight = np.where(seen.before, np.minimum(1.0, HUBER / np.maximum(size, 1e-9)), 0.0) / self.lens.sigma**2
        by_pose, by_mounting, by_point = self._derivatives(seen)
        G, g = self._of_frames(weight, seen.residual, by_pose, by_mounting)
        H, h, E = self._of_points(weight, seen.residual, by_pose, by_mounting, by_point)
        H += self.weak[:, None, None] * np.eye(3)
        free, kept, width = slice(0, self.free), slice(self.free, None), len(g)
        way = np.linalg.solve(H[free], np.concatenate([E[free], h[free, :, None]], axis=2))
        flat = E[free].reshape(-1, width)
        G -= flat.T @ way[:, :, :-1].reshape(-1, width)
        g -= flat.T @ way[:, :, -1].ravel()
        G, g = _with_points(G, g, H[kept], h[kept], E[kept])
        keys = [*self.frames, MOUNTING, *self.points[kept]]
        return LinearSightings(keys, G, g, self.points[free], self.frames, way)

    def _of_frames(self, weight: F64, residual: F64, by_pose: F64, by_mounting: F64) -> tuple[F64, F64]:
        """Normal equations of poses and mounting (width, width), right side (width,)."""
        F, width = len(self.frames), 6 * len(self.frames) + COLUMNS
        G, g = np.zeros((width, width)), np.zeros(width)
        fixed = slice(6 * F, width)
        for f in range(F):
            mine = self.frame == f
            own, W, r = slice(6 * f, 6 * f + 6), weight[mine, None, None], residual[mine].ravel()
            J, J_mounting = by_pose[mine].reshape(-1, 6), by_mounting[mine].reshape(-1, COLUMNS)
            WJ, WJ_mounting = (W * by_pose[mine]).reshape(-1, 6), (W * by_mounting[mine]).reshape(-1, COLUMNS)
            G[own, own], G[own, fixed] = WJ.T @ J, WJ.T @ J_mounting
            G[fixed, own] = G[own, fixed].T
            G[fixed, fixed] += WJ_mounting.T @ J_mounting
            g[own] = WJ.T @ r
            g[fixed] += WJ_mounting.T @ r
        return G, g

    def _of_points(
        self, weight: F64, residual: F64, by_pose: F64, by_mounting: F64, by_point: F64
    ) -> tuple[F64, F64, F64]:
        """Normal equations of each point: with itself (P, 3, 3), right sides (P, 3), with all else (P, 3, width)."""
        P, F = len(self.points), len(self.frames)
        W = weight[:, None, None] * by_point
        H, h, E_mounting = np.zeros((P, 3, 3)), np.zeros((P, 3)), np.zeros((P, 3, COLUMNS))
        np.add.at(H, self.point, W.transpose(0, 2, 1) @ by_point)
        np.add.at(h, self.point, np.einsum("nij,ni->nj", W, residual))
        np.add.at(E_mounting, self.point, W.transpose(0, 2, 1) @ by_mounting)
        E_pose = np.zeros((P, 3, F, 6))
        E_pose[self.point, :, self.frame, :] = W.transpose(0, 2, 1) @ by_pose
        return H, h, np.concatenate([E_pose.reshape(P, 3, 6 * F), E_mounting], axis=2)

    def _projected(self, values: gtsam.Values) -> _Projected:
        mounting = self.lens.nominal.corrected(values.atVector(MOUNTING))
        poses = [values.atPose3(key) for key in self.frames]
        R = np.array([pose.rotation().matrix() for pose in poses]).reshape(-1, 3, 3)[self.frame]
        t = np.array([pose.translation() for pose in poses]).reshape(-1, 3)[self.frame]
        p_world = np.array([values.atPoint3(key) for key in self.points]).reshape(-1, 3)[self.point]
        p_body = np.einsum("nji,nj->ni", R, p_world - t)
        p_cam = (p_body - mounting.T_body_cam.t) @ mounting.T_body_cam.R
        before = p_cam[:, 2] > NEAREST
        p_cam[~before, 2] = NEAREST
        focal, centre = self.lens.focal + mounting.lens[0], mounting.lens[1:]
        expected = focal * p_cam[:, :2] / p_cam[:, 2:] + centre
        residual = self.xy + mounting.delay_s * self.rate - expected
        return _Projected(mounting, R, p_body, p_cam, residual, before)

    def _derivatives(self, seen: _Projected) -> tuple[F64, F64, F64]:
        """How the expected image points minus the seen ones change with poses (M, 2, 6), the mounting (M, 2, 13) and
        points (M, 2, 3)."""
        m, (x, y, z), focal = len(self.xy), seen.p_cam.T, self.lens.focal + seen.mounting.lens[0]
        by_cam = np.zeros((m, 2, 3))
        by_cam[:, 0, 0] = by_cam[:, 1, 1] = focal / z
        by_cam[:, 0, 2], by_cam[:, 1, 2] = -focal * x / z**2, -focal * y / z**2
        by_body = by_cam @ seen.mounting.T_body_cam.R.T
        by_pose = np.concatenate([np.cross(by_body, seen.p_body[:, None]), -by_body], axis=2)
        by_mounting = np.zeros((m, 2, COLUMNS))
        by_mounting[:, :, TURN], by_mounting[:, :, SHIFT] = np.cross(by_cam, seen.p_cam[:, None]), -by_body
        by_mounting[:, :, DELAY] = -self.rate[:, :, None]
        by_mounting[:, :, LENS] = np.eye(2, 3, 1)
        by_mounting[:, :, LENS.start] = seen.p_cam[:, :2] / z[:, None]
        return by_pose, by_mounting, by_body @ seen.R_world_body.transpose(0, 2, 1)


@dataclass(frozen=True, eq=False)
class LinearSightings:
    """½ δᵀ G δ − gᵀδ of the change δ of the variables `keys`: poses, the mounting, points that are kept.

    The change of the points `free` follows: their own part of `way` minus the rest times that of `frames` and mounting.
    """

    keys: list[int]
    G: F64
    g: F64
    free: Sequence[int]
    frames: Sequence[int]
    way: F64

    def points(self, change: Mapping[int, F64]) -> dict[int, F64]:
        """The change (3,) m of each free point when the others have changed."""
        others = np.concatenate([change[key] for key in (*self.frames, MOUNTING)])
        moved = self.way[:, :, -1] - self.way[:, :, :-1] @ others
        return dict(zip(self.free, moved, strict=True))


@dataclass(frozen=True, eq=False)
class _Projected:
    """Observations at some values: points in body and camera axes (M, 3) m, residuals (M, 2) px, those `before` it."""

    mounting: Mounting
    R_world_body: F64
    p_body: F64
    p_cam: F64
    residual: F64
    before: F64


def _with_points(G: F64, g: F64, H: F64, h: F64, E: F64) -> tuple[F64, F64]:
    """Normal equations with points of their own columns beside the others."""
    width, size = len(g), 3 * len(H)
    whole = np.zeros((width + size, width + size))
    whole[:width, :width] = G
    whole[width:, :width] = E.reshape(size, width)
    whole[:width, width:] = whole[width:, :width].T
    for k, own in enumerate(H):
        begin = width + 3 * k
        whole[begin : begin + 3, begin : begin + 3] = own
    return whole, np.concatenate([g, h.ravel()])
