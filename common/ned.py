"""From the frames of autopilots (NED world, forward-right-down body) into ours (ENU, forward-left-up)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.arrays import F64
from common.se3 import matrix_to_quaternion, quaternion_to_matrix

R_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
R_FLU_FRD = np.diag([1.0, -1.0, -1.0])


def enu(v_ned: npt.ArrayLike) -> F64:
    """Vectors (..., 3) in ENU of vectors in NED."""
    v = np.asarray(v_ned, float)
    return np.stack([v[..., 1], v[..., 0], -v[..., 2]], axis=-1)


def flu(v_frd: npt.ArrayLike) -> F64:
    """Vectors (..., 3) in forward-left-up of vectors in forward-right-down."""
    return np.asarray(np.asarray(v_frd, float) * [1.0, -1.0, -1.0])


def attitude(q_ned_frd: npt.ArrayLike) -> F64 | None:
    """`q_enu_body` (4,) wxyz of an autopilot's quaternion, or None where that is none."""
    q = np.asarray(q_ned_frd, float)
    if not np.isfinite(q).all() or not 0.9 < float(np.linalg.norm(q)) < 1.1:
        return None
    return matrix_to_quaternion(R_ENU_NED @ quaternion_to_matrix(q) @ R_FLU_FRD)


def attitude_of_angles(roll: float, pitch: float, yaw: float) -> F64 | None:
    """`q_enu_body` (4,) wxyz of roll, pitch and yaw from north, rad, or None where one is not finite."""
    # Each axis turns by half its angle; the product is the usual order yaw, pitch, roll.
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll / 2, pitch / 2, yaw / 2]), np.sin([roll / 2, pitch / 2, yaw / 2])
    return attitude(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )
