"""All that one ground station knows, without a clock, a socket or a thread: messages in, what follows from them out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.arrays import F64
from common.bus_memory import intersects
from common.errors import WireError
from common.export.surface import MIN_VIEWS
from common.keys import parse_key, stream_key, tile_key
from common.measurements import VehicleState
from common.messages import Datum, Health, Keyframe, Level, MapDigest, MapTile, Pose, TileRequest
from common.streams import DATUM, DIGEST, KEYFRAME, TILE, Stream
from common.wire import decode, encode
from ground.cloud import Cloud, FlightId
from ground.inbox import Inbox, Received, StreamCount
from ground.resync import Resync
from ground.store import Held
from ground.tracks import Tracks
from ground.viewer.scene import Aircraft, HealthRow, Scene, StreamRow, VehicleRow

GROUND_ROLE = "ground"
HEARD_NS = 3_000_000_000
"""A vehicle is connected while its liveliness token stands or something of it came within this time."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What follows from a message: a record to keep, and tiles to ask a vehicle for."""

    keep: Held | None = None
    vehicle: str = ""
    request: TileRequest | None = None


class Station:
    """The merged map of all vehicles, where they are, and how well everything arrives."""

    def __init__(self, name: str, min_views: int = MIN_VIEWS) -> None:
        self.name = name
        self.cloud = Cloud(min_views)
        self.tracks = Tracks()
        self.inbox = Inbox()
        self.requested = 0
        self._resync = Resync()
        self._roles: dict[str, set[str]] = {}
        self._health: dict[tuple[str, str], tuple[Health, int]] = {}
        self._states: dict[str, tuple[VehicleState, int]] = {}

    def receive(self, key: str, payload: bytes, now_ns: int) -> Outcome:
        """Take in bytes that came under a key; bad ones are counted and change nothing."""
        received = self.inbox.receive(key, payload, now_ns)
        return Outcome() if received is None else self._take_in(received)

    def _take_in(self, received: Received) -> Outcome:
        vehicle, payload = received.vehicle, received.payload
        match received.message:
            case Pose() as pose:
                return Outcome(self.tracks.add(vehicle, pose, payload))
            case MapTile() as tile:
                return Outcome(self.cloud.add(vehicle, tile, payload))
            case Keyframe() as keyframe:
                return Outcome(self.cloud.add_keyframe(vehicle, keyframe, payload))
            case Datum() as datum:
                return Outcome(self.cloud.add_datum(vehicle, datum, payload))
            case MapDigest() as digest:
                return Outcome(vehicle=vehicle, request=self._due(vehicle, digest, received.arrival_ns))
            case VehicleState() as state:
                self._states[vehicle] = (state, received.arrival_ns)
            case Health() as health:
                self._health[vehicle, health.role] = (health, received.arrival_ns)
        return Outcome()

    def _due(self, vehicle: str, digest: MapDigest, now_ns: int) -> TileRequest | None:
        missing = self.cloud.missing(vehicle, digest)
        request = self._resync.due(vehicle, missing, digest.flight, now_ns)
        self.requested += len(request.tiles) if request else 0
        return request

    def lacking(self, key: str, payload: bytes) -> tuple[str, TileRequest] | None:
        """The vehicle of an encoded digest, and a request for what the digest lists and is not held here; else None."""
        try:
            vehicle = parse_key(key).vehicle
            request = self.cloud.missing(vehicle, decode(MapDigest, payload))
        except WireError:
            return None
        return None if request is None else (vehicle, request)

    def set_alive(self, vehicle: str, role: str, alive: bool) -> bool:
        """Note that a liveliness token appeared or vanished; true when it is the first of its vehicle."""
        roles = self._roles.setdefault(vehicle, set())
        first = alive and not roles
        (roles.add if alive else roles.discard)(role)
        return first

    def answer(self, stream: Stream, key_expr: str, payload: bytes = b"") -> list[tuple[str, bytes]]:
        """Replies (key, payload) to a query for tiles, keyframes, datums or digests, of every vehicle and flight.

        A query for tiles may carry an encoded TileRequest, which narrows the answer to its flight and tiles.
        """
        if stream is DIGEST:
            flights = self.cloud.flights()
            replies = [(stream_key(flight.vehicle, DIGEST), encode(self.cloud.digest(flight))) for flight in flights]
        elif stream is DATUM:
            replies = [(stream_key(kept.flight.vehicle, DATUM), kept.payload) for kept in self.cloud.datums()]
        elif stream is KEYFRAME:
            replies = [
                (stream_key(kept.flight.vehicle, KEYFRAME, kept.keyframe.index), kept.payload)
                for kept in self.cloud.keyframes()
            ]
        else:
            replies = self._tiles(payload)
        return [(key, kept) for key, kept in replies if intersects(key_expr, key)]

    def _tiles(self, payload: bytes) -> list[tuple[str, bytes]]:
        held = self.cloud.tiles()
        if payload:
            try:
                request = decode(TileRequest, payload)
            except WireError:
                return []
            wanted = {tuple(row) for row in request.tiles.tolist()}
            held = [
                tile
                for tile in held
                if tile.flight.flight == request.flight and (tile.id.level, tile.id.x, tile.id.y) in wanted
            ]
        return [(tile_key(tile.flight.vehicle, TILE, tile.id), tile.payload) for tile in held]

    def health(self, t_ns: int, store_fault: str) -> Health:
        """What this station says about itself."""
        counts = {
            "tiles": len(self.cloud.tiles()),
            "keyframes": len(self.cloud.keyframes()),
            "bytes": self.cloud.payload_bytes,
            "faults": self.inbox.faults,
            "requested": self.requested,
        }
        level = Level.DEGRADED if store_fault else Level.OK
        text = f"not kept on disk: {store_fault}" if store_fault else ""
        return Health(t_ns, GROUND_ROLE, level, text[:200], counts)

    def scene(self, now_ns: int) -> Scene:
        """What there is to show."""
        datums = self.cloud.datums()
        return Scene(
            datums={kept.flight: kept.datum for kept in datums},
            origin=datums[0].datum if datums else None,
            tiles=self.cloud.tiles(),
            keyframes=self.cloud.keyframes(),
            aircraft=[self._aircraft(flight, now_ns) for flight in self.tracks.newest_flights()],
            alive={vehicle: self._connected(vehicle, now_ns) for vehicle in self._vehicles()},
            streams=[_row(count, now_ns) for _, count in sorted(self.inbox.streams.items()) if self._shows(count)],
            health=[
                HealthRow(vehicle, role, health.level, health.text, (now_ns - arrival_ns) / 1e9)
                for (vehicle, role), (health, arrival_ns) in sorted(self._health.items())
            ],
            vehicles=[
                VehicleRow(vehicle, state, (now_ns - arrival_ns) / 1e9)
                for vehicle, (state, arrival_ns) in sorted(self._states.items())
            ],
            faults=self.inbox.faults,
            station=self.name,
        )

    def _shows(self, count: StreamCount) -> bool:
        return count.vehicle != self.name

    def _vehicles(self) -> list[str]:
        """Every aircraft that was heard of; a vehicle that is only a ground station is none."""
        stations = {v for v, role in self._health if role == GROUND_ROLE} | {self.name}
        stations |= {v for v, roles in self._roles.items() if roles == {GROUND_ROLE}}
        known = {count.vehicle for count in self.inbox.streams.values()} | {f.vehicle for f in self.cloud.flights()}
        return sorted((known | {v for v, roles in self._roles.items() if roles}) - stations)

    def _connected(self, vehicle: str, now_ns: int) -> bool:
        heard_ns = [count.last_ns for count in self.inbox.streams.values() if count.vehicle == vehicle]
        recently = any(last_ns is not None and now_ns - last_ns < HEARD_NS for last_ns in heard_ns)
        return recently or bool(self._roles.get(vehicle))

    def _aircraft(self, flight: FlightId, now_ns: int) -> Aircraft:
        pose = self.tracks.latest(flight)
        assert pose is not None
        poses = self.inbox.streams.get((flight.vehicle, "pose"))
        age_s = poses.age_s(now_ns) if poses else None
        alive = self._connected(flight.vehicle, now_ns)
        return Aircraft(flight, pose, self._path(flight), alive, float("inf") if age_s is None else age_s)

    def _path(self, flight: FlightId) -> F64:
        """Positions (N, 3) m in world: the keyframes, whose poses improve, then the poses that are newer."""
        keyframes = sorted((kept.keyframe for kept in self.cloud.keyframes(flight)), key=lambda k: k.t_ns)
        if not keyframes:
            return self.tracks.positions(flight)
        refined = np.array([keyframe.T_world_cam.t for keyframe in keyframes])
        return np.concatenate([refined, self.tracks.positions(flight, after_ns=keyframes[-1].t_ns)])


def _row(count: StreamCount, now_ns: int) -> StreamRow:
    return StreamRow(
        count.vehicle,
        count.stream.name,
        count.messages,
        count.rate_hz(now_ns),
        count.bytes_per_s(now_ns),
        count.age_s(now_ns),
        count.stale(now_ns),
        count.faults,
        count.fault,
    )
