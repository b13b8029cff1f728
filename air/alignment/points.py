"""The points of the tracks: where in the world each lies, as far as it is known."""

from __future__ import annotations

import numpy as np

from common.arrays import F64, I64, Bool


class Points:
    """One optional point (3,) m in world a track, addressed by arrays of track numbers (K,)."""

    def __init__(self) -> None:
        self._p = np.full((1024, 3), np.nan)

    def known(self, tracks: I64) -> Bool:
        """Which tracks have a point, (K,); a negative number stands for no track."""
        inside = (tracks >= 0) & (tracks < len(self._p))
        return np.asarray(inside & np.isfinite(self._p[np.where(inside, tracks, 0), 0]))

    def at(self, tracks: I64) -> F64:
        """The points (K, 3) of tracks that have one."""
        return np.asarray(self._p[tracks])

    def put(self, tracks: I64, p_world: F64) -> None:
        """Set the points (K, 3) of tracks."""
        if not len(tracks):
            return
        if (need := int(tracks.max()) + 1) > len(self._p):
            self._p = np.vstack([self._p, np.full((max(need, 2 * len(self._p)) - len(self._p), 3), np.nan)])
        self._p[tracks] = p_world

    def forget(self, tracks: I64) -> None:
        """Take the points of tracks away."""
        self._p[tracks] = np.nan

    def all(self) -> F64:
        """All points (N, 3)."""
        return np.asarray(self._p[np.isfinite(self._p[:, 0])])
