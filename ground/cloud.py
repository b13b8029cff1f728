"""The map on the ground: tiles, keyframes and datums of every vehicle and flight, the newest revision of each.

Two holders of a map agree by comparing digests: what one lists and the other lacks is asked for again, so any order,
repetition or loss of messages ends in the same map. Payloads are kept encoded: memory is bounded by the bytes
received, and what is handed on is byte for byte what the aircraft sent.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from common.arrays import F64
from common.export.surface import MIN_VIEWS
from common.messages import Datum, Keyframe, MapDigest, MapTile, TileId, TileRequest
from common.wire import decode

V = TypeVar("V")

REQUEST_LIMIT = 2_000
"""Tiles in one request, so that it stays well under the size limit of its stream."""


@dataclass(frozen=True, order=True)
class FlightId:
    """One flight of one vehicle; flights sort by their start."""

    vehicle: str
    flight: str


@dataclass(frozen=True, eq=False)
class HeldTile:
    """A tile as it is kept: its encoded bytes and what may be asked about it without decoding them.

    `cells` is N of the N × N cells of `cell` m; `known` of them have a height, `confident` also enough views and no
    dispute; `z_low` and `z_high` are the 2 % and 98 % quantiles of the heights, m in world (0 when nothing is known).
    """

    flight: FlightId
    id: TileId
    revision: int
    t_ns: int
    cell: float
    cells: int
    known: int
    confident: int
    z_low: float
    z_high: float
    payload: bytes

    @property
    def centre(self) -> F64:
        """Centre (3,) m in world of the box around the tile."""
        side = self.cell * self.cells
        return np.array([(self.id.x + 0.5) * side, (self.id.y + 0.5) * side, (self.z_low + self.z_high) / 2])

    def decoded(self) -> MapTile:
        """The tile itself. Raises WireError when the kept bytes are damaged."""
        return decode(MapTile, self.payload)


@dataclass(frozen=True, eq=False)
class HeldKeyframe:
    """A keyframe and the bytes it came in."""

    flight: FlightId
    keyframe: Keyframe
    payload: bytes


@dataclass(frozen=True, eq=False)
class HeldDatum:
    """The datum of a flight and the bytes it came in."""

    flight: FlightId
    datum: Datum
    payload: bytes


Held = HeldTile | HeldKeyframe | HeldDatum


def hold_tile(vehicle: str, tile: MapTile, payload: bytes, min_views: int = MIN_VIEWS) -> HeldTile:
    """The record that is kept of a tile; a cell is confident with `min_views` views and no dispute."""
    known = np.isfinite(tile.height)
    confident = known & ~tile.disputed & (tile.views >= min_views)
    z_low, z_high = np.quantile(tile.height[known], [0.02, 0.98]) if known.any() else (0.0, 0.0)
    return HeldTile(
        FlightId(vehicle, tile.flight),
        tile.id,
        tile.revision,
        tile.t_ns,
        tile.cell,
        tile.height.shape[0],
        int(known.sum()),
        int(confident.sum()),
        float(z_low),
        float(z_high),
        payload,
    )


class Cloud:
    """Newest revision wins, for several vehicles and flights at once."""

    def __init__(self, min_views: int = MIN_VIEWS) -> None:
        self.min_views = min_views
        self.payload_bytes = 0
        self._datums: dict[FlightId, HeldDatum] = {}
        self._tiles: dict[FlightId, dict[TileId, HeldTile]] = {}
        self._keyframes: dict[FlightId, dict[int, HeldKeyframe]] = {}

    def add(self, vehicle: str, tile: MapTile, payload: bytes) -> HeldTile | None:
        """The record of a tile that is newer than what is held, else None: an equal or older revision is ignored."""
        held = self._tiles.get(FlightId(vehicle, tile.flight), {}).get(tile.id)
        if held is not None and held.revision >= tile.revision:
            return None
        new = hold_tile(vehicle, tile, payload, self.min_views)
        self.restore_tile(new)
        return new

    def add_keyframe(self, vehicle: str, keyframe: Keyframe, payload: bytes) -> HeldKeyframe | None:
        """The record of a keyframe that is newer than what is held, else None."""
        new = HeldKeyframe(FlightId(vehicle, keyframe.flight), keyframe, payload)
        keyframes = self._keyframes.setdefault(new.flight, {})
        old = keyframes.get(keyframe.index)
        if old is not None and old.keyframe.revision >= keyframe.revision:
            return None
        self._count(new, old)
        keyframes[keyframe.index] = new
        return new

    def add_datum(self, vehicle: str, datum: Datum, payload: bytes) -> HeldDatum | None:
        """The record of a datum that differs from what is held, else None."""
        new = HeldDatum(FlightId(vehicle, datum.flight), datum, payload)
        old = self._datums.get(new.flight)
        if old is not None and old.datum == datum:
            return None
        self._count(new, old)
        self._datums[new.flight] = new
        return new

    def restore_tile(self, new: HeldTile) -> bool:
        """Take in a record that was kept; true when it is newer than what is held."""
        tiles = self._tiles.setdefault(new.flight, {})
        old = tiles.get(new.id)
        if old is not None and old.revision >= new.revision:
            return False
        self._count(new, old)
        tiles[new.id] = new
        return True

    def _count(self, new: Held, old: Held | None) -> None:
        self.payload_bytes += len(new.payload) - (len(old.payload) if old else 0)

    def missing(self, vehicle: str, digest: MapDigest) -> TileRequest | None:
        """Request for the tiles that a digest lists and that are lacking or older here; None when there are none."""
        tiles = self._tiles.get(FlightId(vehicle, digest.flight), {})
        lacking = []
        for level, x, y, revision in digest.tiles.tolist():
            held = tiles.get(TileId(level, x, y))
            if held is None or held.revision < revision:
                lacking.append((level, x, y))
        if not lacking:
            return None
        return TileRequest(digest.flight, np.array(lacking[:REQUEST_LIMIT], np.int32).reshape(-1, 3))

    def digest(self, flight: FlightId, t_ns: int = 0) -> MapDigest:
        """What is held of a flight, stamped with the given time."""
        rows = sorted((i.level, i.x, i.y, held.revision) for i, held in self._tiles.get(flight, {}).items())
        return MapDigest(flight.flight, t_ns, np.array(rows, np.int32).reshape(-1, 4))

    def flights(self) -> list[FlightId]:
        """Every flight of which anything is held, sorted by vehicle and start."""
        return sorted({*self._datums, *self._tiles, *self._keyframes})

    def datum(self, flight: FlightId) -> HeldDatum | None:
        """The datum of a flight, or None before it arrived."""
        return self._datums.get(flight)

    def tile(self, flight: FlightId, tile: TileId) -> HeldTile | None:
        """One tile of a flight, or None."""
        return self._tiles.get(flight, {}).get(tile)

    def tiles(self, flight: FlightId | None = None) -> list[HeldTile]:
        """The tiles of a flight, or of all."""
        return [held for tiles in _of(self._tiles, flight) for held in tiles.values()]

    def keyframes(self, flight: FlightId | None = None) -> list[HeldKeyframe]:
        """The keyframes of a flight, or of all, in order of their index."""
        return [kept for keyframes in _of(self._keyframes, flight) for _, kept in sorted(keyframes.items())]

    def datums(self) -> list[HeldDatum]:
        """The datums of all flights."""
        return list(self._datums.values())


def _of(table: dict[FlightId, V], flight: FlightId | None) -> Iterator[V]:
    """The entries of one flight, or of all."""
    if flight is None:
        yield from table.values()
    elif flight in table:
        yield table[flight]
