"""The map as the aircraft holds it: per tile the layers of all pairs, and the fused tile that others get."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

from air.mapping.fusion import fuse
from air.mapping.layer import Layer
from common.messages import MapTile, TileId

Photos = tuple[int, int]


class Tiles:
    """Stacks of layers by tile. A pair of photos has at most one layer in a tile; a new one replaces the old."""

    def __init__(self, cell: float, tile_cells: int) -> None:
        self._cell = cell
        self._tile_cells = tile_cells
        self._layers: defaultdict[TileId, dict[Photos, Layer]] = defaultdict(dict)
        self._tiles: dict[TileId, MapTile] = {}

    def replace(self, photos: Photos, layers: dict[TileId, Layer]) -> set[TileId]:
        """Puts the layers of a pair in place of its old ones; the tiles that either touches."""
        touched = {tile for tile, stack in self._layers.items() if stack.pop(photos, None) is not None}
        for tile, layer in layers.items():
            self._layers[tile][photos] = layer
        return touched | set(layers)

    def fuse(self, flight: str, t_ns: int, touched: Iterable[TileId], threads: int = 1) -> list[MapTile]:
        """The touched tiles fused anew, in order, each with a revision one higher than before."""
        with ThreadPoolExecutor(threads) as pool:
            fused = list(pool.map(lambda tile: self._fuse(flight, t_ns, tile), sorted(touched)))
        self._tiles.update((tile.id, tile) for tile in fused)
        return fused

    def all(self) -> list[MapTile]:
        """Every tile at its current revision, in order."""
        return [self._tiles[tile] for tile in sorted(self._tiles)]

    def _fuse(self, flight: str, t_ns: int, tile: TileId) -> MapTile:
        # Sorted, so that the order in which pairs arrived leaves no trace in the sums.
        stack = [layer for _, layer in sorted(self._layers[tile].items())]
        surface = fuse(stack, self._cell, self._tile_cells)
        before = self._tiles.get(tile)
        return MapTile(
            flight,
            tile,
            before.revision + 1 if before else 1,
            t_ns,
            self._cell,
            surface.height,
            surface.sigma,
            surface.colour,
            surface.views,
            surface.disputed,
        )
