"""The node that sends the map: one thread for what is paced and may block, one for what goes out every second."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence

from air.config import UplinkConfig
from air.uplink.outbox import SERVED, Outbox, Parcel
from air.uplink.pacing import TokenBucket
from common.bus import Bus, Server, Subscription
from common.errors import BusError, WireError
from common.keys import alive_key, all_of, stream_key
from common.messages import Datum, Health, Keyframe, Level, MapDigest, MapTile, Pose, TileRequest
from common.streams import DATUM, DIGEST, HEALTH, POSE, TILE_REQUEST, Stream
from common.wire import decode, encode

log = logging.getLogger(__name__)

ROLE = "mapper"
BEAT_S = 1.0
BURST_BYTES = 50_000.0
CLOSE_S = 0.3
IDLE_S = 0.5


class Uplink:
    """Sends keyframes, tiles, poses and how the aircraft is doing; answers who asks. Every method returns at once.

    A lock guards the outbox and the pacing; nothing is sent while it is held.
    """

    def __init__(self, bus: Bus, vehicle: str, flight: str, config: UplinkConfig, now_ns: Callable[[], int]) -> None:
        """`now_ns` gives GNSS time for what the aircraft says about itself."""
        self._bus = bus
        self._vehicle = vehicle
        self._now_ns = now_ns
        self._outbox = Outbox(vehicle, flight)
        self._pacing = TokenBucket(config.bytes_per_s, BURST_BYTES, time.monotonic)
        self._changed = threading.Condition()
        self._when_sent: list[Callable[[], None]] = []
        self._health = Health(0, ROLE, Level.OK, "starting")
        self._listed: MapDigest | None = None
        self._stopped = threading.Event()
        self._declared: list[Subscription] = []
        self._threads = [
            threading.Thread(target=self._send_all, name="uplink", daemon=True),
            threading.Thread(target=self._beat_on, name="beat", daemon=True),
        ]

    def start(self) -> None:
        """Begin to send and to answer. Raises BusError."""
        self._declared.append(self._bus.subscribe(all_of(TILE_REQUEST, self._vehicle), self._note_request))
        self._declared += [self._bus.serve(all_of(s, self._vehicle), self._server(s)) for s in SERVED]
        self._declared.append(self._bus.declare_alive(alive_key(self._vehicle, ROLE)))
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop; a link that does not answer is not waited for long."""
        self._stopped.set()
        with self._changed:
            self._changed.notify_all()
        deadline_s = time.monotonic() + CLOSE_S
        for thread in self._threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))
        for declared in self._declared:
            declared.close()

    def send(
        self, keyframes: Sequence[Keyframe], tiles: Sequence[MapTile], when_sent: Callable[[], None] | None = None
    ) -> None:
        """Let keyframes and tiles wait for their turn; `when_sent` is called once nothing waits any more."""
        with self._changed:
            for keyframe in keyframes:
                self._outbox.put_keyframe(keyframe)
            for tile in tiles:
                self._outbox.put_tile(tile)
            if when_sent is not None:
                self._when_sent.append(when_sent)
            self._changed.notify_all()

    def send_pose(self, pose: Pose) -> None:
        """Send a pose now; it is lost when the link is full."""
        try:
            self._publish(Parcel(stream_key(self._vehicle, POSE), encode(pose), POSE))
        except WireError as error:
            log.error("not sent: %s", error)

    def say(self, datum: Datum | None, level: Level, text: str, counts: dict[str, int]) -> None:
        """What goes out every second from now on: where the world is and how the aircraft is doing."""
        with self._changed:
            self._outbox.datum = datum
            self._health = Health(0, ROLE, level, text, counts)

    @property
    def waiting(self) -> int:
        """How many keyframes and tiles wait to be sent."""
        with self._changed:
            return self._outbox.waiting

    # What is paced and may block

    def _send_all(self) -> None:
        while not self._stopped.is_set():
            parcel, wait_s = self._take()
            if parcel is not None and not self._stopped.wait(wait_s):
                self._publish(parcel)
            self._tell_if_sent()

    def _take(self) -> tuple[Parcel | None, float]:
        """The next parcel and how long it must wait for the link, s; None after a while without one."""
        with self._changed:
            if not self._outbox.waiting:
                self._changed.wait(IDLE_S)
            parcel = self._outbox.next()
            return parcel, 0.0 if parcel is None else self._pacing.take(len(parcel.payload))

    def _tell_if_sent(self) -> None:
        with self._changed:
            if self._outbox.waiting:
                return
            callbacks, self._when_sent = self._when_sent, []
        for callback in callbacks:
            callback()

    def _publish(self, parcel: Parcel) -> None:
        try:
            self._bus.publish(parcel.key, parcel.payload, parcel.stream)
        except BusError as error:
            if not self._stopped.is_set():
                log.warning("%s", error)

    # What goes out every second

    def _beat_on(self) -> None:
        while not self._stopped.wait(BEAT_S):
            for parcel in self._beat():
                self._publish(parcel)

    def _beat(self) -> Iterator[Parcel]:
        """Datum, health and digest.

        The digest is a second old: a tile needs its time on the link, and what is on its way is not to be asked for.
        """
        t_ns = self._now_ns()
        with self._changed:
            datum, health, waiting = self._outbox.datum, self._health, self._outbox.waiting
            listed, self._listed = self._listed, self._outbox.digest(t_ns)
        if datum is not None:
            yield Parcel(stream_key(self._vehicle, DATUM), encode(datum), DATUM)
        health = Health(t_ns, health.role, health.level, health.text, {**health.counts, "unsent": waiting})
        yield Parcel(stream_key(self._vehicle, HEALTH, ROLE), encode(health), HEALTH)
        if listed is not None:
            yield Parcel(stream_key(self._vehicle, DIGEST), encode(listed), DIGEST)

    # Those who ask

    def _note_request(self, _key: str, payload: bytes) -> None:
        try:
            request = decode(TileRequest, payload)
        except WireError as error:
            log.warning("a request for tiles is not understood: %s", error)
            return
        with self._changed:
            again = self._outbox.ask(request)
            self._changed.notify_all()
        log.info("%d tiles were asked for, %d of them are sent again", len(request.tiles), again)

    def _server(self, stream: Stream) -> Server:
        def answer(key_expr: str, payload: bytes) -> Iterable[tuple[str, bytes]]:
            with self._changed:
                replies = self._outbox.answer(stream, key_expr, payload, self._now_ns())
            for parcel in replies:
                with self._changed:
                    wait_s = self._pacing.take(len(parcel.payload))
                if self._stopped.wait(wait_s):
                    return
                yield parcel.key, parcel.payload

        return answer
