"""Registration of two point clouds of the same ground: robust point-to-plane ICP, coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.spatial import cKDTree

from common.arrays import F64, I64, Bool
from common.errors import EvaluationError
from common.se3 import rotation_vector_to_matrix
from ground.evaluation.patches import normal_equations
from ground.evaluation.similarity import Similarity

_COARSE_POINTS = 6_000
_COARSE_TARGET_POINTS = 40_000
_FINE_POINTS = 100_000
_TARGET_POINTS = 250_000
_WIDE_GATES = (15.0, 5.0)
_COARSE_GATES = (5.0, 2.0)
_FINE_GATES = (1.5, 0.75)
_START_SCALES = (1.0, 0.975, 1.025, 0.95, 1.05)
_MAX_SHIFT = 15.0
_MIN_PAIRS = 50


def register(source: F64, target: F64, with_scale: bool) -> Similarity:
    """The transform that lays the source (N, 3) on the target (M, 3), m, rigid or with a scale.

    Meant for maps that are georeferenced already: it finds offsets of some 10 m, tilts of some degrees and scales
    within some 5 %, with partial overlap and outliers, on ground that is bent by some decimetres. The scale is sought
    from the rigid solution on, by how well the clouds cover each other. Deterministic.
    Raises EvaluationError when the clouds have too little in common.
    Source: Chen and Medioni, Object modelling by registration of multiple range images (1992), with Tukey's
    biweight on the residuals.
    """
    centre = target.mean(axis=0)
    planes = _TangentPlanes.of(thin(target - centre, _TARGET_POINTS))
    few_planes = planes.thinned(_COARSE_TARGET_POINTS)
    fine = thin(source - centre, _FINE_POINTS)
    few = thin(fine, _COARSE_POINTS)
    T = _best_of(_shifts(fine, planes.points), few, few_planes, _WIDE_GATES, with_scale=False)
    if with_scale:
        T = _best_of(_scaled(T, few), few, few_planes, _COARSE_GATES, with_scale=False)
    T = _refine(T, fine, planes, _FINE_GATES, with_scale, still=1e-4)
    return Similarity.translation(centre) @ T @ Similarity.translation(-centre)


def thin(points: F64, count: int) -> F64:
    """At most `count` of the points (N, 3), drawn at random but the same at every call.

    Not one for each cube of a grid: outliers, scattered through the air, would fill most cubes.
    """
    if len(points) <= count:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), count, replace=False))]


def search_tree(points: F64) -> cKDTree:
    """A tree of the points (N, 3) for nearest-neighbour queries.

    Split at midpoints: SciPy's default, compact and balanced, takes thirty times as long where a query point lies
    metres above flat ground, as all do before an alignment.
    """
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


@dataclass(frozen=True, eq=False)
class _TangentPlanes:
    """The target as small planes: `points` (M, 3) m, unit `normals` (M, 3), typical `spacing` m, and their tree."""

    points: F64
    normals: F64
    spacing: float
    tree: cKDTree

    @staticmethod
    def of(points: F64, neighbours: int = 16) -> _TangentPlanes:
        """Planes through the points whose normals are the least axis of the nearest neighbours."""
        tree = search_tree(points)
        distance, index = tree.query(points, k=min(neighbours, len(points)), workers=-1)
        around = points[index] - points[index].mean(axis=1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
        return _TangentPlanes(points, np.ascontiguousarray(axes[..., 0]), float(np.median(distance[:, 1])), tree)

    def pairs(self, points: F64, gate: float) -> tuple[Bool, I64]:
        """Which points (N,) have a plane within `gate` m, and the index of it for those (K,)."""
        distance, index = self.tree.query(points, distance_upper_bound=gate, workers=-1)
        paired = np.isfinite(distance)
        return paired, index[paired]

    def thinned(self, count: int) -> _TangentPlanes:
        """At most `count` of the planes, with the normals that all points gave them."""
        chosen = thin(np.hstack([self.points, self.normals]), count)
        points = np.ascontiguousarray(chosen[:, :3])
        return _TangentPlanes(points, np.ascontiguousarray(chosen[:, 3:]), self.spacing, search_tree(points))

    def misfit(self, points: F64, limit: float = 1.0) -> float:
        """Mean distance (m) between the two sets of points, both ways, each counted as at most `limit`.

        One way alone would be smallest for a cloud that has shrunk to a single point.
        """
        there, _ = self.tree.query(points, distance_upper_bound=limit, workers=-1)
        back, _ = search_tree(points).query(thin(self.points, len(points)), distance_upper_bound=limit, workers=-1)
        return float(np.minimum(there, limit).mean() + np.minimum(back, limit).mean()) / 2


def _best_of(
    starts: list[Similarity], source: F64, planes: _TangentPlanes, gates: tuple[float, ...], with_scale: bool
) -> Similarity:
    """The refined start that fits best. Raises EvaluationError when none leads anywhere."""
    refined, failure = [], None
    for start in starts:
        try:
            refined.append(_refine(start, source, planes, gates, with_scale, still=5e-3))
        except EvaluationError as error:
            failure = error
    if failure is not None and not refined:
        raise failure
    return min(refined, key=lambda T: planes.misfit(T.apply(source)))


def _refine(
    T: Similarity,
    source: F64,
    planes: _TangentPlanes,
    gates: tuple[float, ...],
    with_scale: bool,
    still: float,
) -> Similarity:
    """ICP with narrowing gates; at each the steps end when no point moves by more than `still` m."""
    extent = float(np.abs(source).max())
    for gate in gates:
        for _ in range(40):
            step = _step(T.apply(source), planes, gate, with_scale)
            T = step @ T
            turned = np.abs(step.R - np.eye(3)).max() + abs(step.scale - 1.0)
            if turned * extent + np.abs(step.t).max() < still:
                break
    return T


def _step(points: F64, planes: _TangentPlanes, gate: float, with_scale: bool) -> Similarity:
    """One Gauss–Newton step of the weighted point-to-plane distance over the pairs within the gate, bends allowed."""
    paired, index = planes.pairs(points, gate)
    if len(index) < _MIN_PAIRS:
        raise EvaluationError(
            f"only {len(index)} points of the cloud lie within {gate:g} m of the reference: "
            "the two do not show the same place, or their coordinate systems differ"
        )
    p, q, n = points[paired], planes.points[index], planes.normals[index]
    residual = np.einsum("ni,ni->n", p - q, n)
    weight = _tukey(residual)
    # At the rim of the target and in its holes the nearest plane lies aside: it says nothing about the point.
    aside = np.linalg.norm(p - q - residual[:, None] * n, axis=1)
    if gate <= max(_FINE_GATES):
        weight *= aside < 2 * planes.spacing
    centre = p.mean(axis=0)
    columns = [np.cross(p - centre, n), n]
    if with_scale:
        columns.append(np.einsum("ni,ni->n", p - centre, n)[:, None])
    J = np.hstack(columns)
    normal_matrix, towards = normal_equations(J, residual, weight, p[:, :2])
    ridge = 1e-9 * np.trace(normal_matrix) * np.eye(len(normal_matrix))
    delta = np.linalg.solve(normal_matrix + ridge, towards)
    turn = Similarity(1.0 + delta[6] if with_scale else 1.0, rotation_vector_to_matrix(delta[:3]), delta[3:6])
    return Similarity.translation(centre) @ turn @ Similarity.translation(-centre)


def _tukey(residual: F64) -> F64:
    """Tukey's biweight (N,) of the residuals, its spread taken from their median magnitude."""
    spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-4)
    return np.asarray(np.clip(1 - (residual / (4.685 * spread)) ** 2, 0, None) ** 2)


