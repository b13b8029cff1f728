"""Tracks: which features of which photos show the same point of the ground."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from common.arrays import I64


@dataclass(frozen=True, eq=False)
class Observations:
    """Which feature of which photo belongs to which row of a list of tracks: arrays (M,), photo by photo."""

    photo: I64
    feature: I64
    row: I64

    def only(self, mask: np.typing.NDArray[np.bool_]) -> Observations:
        """Those of a mask (M,)."""
        return Observations(self.photo[mask], self.feature[mask], self.row[mask])


class Tracks:
    """Sets of features, at most one a photo, that grow as photos are matched.

    A match that would put two features of one photo into a track contradicts the track and is left out.
    """

    def __init__(self) -> None:
        self._of: dict[int, I64] = {}
        self._members: list[dict[int, int]] = []

    def __len__(self) -> int:
        return len(self._members)

    def add_photo(self, photo: int, features: int) -> None:
        """Make room for the features of a photo."""
        self._of[photo] = np.full(features, -1, np.int64)

    def of(self, photo: int) -> I64:
        """Track of every feature of a photo (N,), −1 where it has none."""
        return self._of[photo]

    def members(self, track: int) -> dict[int, int]:
        """Feature of each photo in a track."""
        return self._members[track]

    def observations(self, tracks: I64, photos: Iterable[int]) -> Observations:
        """What the photos see of tracks (K,); `row` is the place of the track among these."""
        row_of = np.full(len(self._members) + 1, -1, np.int64)  # the last one is for features without a track
        row_of[tracks] = np.arange(len(tracks))
        found = []
        for photo in photos:
            rows = row_of[self._of[photo]]
            features = np.flatnonzero(rows >= 0)
            found.append(np.stack([np.full(len(features), photo), features, rows[features]]))
        return Observations(*np.hstack([np.zeros((3, 0), np.int64), *found]))

    def link(self, a: int, b: int, pairs: I64) -> None:
        """Join features of photos a and b that match, (M, 2)."""
        of_a, of_b = self._of[a], self._of[b]
        for fa, fb in pairs.tolist():
            ta, tb = int(of_a[fa]), int(of_b[fb])
            if ta < 0 and tb < 0:
                of_a[fa] = of_b[fb] = len(self._members)
                self._members.append({a: fa, b: fb})
            elif tb < 0:
                self._join(ta, b, fb)
            elif ta < 0:
                self._join(tb, a, fa)
            elif ta != tb:
                self._merge(ta, tb)

    def drop(self, track: int, photo: int) -> None:
        """Take a photo's feature out of a track: it turned out to show something else."""
        self._of[photo][self._members[track].pop(photo)] = -1

    def _join(self, track: int, photo: int, feature: int) -> None:
        if photo not in self._members[track]:
            self._members[track][photo] = feature
            self._of[photo][feature] = track

    def _merge(self, a: int, b: int) -> None:
        if len(self._members[a]) < len(self._members[b]):
            a, b = b, a
        if self._members[a].keys() & self._members[b].keys():
            return
        for photo, feature in self._members[b].items():
            self._of[photo][feature] = a
        self._members[a].update(self._members[b])
        self._members[b] = {}
