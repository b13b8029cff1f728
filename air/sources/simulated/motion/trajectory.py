"""Where the aircraft is at any time: one smooth function and its exact derivatives.

Source: D. Mellinger, V. Kumar, Minimum snap trajectory generation and control for quadrotors (2011), section III: the
attitude of a multirotor follows from the direction of its thrust and its heading.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.sources.simulated.motion.spline import Spline
from common.arrays import F64

POSITION, THRUST, HEADING, ROTORS = slice(0, 3), slice(3, 6), 6, 7
"""Channels of the spline: position in world m; thrust per mass in world m/s²; heading from east, counter-clockwise,
rad; whether the rotors turn, 0 to 1."""
CHANNELS = 8


@dataclass(frozen=True, eq=False)
class Motion:
    """How the body moves at N instants.

    `p_world`, `v_world`, `a_world` (N, 3) m, m/s, m/s² of the IMU in the local ENU frame, as an observer who turns
    with the earth sees them; `R_world_body` (N, 3, 3), body forward-left-up; `omega_body`, `alpha_body` (N, 3) rad/s,
    rad/s², rates of `R_world_body` in body axes: dR/dt = R [omega]×.
    """

    p_world: F64
    v_world: F64
    a_world: F64
    R_world_body: F64
    omega_body: F64
    alpha_body: F64


class Trajectory:
    """The true motion of a flight from 0 to `duration_s`, at any times in any order, and a second beyond both ends."""

    def __init__(self, spline: Spline, duration_s: float):
        self._spline = spline
        self.duration_s = duration_s

    def at(self, t_s: F64) -> Motion:
        """Motion at times (N,) s since the flight's start."""
        curves = self._spline.at(t_s)
        position, thrust, heading = curves[..., POSITION], curves[..., THRUST], curves[..., HEADING]
        R, dR, ddR = _attitude(np.moveaxis(thrust, 1, 0), heading.T)
        Rt = np.swapaxes(R, 1, 2)
        omega, alpha = _vee(Rt @ dR), _vee(Rt @ ddR)  # the symmetric part of the second is no rotation
        return Motion(position[:, 0], position[:, 1], position[:, 2], R, omega, alpha)

    def thrust(self, t_s: F64) -> F64:
        """Thrust per mass (N,) m/s² at times (N,) s; 0 while the rotors stand."""
        value = self._spline.at(t_s)[:, 0]
        return np.asarray(value[:, ROTORS] * np.linalg.norm(value[:, THRUST], axis=1))


def _attitude(thrust: F64, heading: F64) -> tuple[F64, F64, F64]:
    """`R_world_body` (N, 3, 3) and its two derivatives, of thrust (3, N, 3), heading (3, N) and theirs.

    The z axis lies along the thrust, the x axis in the upright plane of the heading.
    """
    cos, sin, zero = np.cos(heading[0]), np.sin(heading[0]), np.zeros_like(heading[0])
    ahead, left = np.stack([cos, sin, zero], axis=1), np.stack([-sin, cos, zero], axis=1)
    rate, rise = heading[1, :, None], heading[2, :, None]
    z = _unit(thrust[0], thrust[1], thrust[2])
    course = (ahead, rate * left, rise * left - rate**2 * ahead)
    y = _unit(*_cross(z, course))
    x = _cross(y, z)
    R, dR, ddR = (np.stack(axes, axis=2) for axes in zip(x, y, z, strict=True))
    return R, dR, ddR


Curve = tuple[F64, F64, F64]
"""A vector (N, 3), its first and its second derivative."""


def _unit(v: F64, dv: F64, ddv: F64) -> Curve:
    """The direction of a vector."""
    length = np.sqrt(_dot(v, v))
    u = v / length
    d_length = _dot(u, dv)
    du = (dv - d_length * u) / length
    dd_length = _dot(du, dv) + _dot(u, ddv)
    return u, du, (ddv - dd_length * u - 2 * d_length * du) / length


def _cross(a: Curve, b: Curve) -> Curve:
    """The cross product of two vectors."""
    return (
        _times(a[0], b[0]),
        _times(a[1], b[0]) + _times(a[0], b[1]),
        _times(a[2], b[0]) + 2 * _times(a[1], b[1]) + _times(a[0], b[2]),
    )


def _times(a: F64, b: F64) -> F64:
    # np.cross is four times slower.
    (a0, a1, a2), (b0, b1, b2) = a.T, b.T
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=1)


def _dot(a: F64, b: F64) -> F64:
    return np.asarray(np.sum(a * b, axis=1, keepdims=True))


def _vee(M: F64) -> F64:
    """Vectors (N, 3) of the skew parts of matrices (N, 3, 3)."""
    return np.stack([M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], axis=1) / 2
