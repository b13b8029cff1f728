"""Linear knowledge of variables: quadratic functions of how far they have moved, their sum, solution and marginals.

Variables are held by key in `gtsam.Values`: `x` poses, `b` IMU biases, anything else vectors. gtsam holds the position
of a pose in body axes; when an attitude is corrected later, knowledge that is left as it was would hold along axes that
have turned since. Where all may be shifted together (a carrier of unknown ambiguity, a map without GNSS) that passes
for knowledge that nobody has, and the estimator grows confident of a wrong place. So columns of positions are turned
along. Sources: G. Huang, A. Mourikis, S. Roumeliotis, Observability-based rules for designing consistent EKF SLAM
estimators (2010); G. Sibley, L. Matthies, G. Sukhatme, Sliding window filter (2010), section 3: the Schur complement.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from common.arrays import F64, I64
from common.se3 import SE3

Variable = Any
"""A `gtsam.Pose3`, or a vector (D,); IMU biases are the vector of accelerometer and gyroscope."""


@dataclass(frozen=True, eq=False)
class Quadratic:
    """½ (f − 2 gᵀδ + δᵀ G δ) of the change δ (D,) of some variables from where they were, `point`, in order of keys."""

    point: Mapping[int, Variable]
    G: F64
    g: F64
    f: float = 0.0

    def at(self, values: gtsam.Values) -> Quadratic:
        """The same function of the change from other values."""
        now = {key: variable(values, key) for key in self.point}
        step = np.concatenate([moved(then, now[key]) for key, then in self.point.items()])
        G_step = self.G @ step
        f = self.f - 2 * self.g @ step + step @ G_step
        g, G = self.g - G_step, self.G
        G = G.copy()
        for columns, R_then_now in _turns(self.point, now):
            _turn(G, g, columns, R_then_now)
        return Quadratic(now, G, g, float(f))

    def error(self, values: gtsam.Values) -> float:
        """Its value at some values."""
        step = np.concatenate([moved(then, variable(values, key)) for key, then in self.point.items()])
        return float(self.f - 2 * self.g @ step + step @ self.G @ step) / 2

    def beside(self, other: Quadratic) -> Quadratic:
        """This and another one of other variables together."""
        a, b = len(self.g), len(other.g)
        G = np.block([[self.G, np.zeros((a, b))], [np.zeros((b, a)), other.G]])
        return Quadratic({**self.point, **other.point}, G, np.concatenate([self.g, other.g]), self.f + other.f)

    def carried(self, T_new_world: SE3, covariance: F64) -> Quadratic:
        """The same in another world that is turned about the vertical and shifted against this one.

        `covariance` (4, 4) is of the shift m and the turn rad: what was held together only by the choice of the old
        world is known no better than that in the new one.
        """
        sizes = [len(_flat(v)) for v in self.point.values()]
        begin, G, g, J = 0, self.G.copy(), self.g.copy(), np.zeros((len(self.g), 4))
        point: dict[int, Variable] = {}
        for (key, then), size in zip(self.point.items(), sizes, strict=True):
            columns = slice(begin, begin + size)
            begin += size
            point[key] = carried(key, then, T_new_world)
            J[columns] = by_world(key, point[key], T_new_world.t)
            if key >> 56 in (_POINT, _VELOCITY):  # these are held in axes of the world
                _turn(G, g, columns, T_new_world.R.T)
        GJ = G @ J
        loose = np.linalg.inv(np.linalg.inv(covariance) + J.T @ GJ)
        return Quadratic(point, G - GJ @ loose @ GJ.T, g - GJ @ loose @ (J.T @ g), self.f)


@dataclass(frozen=True, eq=False)
class Conditional:
    """What variables that left are when those that stayed are known: their change is `shift` (A,) − `by` (A, B) times
    the change of these, both from where they were when they parted, `gone` and `left`."""

    gone: Mapping[int, Variable]
    left: Mapping[int, Variable]
    by: F64
    shift: F64


class NormalEquations:
    """The sum of quadratic functions of variables at one and the same values."""

    def __init__(self, sizes: Mapping[int, int]) -> None:
        """`sizes` are the dimensions of the variables by key, in their order."""
        ends = np.cumsum([0, *sizes.values()])
        self._columns = {key: np.arange(a, b) for key, a, b in zip(sizes, ends, ends[1:], strict=False)}
        self.G, self.g = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])

    @property
    def keys(self) -> list[int]:
        """The variables in their order."""
        return list(self._columns)

    def add(self, keys: Iterable[int], G: F64, g: F64) -> None:
        """Add a function of some of the variables."""
        columns = self.columns(keys)
        _add(self.G, columns, G)
        self.g[columns] += g

    def columns(self, keys: Iterable[int]) -> I64:
        """Where some of the variables are."""
        return np.concatenate([self._columns[key] for key in keys])

    def solve(
        self, covariance_of: Sequence[int], first: Sequence[int] = (), held: I64 | None = None
    ) -> tuple[dict[int, F64], F64]:
        """The change of each variable, and the covariance of some together. Raises LinAlgError where undetermined.

        What is eliminated `first`, key by key, costs little where it is linked to few others. It has no covariance.
        `held` are indices into the columns of `covariance_of` that stay where they are; covariances are those of all
        being free.
        """
        G, g, left, ways = self.G.copy(), self.g.copy(), np.ones(len(self.g), bool), []
        for key in first:
            own = self._columns[key]
            left[own] = False
            others = np.flatnonzero(left & (G[own] != 0.0).any(axis=0))
            G_others = G[np.ix_(own, others)]
            way = _solve(G[np.ix_(own, own)], np.column_stack([G_others, g[own]]))
            _add(G, others, -G_others.T @ way[:, :-1])
            g[others] -= G_others.T @ way[:, -1]
            ways.append((own, others, way))
        rest, columns = np.flatnonzero(left), self.columns(covariance_of)
        wanted = np.zeros((len(g), len(columns)))
        wanted[columns, np.arange(len(columns))] = 1.0
        found, change = _solve(G[np.ix_(rest, rest)], np.column_stack([g, wanted])[rest]), np.zeros(len(g))
        change[rest], with_all = found[:, 0], found[:, 1:]
        covariance = with_all[np.searchsorted(rest, columns)]
        if held is not None and len(held):
            gain = np.linalg.solve(covariance[np.ix_(held, held)], change[columns[held]])
            change[rest] -= with_all[:, held] @ gain
        for own, others, way in reversed(ways):
            change[own] = way[:, -1] - way[:, :-1] @ change[others]
        return {key: change[c] for key, c in self._columns.items()}, covariance

    def without(self, leaving: Sequence[int], values: gtsam.Values) -> tuple[Quadratic, Conditional]:
        """What the sum knows of the others after some left, and of those given the others. Raises LinAlgError where
        what leaves is undetermined."""
        staying = [key for key in self._columns if key not in set(leaving)]
        a, b = self.columns(leaving), self.columns(staying)
        way = _solve(self.G[np.ix_(a, a)], np.column_stack([self.G[np.ix_(a, b)], self.g[a]]))
        G = self.G[np.ix_(b, b)] - self.G[np.ix_(b, a)] @ way[:, :-1]
        g = self.g[b] - self.G[np.ix_(b, a)] @ way[:, -1]
        gone, left = ({key: variable(values, key) for key in keys} for keys in (leaving, staying))
        return Quadratic(left, (G + G.T) / 2, g), Conditional(gone, left, way[:, :-1], way[:, -1])


def variable(values: gtsam.Values, key: int) -> Variable:
    """The variable of a key."""
    kind = key >> 56
    if kind == _POSE:
        return values.atPose3(key)
    if kind == _POINT:
        return np.asarray(values.atPoint3(key))
    return np.asarray(values.atConstantBias(key).vector() if kind == _BIAS else values.atVector(key))


def dimension(values: gtsam.Values, key: int) -> int:
    """How many columns a variable has."""
    return len(_flat(variable(values, key)))


def carried(key: int, then: Variable, T_new_world: SE3) -> Variable:
    """A variable as it is in another world; biases and the like stay."""
    if isinstance(then, gtsam.Pose3):
        return gtsam.Pose3(gtsam.Rot3(T_new_world.R), T_new_world.t).compose(then)
    if key >> 56 == _POINT:
        return T_new_world.apply(then)
    return T_new_world.R @ then if key >> 56 == _VELOCITY else then


_POSE, _BIAS, _POINT, _VELOCITY = (ord(letter) for letter in "xblv")


def _flat(then: Variable) -> F64:
    return np.zeros(6) if isinstance(then, gtsam.Pose3) else then


def retracted(then: Variable, change: F64) -> Variable:
    """A variable after a change (D,)."""
    if not isinstance(then, gtsam.Pose3):
        return then + change
    R, t = then.rotation(), then.translation()
    return gtsam.Pose3(R.compose(gtsam.Rot3.Expmap(change[:3])), t + R.matrix() @ change[3:])


def moved(then: Variable, now: Variable) -> F64:
    """The change (D,) from one value of a variable to another."""
    if not isinstance(then, gtsam.Pose3):
        return np.asarray(now - then)
    turned = gtsam.Rot3.Logmap(then.rotation().between(now.rotation()))
    return np.concatenate([turned, then.rotation().matrix().T @ (now.translation() - then.translation())])


def _turns(then: Mapping[int, Variable], now: Mapping[int, Variable]) -> Iterable[tuple[slice, F64]]:
    """Columns of the positions, and how the body has turned since."""
    begin = 0
    for key, before in then.items():
        after = now[key]
        if isinstance(before, gtsam.Pose3):
            yield slice(begin + 3, begin + 6), before.rotation().between(after.rotation()).matrix()
        begin += len(_flat(before))


def _turn(G: F64, g: F64, columns: slice, R_then_now: F64) -> None:
    """Hold some columns along axes that have turned."""
    g[columns] = R_then_now.T @ g[columns]
    G[:, columns] = G[:, columns] @ R_then_now
    G[columns] = R_then_now.T @ G[columns]


def by_world(key: int, now: Variable, origin: F64) -> F64:
    """How a variable (D, 4) moves when the new world is shifted, and turned about the vertical through `origin`."""
    up = np.array([0.0, 0.0, 1.0])
    if isinstance(now, gtsam.Pose3):
        R = now.rotation().matrix()
        out = np.zeros((6, 4))
        out[:3, 3] = R.T @ up
        out[3:, :3] = R.T
        out[3:, 3] = R.T @ np.cross(up, now.translation() - origin)
        return out
    out = np.zeros((len(now), 4))
    if key >> 56 == _POINT:
        out[:, :3] = np.eye(3)
        out[:, 3] = np.cross(up, now - origin)
    elif key >> 56 == _VELOCITY:
        out[:, 3] = np.cross(up, now)
    return out


def _add(G: F64, columns: I64, part: F64) -> None:
    """Add a part to some rows and columns, stretch by stretch of neighbours: many times faster than one by one."""
    begins = [0, *(np.flatnonzero(np.diff(columns) != 1) + 1).tolist(), len(columns)]
    runs = [(slice(a, b), slice(columns[a], columns[b - 1] + 1)) for a, b in pairwise(begins) if a < b]
    for mine, rows in runs:
        for others, across in runs:
            G[rows, across] += part[mine, others]


def _solve(G: F64, right: F64) -> F64:
    """Solve G x = right, variables scaled to alike size as they run from micrometres to hundreds of metres."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), 1e-12))
    scaled = np.linalg.solve(G * scale[:, None] * scale, right * scale[:, None])
    return np.asarray(scale[:, None] * scaled)
