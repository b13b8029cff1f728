"""Which tracks take part in an adjustment: long ones first, spread evenly over every photo."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from common.arrays import I64

if TYPE_CHECKING:
    from air.alignment.reconstruction import Reconstruction

GRID = 8


def select_tracks(reconstruction: Reconstruction, photos: list[int], per_photo: int) -> I64:
    """Tracks with a point seen by at least two of the photos, about `per_photo` a photo, even over its area.

    Every cell of a grid over every photo chooses a few of the tracks that appear in it, those seen by most photos
    first, because they tie the block together.
    """
    quota = max(1, per_photo // GRID**2)
    tracks = reconstruction.tracks_of(photos)
    seen = reconstruction.tracks.observations(tracks, photos)
    views = np.bincount(seen.row, minlength=len(tracks))
    seen = seen.only(views[seen.row] >= 2)
    place = np.zeros(len(seen.photo), np.int64)
    for photo in photos:
        rows = seen.photo == photo
        place[rows] = photo * GRID**2 + _cells(reconstruction, photo)[seen.feature[rows]]
    order = np.lexsort((seen.row, -views[seen.row], place))
    _, first, count = np.unique(place[order], return_index=True, return_counts=True)
    rank = np.arange(len(order)) - np.repeat(first, count)
    return np.asarray(tracks[np.unique(seen.row[order][rank < quota])])


def _cells(reconstruction: Reconstruction, photo: int) -> I64:
    camera = reconstruction.camera(photo)
    size = np.array([camera.width, camera.height])
    xy = np.clip((reconstruction.uv[photo] * GRID / size).astype(np.int64), 0, GRID - 1)
    return np.asarray(xy[:, 1] * GRID + xy[:, 0])
