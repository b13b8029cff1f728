"""Everything the aircraft has to say to the ground: which message goes next, and what answers a query."""

from __future__ import annotations

import logging
from dataclasses import dataclass

from air.uplink.tile_queue import SentTile, TileQueue
from common.bus_memory import intersects
from common.errors import WireError
from common.keys import stream_key, tile_key
from common.messages import Datum, Keyframe, MapDigest, MapTile, TileId, TileRequest
from common.streams import DATUM, DIGEST, KEYFRAME, TILE, Stream
from common.wire import decode, encode

log = logging.getLogger(__name__)

SERVED = (DATUM, KEYFRAME, DIGEST, TILE)
"""The streams that answer queries."""


@dataclass(frozen=True)
class Parcel:
    """Bytes under a key, to be sent as their stream prescribes."""

    key: str
    payload: bytes
    stream: Stream


class Outbox:
    """What waits to be sent and what is held for those who ask, of one flight (core: no bus, no clock, no thread)."""

    def __init__(self, vehicle: str, flight: str) -> None:
        self._vehicle = vehicle
        self._flight = flight
        self._tiles = TileQueue()
        self._waiting: dict[int, Keyframe] = {}
        self._keyframes: dict[int, bytes] = {}
        self._in_hand: SentTile | None = None
        self.datum: Datum | None = None

    @property
    def waiting(self) -> int:
        """How many keyframes and tiles wait to be sent."""
        return len(self._waiting) + len(self._tiles)

    def put_keyframe(self, keyframe: Keyframe) -> None:
        """Let a keyframe wait, in place of an older revision that still waits."""
        self._waiting[keyframe.index] = keyframe

    def put_tile(self, tile: MapTile) -> None:
        """Let a tile wait, in place of an older revision that still waits."""
        self._tiles.put(tile)

    def ask(self, request: TileRequest) -> int:
        """Let the tiles of a request wait again; how many that are."""
        if request.flight != self._flight:
            return 0
        return self._tiles.ask(TileId(*row) for row in request.tiles.tolist())

    def next(self) -> Parcel | None:
        """What goes next, keyframes before tiles, or None. What fits no schema is logged and left out.

        The tile that was taken before counts as sent from now on.
        """
        if self._in_hand is not None:
            self._tiles.note_sent(self._in_hand)
            self._in_hand = None
        while self.waiting:
            try:
                return self._next_keyframe() if self._waiting else self._next_tile()
            except WireError as error:
                log.error("not sent: %s", error)
        return None

    def digest(self, t_ns: int) -> MapDigest:
        """The tiles that were sent, each at the revision that was sent last."""
        return MapDigest(self._flight, t_ns, self._tiles.digest())

    def answer(self, stream: Stream, key_expr: str, payload: bytes, t_ns: int) -> list[Parcel]:
        """Replies to a query for the datum, keyframes, the digest or tiles.

        A query for tiles may carry an encoded TileRequest, which narrows the answer to its flight and tiles.
        """
        replies = [parcel for parcel in self._held(stream, t_ns) if intersects(key_expr, parcel.key)]
        if stream is not TILE or not payload:
            return replies
        try:
            request = decode(TileRequest, payload)
        except WireError as error:
            log.warning("a query for tiles is not understood: %s", error)
            return []
        keys = {tile_key(self._vehicle, TILE, TileId(*row)) for row in request.tiles.tolist()}
        return [parcel for parcel in replies if request.flight == self._flight and parcel.key in keys]

    def _held(self, stream: Stream, t_ns: int) -> list[Parcel]:
        if stream is TILE:
            return [self._tile_parcel(sent) for sent in self._tiles.sent()]
        if stream is KEYFRAME:
            return [self._keyframe_parcel(index, payload) for index, payload in sorted(self._keyframes.items())]
        message = self.datum if stream is DATUM else self.digest(t_ns)
        return [] if message is None else [Parcel(stream_key(self._vehicle, stream), encode(message), stream)]

    def _next_keyframe(self) -> Parcel:
        index = next(iter(self._waiting))
        payload = encode(self._waiting.pop(index))
        self._keyframes[index] = payload
        return self._keyframe_parcel(index, payload)

    def _next_tile(self) -> Parcel:
        tile = self._tiles.pop()
        assert tile is not None
        if isinstance(tile, MapTile):
            tile = SentTile(tile.id, tile.revision, encode(tile))
        self._in_hand = tile
        return self._tile_parcel(tile)

    def _keyframe_parcel(self, index: int, payload: bytes) -> Parcel:
        return Parcel(stream_key(self._vehicle, KEYFRAME, index), payload, KEYFRAME)

    def _tile_parcel(self, tile: SentTile) -> Parcel:
        return Parcel(tile_key(self._vehicle, TILE, tile.id), tile.payload, TILE)
