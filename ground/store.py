"""The ground's memory on disk: one SQLite file that survives kill -9.

What is put is written within half a second, in one transaction; what a crash loses of that, the next digest of the
aircraft brings back. While the disk refuses, everything waits in memory and is written when it accepts again.
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from common.errors import StoreError, WireError
from common.messages import Datum, Keyframe, Message, Pose, TileId
from common.streams import DATUM, KEYFRAME, POSE, Stream
from common.wire import decode
from ground.cloud import Cloud, FlightId, HeldDatum, HeldKeyframe, HeldTile
from ground.tracks import HeldPose, Tracks

log = logging.getLogger(__name__)

VERSION = 1
COMMIT_EVERY_NS = 500_000_000
RETRY_EVERY_NS = 5_000_000_000
PENDING_LIMIT = 200_000
"""Records that wait for a disk that refuses; beyond it the oldest are given up."""

Held = HeldTile | HeldKeyframe | HeldDatum | HeldPose

_SCHEMA = f"""
BEGIN;
CREATE TABLE tile (vehicle TEXT, flight TEXT, level INT, x INT, y INT, revision INT, t_ns INT, cell REAL, cells INT,
    known INT, confident INT, z_low REAL, z_high REAL, payload BLOB, PRIMARY KEY (vehicle, flight, level, x, y));
CREATE TABLE keyframe (vehicle TEXT, flight TEXT, number INT, revision INT, payload BLOB,
    PRIMARY KEY (vehicle, flight, number));
CREATE TABLE datum (vehicle TEXT, flight TEXT, payload BLOB, PRIMARY KEY (vehicle, flight));
CREATE TABLE pose (vehicle TEXT, flight TEXT, t_ns INT, payload BLOB, PRIMARY KEY (vehicle, flight, t_ns));
PRAGMA user_version = {VERSION};
COMMIT;
"""


class Store:
    """One file, used from one thread at a time. Opened at the first flush or load."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._connection: sqlite3.Connection | None = None
        self._pending: dict[tuple[object, ...], tuple[object, ...]] = {}
        self._due_ns = 0

    def load(self, cloud: Cloud, tracks: Tracks) -> None:
        """Bring everything kept into a cloud and tracks. Raises StoreError, which names the file."""
        with self._transaction() as connection:
            load(connection, cloud, tracks, self.path)

    def put(self, held: Held) -> None:
        """Note a record for the next flush; a newer one of the same place replaces it."""
        table, place, values = _row(held)
        while len(self._pending) >= PENDING_LIMIT:
            del self._pending[next(iter(self._pending))]
        self._pending[table, *place] = values

    def flush(self, now_ns: int, force: bool = False) -> bool:
        """Write what was put, at most every half second, or every five after a failure; true when it was written.

        Raises StoreError, which names the file, when the disk refuses; nothing is lost by that.
        """
        if not self._pending or (now_ns < self._due_ns and not force):
            return False
        self._due_ns = now_ns + RETRY_EVERY_NS
        with self._transaction() as connection:
            for (table, *place), values in self._pending.items():
                row = (*place, *values)
                marks = ",".join("?" * len(row))
                connection.execute(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", row)
        self._pending.clear()
        self._due_ns = now_ns + COMMIT_EVERY_NS
        return True

    def close(self) -> None:
        """Write what is left and close the file. Raises StoreError when the disk refuses."""
        try:
            self.flush(0, force=True)
        finally:
            if self._connection is not None:
                self._connection.close()
                self._connection = None

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        try:
            if self._connection is None:
                self._connection = _open(self.path)
            with self._connection:
                yield self._connection
        except (sqlite3.Error, OSError) as error:
            if self._connection is not None:
                self._connection.close()
                self._connection = None
            raise StoreError(f"{self.path}: {error}; check the disk, or move the file away") from error


def read_store(path: Path) -> tuple[Cloud, Tracks]:
    """Everything a store file holds, opened read-only, also while the service writes to it.

    Raises StoreError, which names the file, when it is missing, damaged or of another version.
    """
    if not path.is_file():
        raise StoreError(f"{path}: no such store; give the configuration that `luojia-ground serve` was started with")
    cloud, tracks = Cloud(), Tracks()
    try:
        connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=10.0)
        try:
            # A service that was started a moment ago has made the file but not yet its tables.
            if not _is_blank(connection):
                _check_version(connection, path)
                load(connection, cloud, tracks, path)
        finally:
            connection.close()
    except sqlite3.Error as error:
        raise StoreError(f"{path}: {error}") from error
    return cloud, tracks


def load(connection: sqlite3.Connection, cloud: Cloud, tracks: Tracks, path: Path) -> None:
    """Bring every row into a cloud and tracks. A row that no longer decodes is left out: the aircraft has it too."""
    damaged = 0
    for vehicle, stream, payload in _payloads(connection):
        try:
            _restore(cloud, tracks, vehicle, decode(stream, payload), payload)
        except WireError:
            damaged += 1
    for vehicle, flight, level, x, y, *rest in connection.execute("SELECT * FROM tile"):
        cloud.restore_tile(HeldTile(FlightId(vehicle, flight), TileId(level, x, y), *rest))
    if damaged:
        log.warning("%s: %d kept messages are damaged and left out", path, damaged)


def _payloads(connection: sqlite3.Connection) -> Iterator[tuple[str, Stream, bytes]]:
    """Vehicle, stream and bytes of everything that is kept beside the tiles; poses in order of time."""
    for stream, order in ((DATUM, "flight"), (KEYFRAME, "number"), (POSE, "t_ns")):
        for vehicle, payload in connection.execute(f"SELECT vehicle, payload FROM {stream.name} ORDER BY {order}"):
            yield vehicle, stream, payload


def _restore(cloud: Cloud, tracks: Tracks, vehicle: str, message: Message, payload: bytes) -> None:
    match message:
        case Datum():
            cloud.add_datum(vehicle, message, payload)
        case Keyframe():
            cloud.add_keyframe(vehicle, message, payload)
        case Pose():
            tracks.add(vehicle, message, payload)


def _open(path: Path) -> sqlite3.Connection:
    path.parent.mkdir(parents=True, exist_ok=True)
    connection = sqlite3.connect(path, timeout=5.0, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        if _is_blank(connection):
            connection.executescript(_SCHEMA)
        _check_version(connection, path)
    except BaseException:
        connection.close()
        raise
    return connection


def _is_blank(connection: sqlite3.Connection) -> bool:
    tables: int = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
    return tables == 0


def _check_version(connection: sqlite3.Connection, path: Path) -> None:
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version != VERSION:
        raise StoreError(f"{path}: version {version} of the store, this program reads {VERSION}; move the file away")


def _row(held: Held) -> tuple[str, tuple[object, ...], tuple[object, ...]]:
    """Table, primary key and remaining values of a record, in the order of the columns."""
    flight = (held.flight.vehicle, held.flight.flight)
    match held:
        case HeldTile():
            i, s = held.id, held
            values = (s.revision, s.t_ns, s.cell, s.cells, s.known, s.confident, s.z_low, s.z_high, s.payload)
            return "tile", (*flight, i.level, i.x, i.y), values
        case HeldKeyframe():
            return "keyframe", (*flight, held.keyframe.index), (held.keyframe.revision, held.payload)
        case HeldDatum():
            return "datum", flight, (held.payload,)
        case HeldPose():
            return "pose", (*flight, held.pose.t_ns), (held.payload,)
