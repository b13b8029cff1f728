"""The node of the ground service: binds the bus to what the station knows and to the store."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable

from common.bus import Bus, Server, Subscription
from common.errors import BusError, StoreError
from common.keys import alive_key, all_of, stream_key
from common.messages import TileRequest
from common.streams import DATUM, DIGEST, HEALTH, KEYFRAME, RTCM, STREAMS, TILE, TILE_REQUEST, Radio, Stream
from common.wire import encode
from ground.mailbox import Letter, Mailbox
from ground.station import GROUND_ROLE, Station
from ground.store import Store
from ground.viewer.scene import Scene

log = logging.getLogger(__name__)

HEALTH_EVERY_NS = 1_000_000_000
TAKE_TIMEOUT_S = 0.1
QUERY_TIMEOUT_S = 10.0
SERVED = (TILE, KEYFRAME, DATUM, DIGEST)
EVERYONE = "*"


class Gateway:
    """Runs a station on a bus: hears every vehicle, keeps what is new, asks for what is missing, answers others.

    One worker thread takes in what the bus hands over; another asks those who were there before. A lock guards the
    station, so that the viewer and the bus may look at it at any time.
    """

    def __init__(self, bus: Bus, station: Station, store: Store | None, now_ns: Callable[[], int]) -> None:
        """`now_ns` gives GNSS time for what the station says about itself."""
        self._bus = bus
        self._station = station
        self._store = store
        self._now_ns = now_ns
        self._store_fault = ""
        self._mailbox = Mailbox()
        self._newcomers: queue.Queue[str | None] = queue.Queue()
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._subscriptions: list[Subscription] = []
        self._health_due_ns = 0
        self._worker = threading.Thread(target=self._work, name="gateway", daemon=True)
        self._asker = threading.Thread(target=self._ask_newcomers, name="catch-up", daemon=True)

    def start(self) -> None:
        """Load what was kept, listen to everyone, and ask those who were there before. Raises BusError."""
        self._load()
        for stream in STREAMS:
            if stream.radio is not Radio.LOCAL and stream not in (TILE_REQUEST, RTCM):
                self._subscriptions.append(self._bus.subscribe(all_of(stream), self._hand_over))
        self._subscriptions.append(self._bus.watch_alive(alive_key("*", "*"), self._note_alive))
        self._subscriptions.append(self._bus.declare_alive(alive_key(self._station.name, GROUND_ROLE)))
        self._worker.start()
        self._asker.start()

    def close(self) -> None:
        """Stop, and write what is left to the store."""
        self._stopped.set()
        self._newcomers.put(None)
        self._worker.join(timeout=5.0)
        for subscription in self._subscriptions:
            subscription.close()
        if self._store is not None:
            try:
                self._store.close()
            except StoreError as error:
                self._note_store_fault(error)

    def scene(self) -> Scene:
        """What there is to show at this moment."""
        with self._lock:
            return self._station.scene(time.monotonic_ns())

    def _hand_over(self, key: str, payload: bytes) -> None:
        self._mailbox.put(Letter(key, payload, time.monotonic_ns()))

    def _note_alive(self, key: str, alive: bool) -> None:
        vehicle, _, role = key.rsplit("/", 3)[1:]
        with self._lock:
            first_role = self._station.set_alive(vehicle, role, alive)
        if vehicle == self._station.name:
            return
        if first_role:
            # A vehicle answers for itself; another station may hold anything.
            self._newcomers.put(EVERYONE if role == GROUND_ROLE else vehicle)
        log.info("%s %s %s", vehicle, role, "is connected" if alive else "is gone")

    def _work(self) -> None:
        while not self._stopped.is_set():
            for letter in self._mailbox.take(TAKE_TIMEOUT_S):
                self._take_in(letter)
            self._flush()
            self._say_health()

    def _take_in(self, letter: Letter) -> bool:
        """Whether a letter brought something new to keep."""
        with self._lock:
            outcome = self._station.receive(letter.key, letter.payload, letter.arrival_ns)
            if outcome.keep is not None and self._store is not None:
                self._store.put(outcome.keep)
        if outcome.request is not None:
            self._publish(stream_key(outcome.vehicle, TILE_REQUEST), encode(outcome.request), TILE_REQUEST)
        return outcome.keep is not None

    def _say_health(self) -> None:
        if time.monotonic_ns() < self._health_due_ns:
            return
        self._health_due_ns = time.monotonic_ns() + HEALTH_EVERY_NS
        with self._lock:
            health = self._station.health(self._now_ns(), self._store_fault)
        self._publish(stream_key(self._station.name, HEALTH, GROUND_ROLE), encode(health), HEALTH)

    def _publish(self, key: str, payload: bytes, stream: Stream) -> None:
        try:
            self._bus.publish(key, payload, stream)
        except BusError as error:
            log.warning("%s", error)

    # Those who were there before

    def _ask_newcomers(self) -> None:
        """Ask everyone once, then whoever appears. Begin to answer in between: earlier, it would answer itself."""
        self._catch_up(EVERYONE)
        self._subscriptions += [self._bus.serve(all_of(stream), self._server(stream)) for stream in SERVED]
        while (vehicle := self._newcomers.get()) is not None:
            self._catch_up(vehicle)

    def _catch_up(self, vehicle: str) -> None:
        """Bring in datums and keyframes of a vehicle, and the tiles that other stations hold and this one lacks."""
        try:
            for stream in (DATUM, KEYFRAME):
                self._ask(all_of(stream, vehicle))
            for key, digest in self._bus.query(all_of(DIGEST, vehicle), timeout_s=QUERY_TIMEOUT_S):
                while (lacking := self._lacking(key, digest)) is not None:
                    owner, request = lacking
                    if not self._ask(all_of(TILE, owner), encode(request)):
                        break
        except BusError as error:
            log.warning("catching up with %s: %s", vehicle, error)

    def _ask(self, key_expr: str, payload: bytes = b"") -> int:
        """How many of the replies to a query were news."""
        replies = self._bus.query(key_expr, payload, timeout_s=QUERY_TIMEOUT_S)
        return sum(self._take_in(Letter(key, reply, time.monotonic_ns())) for key, reply in replies)

    def _lacking(self, key: str, digest: bytes) -> tuple[str, TileRequest] | None:
        with self._lock:
            return self._station.lacking(key, digest)

    def _server(self, stream: Stream) -> Server:
        def answer(key_expr: str, payload: bytes) -> list[tuple[str, bytes]]:
            with self._lock:
                return self._station.answer(stream, key_expr, payload)

        return answer

    # The store

    def _load(self) -> None:
        if self._store is None:
            return
        try:
            self._store.load(self._station.cloud, self._station.tracks)
        except StoreError as error:
            self._note_store_fault(error)

    def _flush(self) -> None:
        if self._store is None:
            return
        try:
            with self._lock:
                written = self._store.flush(time.monotonic_ns())
        except StoreError as error:
            self._note_store_fault(error)
        else:
            if written and self._store_fault:
                log.info("%s is kept again", self._store.path)
                self._store_fault = ""

    def _note_store_fault(self, error: StoreError) -> None:
        if str(error) != self._store_fault:
            self._store_fault = str(error)
            log.error("the map is not kept on disk: %s", error)
