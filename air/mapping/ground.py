"""What is known so far about how high the ground lies: it says where to look for the next photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from air.mapping.matching import match
from air.mapping.rectification import Rectification, rectify, resample
from air.mapping.triangulation import Correspondences, PointGrid, triangulate
from common.arrays import F64, U8
from common.messages import Keyframe

# Where nothing is known, the surface is sought this far below and above the ground, as a share of the camera's height.
UNKNOWN_BELOW, UNKNOWN_ABOVE = 0.30, 0.45
# Where the surface near by is known: new ground may fall away a little, new buildings and trees may rise.
KNOWN_BELOW, KNOWN_ABOVE = 0.08, 0.22
# Heights tried, in baselines, when not even the order of magnitude is known.
HEIGHTS_IN_BASELINES = (2.0, 2.8, 4.0, 5.6, 8.0, 11.0)
ESTIMATE_PIXELS = 40_000
ESTIMATE_SHARE = 0.10


@dataclass(frozen=True, eq=False)
class _Patch:
    centre: F64
    low: float
    median: float
    high: float


class Ground:
    """Heights of the surface seen so far, one entry per matched pair."""

    def __init__(self) -> None:
        self._patches: dict[tuple[int, int], _Patch] = {}
        self._supposed: float | None = None

    def suppose(self, height: float) -> None:
        """Takes `height` m in world for the ground until a pair shows it."""
        self._supposed = height

    def learn(self, photos: tuple[int, int], samples: PointGrid) -> None:
        """Remembers the heights of a pair's surface."""
        p_world = samples.p_origin[np.isfinite(samples.p_origin[..., 2])] + samples.origin
        if len(p_world):
            low, median, high = np.quantile(p_world[:, 2], [0.01, 0.5, 0.99])
            self._patches[photos] = _Patch(np.median(p_world[:, :2], axis=0), low, median, high)

    def under(self, keyframe: Keyframe) -> float | None:
        """Height m in world of the ground under a camera: of the nearest patches, else as supposed, else None."""
        near = self._near(keyframe, 4)
        return float(np.median([p.median for p in near])) if near else self._supposed

    def disparities(self, rectification: Rectification, left: Keyframe, right: Keyframe) -> tuple[float, float]:
        """Lowest and highest disparity px to expect in a pair."""
        camera_height = min(left.T_world_cam.t[2], right.T_world_cam.t[2])
        near = [p for p in self._near(left, 6) if self._is_close(p, left, camera_height - p.median)]
        ground = self.under(left) or 0.0
        height = camera_height - ground
        if near:
            bottom = min(p.low for p in near) - KNOWN_BELOW * height
            top = max(p.high for p in near) + KNOWN_ABOVE * height
        else:
            bottom, top = ground - UNKNOWN_BELOW * height, ground + UNKNOWN_ABOVE * height
        top = min(top, camera_height - 0.3 * height)
        # Depth in the rectified frame equals height only for a vertical view: its tilt widens the range.
        tilt = abs(float((left.T_world_cam.R @ rectification.left.R_rect_cam.T)[2, 2]))
        depths = ((camera_height - top) * tilt, (camera_height - bottom) / max(tilt, 0.5))
        return rectification.disparity(depths[1]), rectification.disparity(depths[0])

    def _near(self, keyframe: Keyframe, count: int) -> list[_Patch]:
        place = keyframe.T_world_cam.t[:2]
        return sorted(self._patches.values(), key=lambda p: float(np.linalg.norm(p.centre - place)))[:count]

    @staticmethod
    def _is_close(patch: _Patch, keyframe: Keyframe, height: float) -> bool:
        return float(np.linalg.norm(patch.centre - keyframe.T_world_cam.t[:2])) < 0.6 * height


def estimate_ground(keyframe: Keyframe, others: Sequence[Keyframe], images: Mapping[int, U8]) -> float | None:
    """Height m in world of the ground under a camera when nothing is known: the one at which photos match best.

    Tries its nearest neighbours at several heights on small images. None if at no height enough of them matches.
    """
    place = keyframe.T_world_cam.t
    neighbours = [o for o in others if o.index != keyframe.index and np.linalg.norm(o.T_world_cam.t - place) > 1e-3]
    neighbours.sort(key=lambda o: float(np.linalg.norm(o.T_world_cam.t - place)))
    best_share, best_height = ESTIMATE_SHARE, None
    for other in neighbours[:3]:
        baseline = float(np.linalg.norm(other.T_world_cam.t - place))
        for factor in HEIGHTS_IN_BASELINES:
            matches = _match_small(keyframe, other, float(place[2]) - factor * baseline, images)
            if matches is not None and matches.share > best_share:
                z = triangulate(matches, keyframe, other).p_origin[..., 2]
                if np.isfinite(z).any():
                    best_share, best_height = matches.share, float(np.nanmedian(z) + place[2])
        if best_height is not None:
            break
    return best_height


def _match_small(
    left: Keyframe, right: Keyframe, ground_height: float, images: Mapping[int, U8]
) -> Correspondences | None:
    rectification = rectify(left, right, ground_height, 1e-3, ESTIMATE_PIXELS)
    if rectification is None:
        return None
    pair = resample(rectification, images[left.index], images[right.index])
    depth = float(left.T_world_cam.t[2]) - ground_height
    low, high = rectification.disparity(depth * 1.3), rectification.disparity(depth / 1.3)
    found = match(pair.left, pair.right, pair.left_valid, pair.right_valid, low, high)
    return Correspondences.of(rectification, found, pair.colour)
