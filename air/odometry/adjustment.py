"""Gauss–Newton on what gtsam knows as factors together with what is known as quadratic functions; points go first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from air.odometry.quadratic import NormalEquations, Quadratic, dimension
from common.arrays import F64

HALVINGS = 4
"""How often a step that leads uphill is halved."""
TOLERANCE, SMALL_TURN, SMALL_SHIFT = 1e-4, 2e-4, 0.005
"""Iterations end when the error falls by less than a share, or poses move by less than rad and m."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The values that were found, the covariance of one pose among them (6, 6), and how many iterations it took."""

    values: gtsam.Values
    covariance: F64
    iterations: int


@dataclass(frozen=True, eq=False)
class Unknowns:
    """How to solve: `points` are eliminated first, then the variables of a `chain` one by one, and the rest at once.

    `poses` tell when to stop; the covariance of the last one is wanted.
    """

    points: Sequence[int]
    chain: Sequence[int]
    poses: Sequence[int]


def adjust(
    graph: gtsam.NonlinearFactorGraph,
    known: Sequence[Quadratic],
    values: gtsam.Values,
    unknowns: Unknowns,
    iterations: int,
) -> Adjusted:
    """The values that fit best, after some iterations at most.

    Raises RuntimeError (of gtsam) where a point, and LinAlgError where anything else is undetermined.
    """
    error, covariance, done = _error(graph, known, values), np.eye(6), 0
    while done < iterations:
        done += 1
        change, covariance = _step(graph, known, values, unknowns)
        new, new_error = _descent(graph, known, values, change, error)
        if not new_error <= error:
            break
        improved, values, error = error - new_error, new, new_error
        if improved < TOLERANCE * error or _is_small(change, unknowns.poses):
            break
    return Adjusted(values, covariance, done)


def covariance_of(
    key: int, graph: gtsam.NonlinearFactorGraph, known: Sequence[Quadratic], values: gtsam.Values, unknowns: Unknowns
) -> F64:
    """Covariance (D, D) of one variable that is no point. Raises as `adjust` does."""
    rest = graph.linearize(values).eliminatePartialSequential(gtsam.Ordering(list(unknowns.points)))[1]
    chain = [other for other in unknowns.chain if other != key]
    return equations_of(rest, known, values).solve([key], chain)[1]


def equations_of(rest: gtsam.GaussianFactorGraph, known: Sequence[Quadratic], values: gtsam.Values) -> NormalEquations:
    """The sum of gtsam's linear factors and of what else is known, at the same values."""
    mine = rest.keyVector()
    keys = dict.fromkeys(sorted(mine))
    for one in known:
        keys |= dict.fromkeys(one.point)
    equations = NormalEquations({key: dimension(values, key) for key in keys})
    if mine:
        equations.add(mine, *rest.hessian(gtsam.Ordering(mine)))
    for one in known:
        here = one.at(values)
        equations.add(here.point, here.G, here.g)
    return equations


def _step(
    graph: gtsam.NonlinearFactorGraph, known: Sequence[Quadratic], values: gtsam.Values, unknowns: Unknowns
) -> tuple[gtsam.VectorValues, F64]:
    net, rest = graph.linearize(values).eliminatePartialSequential(gtsam.Ordering(list(unknowns.points)))
    change, covariance = equations_of(rest, known, values).solve([unknowns.poses[-1]], unknowns.chain)
    moved = gtsam.VectorValues()
    for key, delta in change.items():
        moved.insert(key, delta)
    return net.optimize(moved), covariance


def _is_small(change: gtsam.VectorValues, poses: Sequence[int]) -> bool:
    moved = np.abs([change.at(key) for key in poses])
    return bool(moved[:, :3].max() < SMALL_TURN and moved[:, 3:].max() < SMALL_SHIFT)


def _descent(
    graph: gtsam.NonlinearFactorGraph,
    known: Sequence[Quadratic],
    values: gtsam.Values,
    change: gtsam.VectorValues,
    error: float,
) -> tuple[gtsam.Values, float]:
    """The values after a change and their error; after a part of it where all of it leads uphill.

    Along a scale that is hardly known the valley is long and curved.
    """
    for _ in range(HALVINGS):
        new = values.retract(change)
        new_error = _error(graph, known, new)
        if new_error <= error:
            return new, new_error
        half = gtsam.VectorValues()
        for key in values.keys():  # noqa: SIM118
            half.insert(key, 0.5 * change.at(key))
        change = half
    return values, float("inf")


def _error(graph: gtsam.NonlinearFactorGraph, known: Sequence[Quadratic], values: gtsam.Values) -> float:
    return float(graph.error(values)) + sum(one.error(values) for one in known)
