"""The gyroscope as a clock of attitudes: how the body was turned at any time of a recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from common.arrays import F64


class Gyroscope:
    """Rates (N, 3) rad/s in body at `t_ns`; times of the answers are s since the first sample."""

    def __init__(self, t_ns: Sequence[int], rates: F64) -> None:
        self.first_ns = int(t_ns[0])
        t_s = (np.asarray(t_ns, np.int64) - self.first_ns) * 1e-9
        self.last_s = float(t_s[-1])
        self._rates = np.asarray(rates, float)
        # Each rate holds from half-way after the sample before to half-way before the next.
        self._begin_s = np.concatenate([t_s[:1], (t_s[1:] + t_s[:-1]) / 2])
        self._bias, self._path = np.full(3, np.nan), np.zeros((0, 3, 3))

    def attitudes(self, t_s: F64, bias: F64) -> F64:
        """`R_first_body` (M, 3, 3) at times (M,), extended with the first and last rate."""
        path = self._attitudes(bias)
        i = np.clip(np.searchsorted(self._begin_s, t_s, side="right") - 1, 0, len(path) - 1)
        return np.asarray(path[i] @ rotation_matrices((self._rates[i] - bias) * (t_s - self._begin_s[i])[:, None]))

    def _attitudes(self, bias: F64) -> F64:
        """`R_first_body` (N, 3, 3) where each rate begins, kept until the bias changes."""
        if not np.array_equal(bias, self._bias):
            steps = rotation_matrices((self._rates[:-1] - bias) * np.diff(self._begin_s)[:, None])
            path = np.empty((len(steps) + 1, 3, 3))
            path[0] = np.eye(3)
            for i, step in enumerate(steps):
                path[i + 1] = path[i] @ step
            self._bias, self._path = np.array(bias), path
        return self._path


def rotation_matrices(vectors: F64) -> F64:
    """Rotation matrices (M, 3, 3) of rotation vectors (M, 3) rad (Rodrigues' formula)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    K = np.zeros((len(vectors), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -z, y, -x
    K -= K.transpose(0, 2, 1)
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (K @ K))
