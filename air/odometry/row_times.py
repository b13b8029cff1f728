"""Observations of a rolling shutter, moved to where they would have been at the time of the frame.

Source: C. Albl, Z. Kukelova, T. Pajdla, R6P: rolling shutter absolute camera pose (2015), whose
linear motion of the camera during a frame is used.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from air.odometry.tracker import TrackedFrame
from common.arrays import F64


def ideal_points(
    frame: TrackedFrame, focal: float, omega_cam: F64, v_cam: F64, depth: Mapping[int, float], usual: float
) -> dict[int, F64]:
    """Ideal image points (2,) px by id at the frame's `t_ns`, from the centre of the image.

    The camera turns by `omega_cam` (3,) rad/s and moves by `v_cam` (3,) m/s, both in its own axes; a point without a
    `depth` m along the axis is taken to be as far as `usual`.
    """
    z = np.array([depth.get(i, usual) for i in frame.ids.tolist()])
    p = frame.rays / frame.rays[:, 2:]
    moved = p + frame.row_dt_s[:, None] * (np.cross(omega_cam, p) + v_cam / z[:, None])
    xy = focal * moved[:, :2] / moved[:, 2:]
    return dict(zip(frame.ids.tolist(), xy, strict=True))