def _shifts(source: F64, target: F64) -> list[Similarity]:
    """Where to begin: as given, and shifted as the correlation of the height maps says."""
    return [Similarity.identity(), Similarity.translation(_height_map_shift(source, target))]


def _scaled(T: Similarity, source: F64) -> list[Similarity]:
    """Where to begin with a scale: several of them about the middle of the source."""
    middle = T.apply(source).mean(axis=0)
    back = Similarity.translation(-middle) @ T
    sizes = [Similarity(scale, np.eye(3), np.zeros(3)) for scale in _START_SCALES]
    return [Similarity.translation(middle) @ size @ back for size in sizes]


def _height_map_shift(source: F64, target: F64, cell: float = 1.0) -> F64:
    """Shift (3,) m of the source onto the target by normalised correlation of their height maps.

    Source: D. Padfield, Masked object registration in the Fourier domain, IEEE TIP 21(5), 2012.
    """
    corner = np.minimum(source.min(axis=0), target.min(axis=0))[:2]
    span = np.maximum(source.max(axis=0), target.max(axis=0))[:2] - corner
    cell = max(cell, float(span.max()) / 1024)
    shape = tuple(int(size) for size in np.ceil(span / cell).astype(int) + 1)
    height_s, mask_s = _height_map(source, corner, cell, shape)
    height_t, mask_t = _height_map(target, corner, cell, shape)
    reach = int(np.ceil(_MAX_SHIFT / cell))
    score, overlap = _masked_correlation(height_s, mask_s, height_t, mask_t, reach)
    score[overlap < 0.5 * overlap.max()] = -np.inf
    best = np.array(np.unravel_index(np.argmax(score), score.shape)) - reach
    moved = np.roll(height_s, tuple(best), axis=(0, 1))
    both = np.roll(mask_s, tuple(best), axis=(0, 1)) & mask_t
    up = float(np.median((height_t - moved)[both])) if both.any() else 0.0
    return np.array([best[0] * cell, best[1] * cell, up])


