"""Coarser versions of a tile for the viewer: each level halves the number of cells a side and doubles their size."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from common.arrays import F32, Bool
from common.messages import MapTile
from ground.cloud import FlightId, HeldTile

MAX_LEVEL = 6
CACHE_BYTES = 256_000_000

D = TypeVar("D", bound=np.generic)


def reduced(tile: MapTile, min_views: int) -> MapTile:
    """The tile of N × N cells (N even) with N/2 × N/2 cells of twice the size.

    Of every 2 × 2 cells the confident ones (enough views, no dispute) count, or all known ones where none is. Height
    and colour are their means, sigma the root mean square, views the largest; the result is disputed where all are.
    """
    height, disputed, views = _quarters(tile.height), _quarters(tile.disputed), _quarters(tile.views)
    known = np.isfinite(height)
    confident = known & ~disputed & (views >= min_views)
    used = np.where(confident.any(axis=0), confident, known)
    weight = (used / np.maximum(used.sum(axis=0), 1)).astype(np.float32)
    colour = (_quarters(tile.colour) * weight[..., None]).sum(axis=0)
    return replace(
        tile,
        cell=tile.cell * 2,
        height=_mean(height, weight, used),
        sigma=np.sqrt(_mean(_quarters(tile.sigma) ** 2, weight, used)),
        colour=colour.round().astype(np.uint8),
        views=np.where(used, views, 0).max(axis=0),
        disputed=np.asarray((disputed | ~used).all(axis=0) & used.any(axis=0)),
    )


class LevelCache:
    """Decoded and reduced tiles, the least recently used of them forgotten above a limit of bytes."""

    def __init__(self, min_views: int, limit: int = CACHE_BYTES) -> None:
        self._min_views = min_views
        self._limit = limit
        self._bytes = 0
        self._tiles: OrderedDict[tuple[FlightId, Any, int, int], MapTile] = OrderedDict()

    def level(self, held: HeldTile, level: int) -> MapTile:
        """The tile reduced `level` times (0: as it came). Raises WireError when the kept bytes are damaged."""
        key = (held.flight, held.id, held.revision, level)
        tile = self._tiles.get(key)
        if tile is not None:
            self._tiles.move_to_end(key)
            return tile
        tile = held.decoded() if level == 0 else self._coarser(self.level(held, level - 1))
        self._tiles[key] = tile
        self._bytes += _size(tile)
        while self._bytes > self._limit and len(self._tiles) > 1:
            self._bytes -= _size(self._tiles.popitem(last=False)[1])
        return tile

    def _coarser(self, tile: MapTile) -> MapTile:
        return tile if tile.height.shape[0] % 2 else reduced(tile, self._min_views)


def _quarters(plane: npt.NDArray[D]) -> npt.NDArray[D]:
    """The four cells of every 2 × 2 block: (4, N/2, N/2, …) of (N, N, …)."""
    return np.stack([plane[row::2, col::2] for row in (0, 1) for col in (0, 1)])


def _mean(values: F32, weight: F32, used: Bool) -> F32:
    """Weighted mean over the four cells of each block, NaN where none is used."""
    mean = (np.where(used, values, 0) * weight).sum(axis=0)
    return np.where(used.any(axis=0), mean, np.nan).astype(np.float32)


def _size(tile: MapTile) -> int:
    planes = (tile.height, tile.sigma, tile.colour, tile.views, tile.disputed)
    return sum(plane.nbytes for plane in planes)
