"""Gauss–Newton on what frames see, what the IMU felt (gtsam's factors) and what is known as quadratic functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from air.odometry.mounting import MOUNTING
from air.odometry.quadratic import NormalEquations, Quadratic, dimension
from air.odometry.sightings import LinearSightings, Sightings
from common.arrays import F64

HALVINGS = 4
"""How often a step that leads uphill is halved."""
TOLERANCE, SMALL_TURN, SMALL_SHIFT = 1e-4, 2e-4, 0.005
"""Iterations end when the error falls by less than a share, or poses move by less than rad and m."""


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The values that were found, the covariances of the newest pose (6, 6) and of the mounting (13, 13), how many
    iterations it took, and the `equations` of the last one, of which `chain` are to be eliminated first."""

    values: gtsam.Values
    pose_covariance: F64
    mounting_covariance: F64
    iterations: int
    equations: NormalEquations
    chain: Sequence[int]

    def covariance_of(self, key: int) -> F64:
        """Covariance (D, D) of a variable that is no point. Raises LinAlgError where it is undetermined, KeyError
        where it was not there."""
        return self.equations.solve([key], [other for other in self.chain if other != key])[1]


@dataclass(frozen=True, eq=False)
class Problem:
    """All that is known, and how to solve it.

    The variables of a `chain` are eliminated one by one, the rest at once. `poses`, the newest last, tell when to stop.
    The columns `held` of the mounting stay.
    """

    inertial: gtsam.NonlinearFactorGraph
    sightings: Sightings
    known: Sequence[Quadratic]
    chain: Sequence[int]
    poses: Sequence[int]
    held: Sequence[int]

    def error(self, values: gtsam.Values) -> float:
        """Half the sum of squares."""
        known = sum(one.error(values) for one in self.known)
        return float(self.inertial.error(values)) + self.sightings.error(values) + known


def adjust(problem: Problem, values: gtsam.Values, iterations: int) -> Adjusted:
    """The values that fit best, after at least one iteration. Raises LinAlgError where anything is undetermined."""
    held = 6 + np.array(problem.held, np.int64)
    error, done = problem.error(values), 0
    while True:
        done += 1
        seen = problem.sightings.linearised(values)
        equations = equations_of(problem.inertial, seen, problem.known, values)
        change, covariance = equations.solve([problem.poses[-1], MOUNTING], problem.chain, held)
        change |= seen.points(change)
        new, new_error = _descent(problem, values, change, error)
        if not new_error <= error:
            break
        improved, values, error = error - new_error, new, new_error
        if done >= iterations or improved < TOLERANCE * error or _is_small(change, problem.poses):
            break
    return Adjusted(values, covariance[:6, :6], covariance[6:, 6:], done, equations, problem.chain)


def equations_of(
    inertial: gtsam.NonlinearFactorGraph, seen: LinearSightings, known: Sequence[Quadratic], values: gtsam.Values
) -> NormalEquations:
    """The sum of all that is known, at the same values."""
    linear = inertial.linearize(values)
    felt = linear.keyVector()
    keys = dict.fromkeys([*sorted(felt), *seen.keys])
    for one in known:
        keys |= dict.fromkeys(one.point)
    equations = NormalEquations({key: dimension(values, key) for key in keys})
    equations.add(seen.keys, seen.G, seen.g)
    if felt:
        equations.add(felt, *linear.hessian(gtsam.Ordering(felt)))
    for one in known:
        here = one.at(values)
        equations.add(here.point, here.G, here.g)
    return equations


def _is_small(change: Mapping[int, F64], poses: Sequence[int]) -> bool:
    moved = np.abs([change[key] for key in poses])
    return bool(moved[:, :3].max() < SMALL_TURN and moved[:, 3:].max() < SMALL_SHIFT)


def _descent(
    problem: Problem, values: gtsam.Values, change: Mapping[int, F64], error: float
) -> tuple[gtsam.Values, float]:
    """The values after a change and their error; after a part of it where all of it leads uphill.

    Along a scale that is hardly known the valley is long and curved.
    """
    part = 1.0
    for _ in range(HALVINGS):
        step = gtsam.VectorValues()
        for key, delta in change.items():
            step.insert(key, part * delta)
        new = values.retract(step)
        new_error = problem.error(new)
        if new_error <= error:
            return new, new_error
        part /= 2
    return values, float("inf")
