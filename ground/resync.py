"""When to ask again for what a digest lists and is not here."""

from __future__ import annotations

import numpy as np

from common.messages import TileRequest
from ground.cloud import FlightId

FIRST_WAIT_NS = 2_000_000_000
LONGEST_WAIT_NS = 32_000_000_000

Place = tuple[FlightId, int, int, int]


class Resync:
    """Lets a tile be asked for at once, then after 2 s, 4 s … 32 s: a slow link is not asked to send twice."""

    def __init__(self) -> None:
        self._next: dict[Place, tuple[int, int]] = {}

    def due(self, vehicle: str, request: TileRequest | None, flight: str, now_ns: int) -> TileRequest | None:
        """The part of a request that may be sent now; None when there is none. What is not asked for is forgotten."""
        flight_id = FlightId(vehicle, flight)
        wanted = {(flight_id, *tile): tile for tile in map(tuple, request.tiles.tolist())} if request else {}
        for place in [place for place in self._next if place[0] == flight_id and place not in wanted]:
            del self._next[place]
        due = []
        for place, tile in wanted.items():
            next_ns, wait_ns = self._next.get(place, (now_ns, FIRST_WAIT_NS))
            if now_ns >= next_ns:
                self._next[place] = (now_ns + wait_ns, min(2 * wait_ns, LONGEST_WAIT_NS))
                due.append(tile)
        return TileRequest(flight, np.array(due, np.int32).reshape(-1, 3)) if due else None
