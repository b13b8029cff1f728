"""The aircraft's process: a source, the map that grows from it, and the uplink, until somebody stops it."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from air.config import AirConfig
from air.flight import flight_now
from air.jump import Jump
from air.live import LiveMap
from air.preparation import prepared
from air.sources.source import PhotoSource, open_photos
from air.uplink.uplink import Uplink
from air.warm_up import warm_up
from common.bus import ZenohBus
from common.clock import SystemClock
from common.messages import Datum, Keyframe, Photo

log = logging.getLogger(__name__)

STOP_S = 0.8
SENT_WITHIN_S = 2.0


class StoppedError(Exception):
    """The flight was ended from outside while its source waited for the next photo."""


def fly(config: AirConfig, url: str | None = None) -> int:
    """Exit code 0 after SIGINT or SIGTERM; until then maps a source and sends the map, also after the last photo.

    Raises SourceError, also when the source fails on the way, and BusError.
    """
    stop = threading.Event()
    source = open_photos(url or config.source, config.pace, sleep=_sleep_until(stop))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return _fly(config, flight_now(), None, source, stop)


def map_photos(
    config: AirConfig, flight: str, datum: Datum, source_until: Callable[[Callable[[], None]], PhotoSource]
) -> int:
    """Exit code 0 after SIGTERM; until then maps photos that come from elsewhere, around a datum, and sends the map.

    `source_until` makes their source from a function that raises once they are not wanted any more. Raises BusError.
    """
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())

    def check_stop() -> None:
        if stop.is_set():
            raise StoppedError

    return _fly(config, flight, datum, source_until(check_stop), stop)


def _fly(config: AirConfig, flight: str, datum: Datum | None, source: PhotoSource, stop: threading.Event) -> int:
    log.info("flight %s of %s: photos from %s", flight, config.vehicle, source.url)
    warm_up()
    bus = ZenohBus(config.bus)
    uplink = Uplink(bus, config.vehicle, flight, config.uplink, SystemClock().now_ns)
    mapping = Mapping(LiveMap(flight, config, datum), source, config, uplink, stop)
    try:
        uplink.start()
        mapping.start()
        stop.wait()
    finally:
        uplink.close()
        bus.close()
    mapping.end()
    return 0


class Mapping:
    """The thread that takes photo after photo and hands what follows from it to the uplink."""

    def __init__(
        self, live: LiveMap, source: PhotoSource, config: AirConfig, uplink: Uplink, stop: threading.Event
    ) -> None:
        self._live = live
        self._source = source
        self._config = config
        self._uplink = uplink
        self._stop = stop
        self._arrived_s: deque[float] = deque()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="mapping", daemon=True)

    def start(self) -> None:
        """Begin with the first photo."""
        self._thread.start()

    def end(self) -> None:
        """Wait for the step in work. Raises what ended the thread before it was told to stop."""
        self._thread.join(STOP_S)
        if self._error is not None:
            raise self._error
        if self._thread.is_alive():
            # gtsam cannot be interrupted, and an interpreter that ends below it would crash.
            log.info("stopped in the middle of a step")
            logging.shutdown()
            os._exit(0)

    def _run(self) -> None:
        try:
            self._map()
        except StoppedError:
            pass
        except Exception as error:
            self._error = error
            self._stop.set()

    def _map(self) -> None:
        self._say()
        for photo in prepared(self._arriving(), self._config.alignment):
            begun_s = time.monotonic()
            if isinstance(photo, Jump):
                self._grow(self._live.move(photo), "jump of the world", begun_s, begun_s)
            else:
                self._grow(self._live.align(photo), photo.photo.name, self._arrived_s.popleft(), begun_s)
            self._correct(in_flight=True)
        self._finish()

    def _arriving(self) -> Iterator[Photo | Jump]:
        """The photos, each noted when it arrives, and the jumps between them."""
        for photo in self._source:
            if isinstance(photo, Photo):
                log.info("%s arrived", photo.name)
                self._arrived_s.append(time.monotonic())
            yield photo

    def _grow(self, keyframes: list[Keyframe], name: str, arrived_s: float, begun_s: float) -> None:
        self._check_stop()
        aligned_s = time.monotonic()
        growth = self._live.grow(keyframes)
        mapped_s = time.monotonic()

        def tell() -> None:
            log.info(
                "%s: %d keyframes and %d tiles sent %.2f s after arrival: waited %.2f, aligned %.2f, mapped %.2f s",
                name,
                len(growth.keyframes),
                len(growth.tiles),
                time.monotonic() - arrived_s,
                begun_s - arrived_s,
                aligned_s - begun_s,
                mapped_s - aligned_s,
            )

        self._uplink.send(growth.keyframes, growth.tiles, tell)
        for pose in growth.poses:
            self._uplink.send_pose(pose)
        self._say()

    def _correct(self, in_flight: bool) -> None:
        """Follow surfaces that moved, as long as no photo waits."""
        while not self._arrived_s:
            self._check_stop()
            tiles = self._live.correct(in_flight)
            if not tiles:
                return
            self._uplink.send([], tiles)

    def _finish(self) -> None:
        self._let_uplink_send()
        begun_s = time.monotonic()
        self._grow(self._live.finish(), "final adjustment", begun_s, begun_s)
        self._correct(in_flight=False)
        log.info("the source has ended; staying for those who ask")

    def _let_uplink_send(self) -> None:
        """Wait for the uplink, though not for ever: the final adjustment holds the interpreter's lock."""
        sent = threading.Event()
        self._uplink.send([], [], sent.set)
        sent.wait(SENT_WITHIN_S)

    def _say(self) -> None:
        now = self._live.condition(list(self._source.problems))
        self._uplink.say(now.datum, now.level, now.text[:1000], now.counts)

    def _check_stop(self) -> None:
        if self._stop.is_set():
            raise StoppedError


def _sleep_until(stop: threading.Event) -> Callable[[float], None]:
    def sleep(seconds: float) -> None:
        if stop.wait(seconds):
            raise StoppedError

    return sleep
