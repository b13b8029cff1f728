"""Tiles on their way to the ground: the newest revision of each, first come first served, sent again when asked."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from common.arrays import I32
from common.messages import MapTile, TileId


@dataclass(frozen=True)
class SentTile:
    """What left the aircraft of a tile: its revision and the very bytes."""

    id: TileId
    revision: int
    payload: bytes


class TileQueue:
    """The tiles that wait and those that were sent (core: encodes nothing, sends nothing).

    A tile that changes while it waits keeps its place. Only what was sent is listed in the digest: what still waits
    comes by itself and need not be asked for.
    """

    def __init__(self) -> None:
        # None waits to be sent again as it was sent last.
        self._waiting: dict[TileId, MapTile | None] = {}
        self._sent: dict[TileId, SentTile] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, tile: MapTile) -> None:
        """Let a tile wait for its turn, in place of an older revision that still waits; an old revision is ignored."""
        known = self._waiting.get(tile.id) or self._sent.get(tile.id)
        if known is None or tile.revision > known.revision:
            self._waiting[tile.id] = tile

    def ask(self, tiles: Iterable[TileId]) -> int:
        """Let tiles that were sent wait again, as far as they do not wait already; how many that are."""
        again = [tile for tile in tiles if tile in self._sent and tile not in self._waiting]
        self._waiting.update(dict.fromkeys(again))
        return len(again)

    def pop(self) -> MapTile | SentTile | None:
        """The tile whose turn it is: not yet encoded, or as it was sent before; None when none waits."""
        if not self._waiting:
            return None
        first = next(iter(self._waiting))
        return self._waiting.pop(first) or self._sent[first]

    def note_sent(self, tile: SentTile) -> None:
        """Keep what was sent."""
        self._sent[tile.id] = tile

    def sent(self) -> list[SentTile]:
        """Every tile as it was sent last, in order."""
        return [self._sent[tile] for tile in sorted(self._sent)]

    def digest(self) -> I32:
        """Rows (M, 4) int32 of what was sent: level, x, y, revision; sorted."""
        rows = [(s.id.level, s.id.x, s.id.y, s.revision) for s in self.sent()]
        return np.array(rows, np.int32).reshape(-1, 4)
