"""What keyframes that left the window knew of the oldest one and of the biases: a linear prior that turns with it.

A carrier of unknown ambiguity says nothing about where the antenna is: all may be shifted together. gtsam holds
positions in body axes; when the attitude is corrected later, a prior that is left as it was takes that freedom for
knowledge, and the estimator grows confident of a wrong place. So its columns of the position are turned along. Source:
G. Huang, A. Mourikis, S. Roumeliotis, Observability-based rules for designing consistent EKF SLAM estimators (2010).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from air.odometry.gnss_factors import STATES, Linearised, as_factor
from common.arrays import F64


@dataclass(frozen=True, eq=False)
class Prior:
    """A linear factor on a keyframe's pose, velocity and IMU biases, and on a node (D,) if it has one.

    It is linear at `pose`, `velocity`, `bias` (6,) and `u` (D,).
    """

    linear: Linearised
    keys: tuple[int, ...]
    pose: gtsam.Pose3
    velocity: F64
    bias: F64
    u: F64

    @classmethod
    def at(cls, linear: Linearised, keys: Sequence[int], values: gtsam.Values) -> Prior:
        """A prior that is linear at some values."""
        x, v, b, *n = keys
        pose, velocity, bias = values.atPose3(x), values.atVector(v), values.atConstantBias(b).vector()
        return cls(linear, tuple(keys), pose, velocity, bias, values.atVector(n[0]) if n else np.zeros(0))

    def factor(self, values: gtsam.Values) -> gtsam.LinearContainerFactor:
        """The prior as a factor that is linear at other values."""
        x, v, b, *n = self.keys
        pose = values.atPose3(x)
        R_then_now = self.pose.rotation().between(pose.rotation())
        moved = np.concatenate(
            [
                gtsam.Rot3.Logmap(R_then_now),
                self.pose.rotation().matrix().T @ (pose.translation() - self.pose.translation()),
                values.atVector(v) - self.velocity,
                values.atConstantBias(b).vector() - self.bias,
                (values.atVector(n[0]) if n else np.zeros(0)) - self.u,
            ]
        )
        turn = np.eye(STATES + len(self.u))
        turn[3:6, 3:6] = R_then_now.matrix()
        G, g, f = self.linear.G, self.linear.g, self.linear.f
        shifted = Linearised(
            G=turn.T @ G @ turn,
            g=turn.T @ (g - G @ moved),
            f=float(f - 2 * g @ moved + moved @ G @ moved),
            rows=0,
            chi_square=0.0,
        )
        return as_factor(shifted, self.keys, values)


def marginalize(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, leaving: Sequence[int], staying: Sequence[int]
) -> Prior:
    """The prior on the `staying` keys of a graph (pose, velocity, IMU biases, node) after the `leaving` are eliminated.

    Raises LinAlgError where the graph does not determine the leaving keys.
    """
    H, g, sizes = _dense(graph, values, [*leaving, *staying])
    gone = sum(sizes[: len(leaving)])
    way = np.linalg.solve(H[:gone, :gone], np.column_stack([H[:gone, gone:], g[:gone]]))
    G = H[gone:, gone:] - H[gone:, :gone] @ way[:, :-1]
    return Prior.at(Linearised((G + G.T) / 2, g[gone:] - H[gone:, :gone] @ way[:, -1], 0.0, 0, 0.0), staying, values)


def step(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: Sequence[int]) -> tuple[gtsam.Values, F64]:
    """Values after one Gauss–Newton step, and the covariance (15, 15) of the last three keys.

    gtsam's own elimination takes a position that is known to metres, beside a turn known to milliradians, for one that
    is not known at all; so the few hundred unknowns are solved for as one matrix. Raises LinAlgError where the graph
    does not determine the keys.
    """
    H, g, sizes = _dense(graph, values, keys)
    last = np.eye(len(H))[:, -STATES:]
    scale = 1 / np.sqrt(np.diag(H))
    solved = scale[:, None] * np.linalg.solve(H * np.outer(scale, scale), scale[:, None] * np.column_stack([g, last]))
    delta, begin = gtsam.VectorValues(), 0
    for key, size in zip(keys, sizes, strict=True):
        delta.insert(key, solved[begin : begin + size, 0])
        begin += size
    return values.retract(delta), np.asarray(solved[-STATES:, 1:])


def _dense(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: Sequence[int]) -> tuple[F64, F64, list[int]]:
    """Hessian, gradient and sizes of the keys, linear at some values."""
    H, g = graph.linearize(values).hessian(gtsam.Ordering(list(keys)))
    kinds = {"x": 6, "v": 3, "b": 6}
    sizes = [kinds.get(chr(gtsam.symbolChr(key))) or len(values.atVector(key)) for key in keys]
    return np.asarray(H), np.ravel(g), sizes
