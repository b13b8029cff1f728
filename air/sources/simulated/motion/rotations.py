"""Many small rotations at once."""

from __future__ import annotations

import numpy as np

from common.arrays import F64


def exponential(rotvec: F64) -> F64:
    """Rotation matrices (N, 3, 3) of rotation vectors (N, 3) rad (Rodrigues' formula)."""
    angle = np.linalg.norm(rotvec, axis=1)[:, None, None]
    x, y, z = rotvec.T
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    # sinc without π, and half its square at half the angle: both are smooth at 0.
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + np.sinc(angle / 2 / np.pi) ** 2 / 2 * (K @ K))


def logarithm(R: F64) -> F64:
    """Rotation vectors (N, 3) rad of rotation matrices (N, 3, 3) of less than a quarter turn."""
    skew = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1) / 2
    sine = np.linalg.norm(skew, axis=1, keepdims=True)
    return np.asarray(skew / np.sinc(np.arcsin(np.minimum(sine, 1.0)) / np.pi))
