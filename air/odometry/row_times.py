"""Observations of a rolling shutter, moved to where they would have been at the time of the frame.

Source: C. Albl, Z. Kukelova, T. Pajdla, R6P: rolling shutter absolute camera pose (2015), whose
linear motion of the camera during a frame is used.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from air.odometry.sightings import Seen
from air.odometry.tracker import TrackedFrame
from common.arrays import F64


def ideal_points(
    frame: TrackedFrame, focal: float, omega_cam: F64, v_cam: F64, depth: Mapping[int, float], usual: float
) -> Seen:
    """Ideal image points at the frame's `t_ns`, and how they move.

    The camera turns by `omega_cam` (3,) rad/s and moves by `v_cam` (3,) m/s, both in its own axes; a point without a
    `depth` m along the axis is taken to be as far as `usual`.
    """
    order = np.argsort(frame.ids)
    ids, rays, row_dt_s = frame.ids[order], frame.rays[order], frame.row_dt_s[order]
    z = np.array([depth.get(i, usual) for i in ids.tolist()])
    p = rays / rays[:, 2:]
    drift = np.cross(omega_cam, p) + v_cam / z[:, None]
    moved = p + row_dt_s[:, None] * drift
    xy = focal * moved[:, :2] / moved[:, 2:]
    return Seen(ids, xy, (focal * drift[:, :2] - xy * drift[:, 2:]) / moved[:, 2:])
