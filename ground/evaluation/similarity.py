"""The transform that an alignment may apply: rigid, or rigid with a scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.arrays import F64
from common.se3 import rotation_angle


@dataclass(frozen=True, eq=False)
class Similarity:
    """`p_target = scale · R @ p_source + t`: `R` (3, 3), `t` (3,) m, both float64; rigid when `scale` is 1."""

    scale: float
    R: F64
    t: F64

    @staticmethod
    def identity() -> Similarity:
        """The transform that changes nothing."""
        return Similarity(1.0, np.eye(3), np.zeros(3))

    @staticmethod
    def translation(t: F64) -> Similarity:
        """The transform that adds `t` (3,) m."""
        return Similarity(1.0, np.eye(3), np.asarray(t, float))

    @property
    def rotation_deg(self) -> float:
        """Angle of the rotation, degrees in [0, 180]."""
        return float(np.degrees(rotation_angle(self.R)))

    def apply(self, points: F64) -> F64:
        """Source points (N, 3) m expressed in the target's frame."""
        return np.asarray(self.scale * points @ self.R.T + self.t)

    def inverse(self) -> Similarity:
        """The transform back, target → source."""
        return Similarity(1 / self.scale, self.R.T, -self.R.T @ self.t / self.scale)

    def __matmul__(self, other: Similarity) -> Similarity:
        return Similarity(self.scale * other.scale, self.R @ other.R, self.scale * self.R @ other.t + self.t)


def umeyama(source: F64, target: F64, with_scale: bool) -> Similarity:
    """Least-squares transform of points (N, 3) onto their partners (N, 3), m; with the scale fixed to 1 if asked.

    Source: S. Umeyama, Least-squares estimation of transformation parameters between two point patterns,
    IEEE PAMI 13(4), 1991, equations 38 to 43.
    """
    centre_source, centre_target = source.mean(axis=0), target.mean(axis=0)
    centred = source - centre_source
    covariance = (target - centre_target).T @ centred / len(source)
    U, singular, Vt = np.linalg.svd(covariance)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ np.diag(sign) @ Vt
    variance = float((centred**2).sum(axis=1).mean())
    scale = float(singular @ sign) / variance if with_scale and variance > 0 else 1.0
    return Similarity(scale, R, centre_target - scale * R @ centre_source)
