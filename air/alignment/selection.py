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

    A track is taken while a photo that sees it still has room in the grid cell where it appears; tracks seen by more
    photos come first, because they tie the block together.
    """
    quota = max(1, per_photo // GRID**2)
    wanted = set(photos)
    tracks = reconstruction.tracks_of(photos).tolist()
    members = {t: [(i, f) for i, f in reconstruction.tracks.members(t).items() if i in wanted] for t in tracks}
    cells = {i: _cells(reconstruction, i) for i in photos}
    filled = {i: np.zeros(GRID * GRID, int) for i in photos}
    chosen = []
    for t in sorted(tracks, key=lambda t: (-len(members[t]), t)):
        if len(members[t]) < 2 or all(filled[i][cells[i][f]] >= quota for i, f in members[t]):
            continue
        chosen.append(t)
        for i, f in members[t]:
            filled[i][cells[i][f]] += 1
    return np.array(chosen, np.int64)


def _cells(reconstruction: Reconstruction, photo: int) -> list[int]:
    camera = reconstruction.camera(photo)
    size = np.array([camera.width, camera.height])
    xy = np.clip((reconstruction.uv[photo] * GRID / size).astype(int), 0, GRID - 1)
    return (xy[:, 1] * GRID + xy[:, 0]).tolist()  # type: ignore[no-any-return]
