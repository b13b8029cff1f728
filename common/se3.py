"""Rigid transforms. `T_a_b` maps points of frame b into frame a, so inner names cancel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from common.arrays import F64


@dataclass(frozen=True, eq=False)
class SE3:
    """Rigid transform `T_a_b`: rotation `R` (3, 3) and translation `t` (3,) m, both float64, of b in a."""

    R: F64
    t: F64

    @staticmethod
    def identity() -> SE3:
        """The transform that changes nothing."""
        return SE3(np.eye(3), np.zeros(3))

    @staticmethod
    def from_quaternion(wxyz: npt.ArrayLike, t: npt.ArrayLike) -> SE3:
        """Transform from a Hamilton quaternion (4,) w first (normalised here) and a translation (3,) m."""
        return SE3(quaternion_to_matrix(np.asarray(wxyz, float)), np.asarray(t, float).reshape(3))

    @property
    def wxyz(self) -> F64:
        """Unit Hamilton quaternion (4,), w first and w ≥ 0."""
        return matrix_to_quaternion(self.R)

    @property
    def matrix(self) -> F64:
        """Homogeneous matrix (4, 4)."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, self.t
        return T

    def inverse(self) -> SE3:
        """`T_b_a` of this `T_a_b`."""
        return SE3(self.R.T, -self.R.T @ self.t)

    def __matmul__(self, other: SE3) -> SE3:
        return SE3(self.R @ other.R, self.R @ other.t + self.t)

    def apply(self, points: npt.NDArray[np.floating[Any]]) -> F64:
        """Points (..., 3) of frame b expressed in frame a, m."""
        return np.asarray(points @ self.R.T + self.t, np.float64)


def quaternion_to_matrix(wxyz: F64) -> F64:
    """Rotation matrix (3, 3) of a Hamilton quaternion (4,), w first; the quaternion is normalised."""
    w, x, y, z = np.asarray(wxyz, float) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_to_quaternion(R: F64) -> F64:
    """Unit Hamilton quaternion (4,), w first and w ≥ 0, of a rotation matrix (3, 3).

    Shepperd's method: the largest of the four squared components is computed first, so no rotation divides by
    a number near zero.
    """
    trace = np.trace(R)
    squares = np.array([trace, R[0, 0], R[1, 1], R[2, 2]])
    i = int(np.argmax(squares))
    if i == 0:
        q = np.array([1 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        a, b, c = i - 1, i % 3, (i + 1) % 3
        q = np.empty(4)
        q[0] = R[c, b] - R[b, c]
        q[1 + a] = 1 + R[a, a] - R[b, b] - R[c, c]
        q[1 + b] = R[b, a] + R[a, b]
        q[1 + c] = R[c, a] + R[a, c]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0 else -q


def rotation_vector_to_matrix(rotvec: F64) -> F64:
    """Rotation matrix (3, 3) of a rotation vector (3,) rad (Rodrigues' formula)."""
    angle = float(np.linalg.norm(rotvec))
    if angle < 1e-12:
        return np.eye(3) + skew(rotvec)
    K = skew(rotvec / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K))


def rotation_vector(R: F64) -> F64:
    """Rotation vector (3,) rad, of length at most π, of a rotation matrix (3, 3)."""
    w, *xyz = matrix_to_quaternion(R)
    sine = float(np.linalg.norm(xyz))
    return np.asarray(xyz) * (2.0 if sine < 1e-12 else 2.0 * np.arctan2(sine, w) / sine)


def rotation_angle(R: F64) -> float:
    """Angle of a rotation matrix (3, 3), rad in [0, π]."""
    return float(np.linalg.norm(rotation_vector(R)))


def skew(v: F64) -> F64:
    """Cross-product matrix (3, 3): `skew(v) @ u == cross(v, u)`."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def level_between(now: SE3, wanted: SE3) -> SE3:
    """`T_wanted_now`, a turn about the vertical and a shift, that takes one pose as near as it can to another."""
    turn = wanted.R @ now.R.T
    yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    R = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    return SE3(R, wanted.t - R @ now.t)
