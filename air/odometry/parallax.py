"""How far points moved between two frames beyond what turning does."""

from __future__ import annotations

import numpy as np

from air.odometry.sightings import Seen
from common.arrays import F64


def parallax(a: Seen, b: Seen, R_a_b: F64, focal: float) -> float:
    """Median angle rad by which the points of two frames moved in the image; both must see the same ones.

    `R_a_b` (3, 3) turns directions of the second camera into those of the first.
    """
    rays = np.column_stack([a.xy / focal, np.ones(len(a.xy))]) @ R_a_b
    return float(np.median(np.linalg.norm(focal * rays[:, :2] / rays[:, 2:] - b.xy, axis=1))) / focal