def _height_map(points: F64, corner: F64, cell: float, shape: tuple[int, ...]) -> tuple[F64, Bool]:
    """Mean height (X, Y) m of the points in each cell, and where there are any."""
    x, y = np.floor((points[:, :2] - corner) / cell).astype(int).T
    flat = x * shape[1] + y
    count = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(flat, weights=points[:, 2], minlength=shape[0] * shape[1]).reshape(shape)
    return total / np.maximum(count, 1), count > 0


def _without_plane(height: F64, mask: Bool) -> F64:
    """Heights less their least-squares plane, 0 outside the mask: a tilt must not decide the correlation."""
    x, y = np.nonzero(mask)
    A = np.column_stack([x, y, np.ones(len(x))])
    plane, *_ = np.linalg.lstsq(A, height[x, y], rcond=None)
    flat = np.zeros_like(height)
    flat[x, y] = height[x, y] - A @ plane
    return flat


def _masked_correlation(height_s: F64, mask_s: Bool, height_t: F64, mask_t: Bool, reach: int) -> tuple[F64, F64]:
    """Correlation coefficient and overlap (cells) for each shift of the source by up to `reach` cells both ways."""
    size = [fft.next_fast_len(2 * n) for n in height_s.shape]
    s, t = _without_plane(height_s, mask_s), _without_plane(height_t, mask_t)

    def correlate(a: F64, b: F64) -> F64:
        product = fft.irfft2(np.conj(fft.rfft2(a, size)) * fft.rfft2(b, size), size)
        shifts = np.arange(-reach, reach + 1)
        return np.asarray(product[np.ix_(shifts % size[0], shifts % size[1])])

    in_s, in_t = mask_s.astype(float), mask_t.astype(float)
    overlap = np.maximum(correlate(in_s, in_t), 1.0)
    sum_s, sum_t = correlate(s, in_t), correlate(in_s, t)
    covariance = correlate(s, t) - sum_s * sum_t / overlap
    variance_s = correlate(s**2, in_t) - sum_s**2 / overlap
    variance_t = correlate(in_s, t**2) - sum_t**2 / overlap
    return covariance / np.sqrt(np.maximum(variance_s * variance_t, 1e-9)), overlap
