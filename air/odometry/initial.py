"""What an initialization gives: the first states, or why there are none yet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from air.odometry.initial_prior import Sigmas
from air.odometry.preintegration import InertialState
from air.odometry.tracker import TrackedFrame
from common.arrays import F64


@dataclass(frozen=True, eq=False)
class Initial:
    """States of some frames, the first of them known within `sigmas`; z is up, yaw and position are free.

    The scene is about as far as `depth` m.
    """

    states: Sequence[InertialState]
    frames: Sequence[TrackedFrame]
    sigmas: Sigmas
    depth: float = float("inf")


@dataclass(frozen=True)
class KnownSpeed:
    """How fast the aircraft moves, m/s, with one sigma."""

    t_ns: int
    speed: float
    sigma: float


@dataclass(frozen=True)
class Refusal:
    """Why there are no states yet, in a few words."""

    reason: str


def level(up_body: F64) -> F64:
    """`R_world_body` (3, 3) of which a direction (3,) of the body is up; the body's x axis, or else y, heads east."""
    up = up_body / np.linalg.norm(up_body)
    ahead = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    east = ahead - up * (up @ ahead)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def common_rays(a: TrackedFrame, b: TrackedFrame) -> tuple[F64, F64]:
    """Unit rays (M, 3) and (M, 3) of the points that both frames see."""
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    return a.rays[in_a], b.rays[in_b]
