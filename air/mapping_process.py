"""The mapper in a process of its own beside the node of the devices: gtsam holds the interpreter for long, and a device
that is not read in time loses bytes."""

from __future__ import annotations

import logging
import multiprocessing
import queue
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from logging.handlers import QueueHandler, QueueListener
from multiprocessing.queues import Queue
from typing import Any

from air.config import AirConfig
from air.sensors.calibration import Calibration
from air.sources.source import Problem, Truth
from air.sources.stills import StillPicker
from common.measurements import Measurement
from common.messages import Photo

log = logging.getLogger(__name__)

WAITING = 20
"""Photos that may wait: in flight one comes every few seconds, so these are a minute."""
STOP_S = 3.0
LOOK_S = 0.2


class MappingProcess:
    """Maps the photos in what devices measure. The process begins with the first photo."""

    def __init__(self, config: AirConfig, cameras: Mapping[str, Calibration]) -> None:
        # It listens nowhere: that is the place of the node of the devices.
        self._config = replace(config, bus=replace(config.bus, listen=()))
        self._picker = StillPicker(cameras)
        context = multiprocessing.get_context("spawn")
        self._photos: Queue[Photo | None] = context.Queue(WAITING)
        self._records: Queue[Any] = context.Queue()
        self._process = context.Process(target=_map, args=(self._config, self._photos, self._records), name="mapping")
        self._listener = QueueListener(self._records, *logging.getLogger().handlers)

    def take(self, measurement: Measurement) -> None:
        """Note a measurement; a frame that makes a photo goes to the mapper, unless too many wait there."""
        if (photo := self._picker.feed(measurement)) is None:
            return
        if self._process.pid is None:
            self._listener.start()
            self._process.start()
        try:
            self._photos.put_nowait(photo)
        except queue.Full:
            log.warning("%s is not mapped: the mapper is behind by %d photos", photo.name, WAITING)

    def finish(self) -> None:
        """No more photos come: the mapper adjusts all of them once more, and stays for those who ask."""
        if self._process.pid is not None:
            self._photos.put(None)

    def close(self) -> None:
        """End the process, if it began."""
        if self._process.pid is None:
            return
        self._process.terminate()
        self._process.join(STOP_S)
        self._process.kill()
        self._listener.stop()


@dataclass(frozen=True)
class Taken:
    """Photos that another process takes, until it sends None. `check_stop` raises when they are not wanted any more."""

    photos: Queue[Photo | None]
    check_stop: Callable[[], None]
    url: str = "live:"
    truth: Truth | None = None
    problems: Sequence[Problem] = ()

    def __iter__(self) -> Iterator[Photo]:
        while True:
            self.check_stop()
            try:
                photo = self.photos.get(timeout=LOOK_S)
            except queue.Empty:
                continue
            if photo is None:
                return
            yield photo


def _map(config: AirConfig, photos: Queue[Photo | None], records: Queue[Any]) -> None:
    """The process: until SIGTERM."""
    root = logging.getLogger()
    root.addHandler(QueueHandler(records))
    root.setLevel(logging.INFO)
    from air.nodes import map_photos

    # Ctrl-C reaches every process of a terminal; the node of the devices tells this one when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    map_photos(config, lambda check_stop: Taken(photos, check_stop))
