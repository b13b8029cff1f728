"""The mapper in a process of its own beside the odometry: its adjustments hold the interpreter for seconds."""

from __future__ import annotations

import logging
import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from logging.handlers import QueueHandler, QueueListener
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from multiprocessing.queues import Queue
from typing import Any

from air.config import AirConfig
from air.jump import Jump
from air.sources.source import Problem, Truth
from common.messages import Datum, Photo

log = logging.getLogger(__name__)

WAITING = 20
"""Photos that may wait: in flight one comes every few seconds, so these are a minute."""
STOP_S = 3.0
LOOK_S = 0.2


class MappingProcess:
    """Maps the photos of a flight. The process begins with the first one."""

    def __init__(self, config: AirConfig, flight: str) -> None:
        self._config, self._flight = config, flight
        self._context = multiprocessing.get_context("spawn")
        self._photos: Queue[Photo | Jump | None] = self._context.Queue()
        self._records: Queue[Any] = self._context.Queue()
        self._process: SpawnProcess | None = None
        self._listener = QueueListener(self._records, *logging.getLogger().handlers)

    def take(self, photo: Photo | Jump, datum: Datum) -> None:
        """Hand a photo to the mapper, unless too many wait there, or a jump. The datum that came first stays."""
        if isinstance(photo, Jump):
            if self._process is not None:
                self._photos.put(photo)
            return
        if self._process is None:
            given = (self._config, self._flight, datum, self._photos, self._records)
            self._process = self._context.Process(target=_map, args=given, name="mapping")
            self._listener.start()
            self._process.start()
        if self._photos.qsize() >= WAITING:
            log.warning("%s is not mapped: the mapper is behind by %d photos", photo.name, WAITING)
        else:
            self._photos.put(photo)

    def finish(self) -> None:
        """No more photos come: the mapper adjusts all of them once more, and stays for those who ask."""
        if self._process is not None:
            self._photos.put(None)

    def close(self) -> None:
        """End the process, if it began."""
        self._photos.cancel_join_thread()
        if self._process is None:
            return
        self._process.terminate()
        self._process.join(STOP_S)
        self._process.kill()
        if self._process.exitcode == 0:  # one that was killed may have left its queue locked, for ever
            self._listener.stop()


@dataclass(frozen=True)
class Taken:
    """Photos that another process takes, until it sends None. `check_stop` raises when they are not wanted any more."""

    photos: Queue[Photo | Jump | None]
    check_stop: Callable[[], None]
    url: str = "live:"
    truth: Truth | None = None
    problems: Sequence[Problem] = ()

    def __iter__(self) -> Iterator[Photo | Jump]:
        while True:
            self.check_stop()
            try:
                photo = self.photos.get(timeout=LOOK_S)
            except queue.Empty:
                continue
            if photo is None:
                return
            yield photo


def _map(config: AirConfig, flight: str, datum: Datum, photos: Queue[Photo | Jump | None], records: Queue[Any]) -> None:
    """The process: until SIGTERM, or until the odometry is gone."""
    root = logging.getLogger()
    root.addHandler(QueueHandler(records))
    root.setLevel(logging.INFO)
    from air.nodes import map_photos

    # Ctrl-C reaches every process of a terminal; the odometry tells this one when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    map_photos(config, flight, datum, lambda check_stop: Taken(photos, check_stop))


def _end_with_parent() -> None:
    """Stop this process when the one that feeds it is gone, however that ended."""
    if (parent := multiprocessing.parent_process()) is not None:
        wait([parent.sentinel])
        log.error("the odometry is gone, and the mapper ends with it")
        os.kill(os.getpid(), signal.SIGTERM)
