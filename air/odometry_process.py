"""The odometry in a process of its own, between the node of the devices and the mapper: its adjustments hold the
interpreter for tens of milliseconds, those of the mapper for seconds, and neither may wait for the other."""

from __future__ import annotations

import logging
import multiprocessing
import queue
import signal
import threading
import time
from collections.abc import Callable
from ctypes import c_ulong
from dataclasses import dataclass, replace
from logging.handlers import QueueHandler, QueueListener
from multiprocessing.connection import Connection
from multiprocessing.queues import Queue
from multiprocessing.synchronize import BoundedSemaphore
from typing import Any

from air.config import AirConfig
from air.flight import flight_now
from air.sources.known import Known
from common.errors import BusError
from common.measurements import CameraFrame, ClockState, ImuSample, Measurement, RawBytes
from common.streams import Stream

log = logging.getLogger(__name__)

FRAMES = 4
"""Frames that may wait; more are dropped, for the newest pose is worth more than every frame."""
WAITING = 20_000
"""Measurements that may wait, which are small: while the process starts, and when the computer is held up."""
STOP_S = 5.0
"""More than the mapper, which this process ends, may take to end."""
LOOK_S = 0.2
AGAIN_S = 5.0
"""After a start, until the next one: what ends at once must not keep the computer busy."""
Publish = Callable[[str, bytes, Stream], None]
"""Of a bus."""
Dropped = c_ulong
"""Counts; only the one that drops writes it."""
Item = tuple[float, Measurement] | None
"""A measurement with the monotonic time s at which it was put; None at the end."""


class OdometryProcess:
    """Follows the aircraft through what its devices measure. The process begins with the first sample or frame.

    What it tells is published by this process: it comes from where its measurements do, to the same listeners.
    Another takes the place of one that has ended by itself, and begins a flight of its own: what the first one knew of
    the world and of the map is gone.
    """

    def __init__(self, config: AirConfig, known: Known, publish: Publish) -> None:
        # The mapper listens nowhere: that is the place of the node of the devices.
        self._config, self._known = replace(config, bus=replace(config.bus, listen=())), known
        self._publish = publish
        self._process = _Process(self._config, self._known, publish)
        self._lock = threading.Lock()

    def take(self, measurement: Measurement) -> None:
        """Hand a measurement on; a frame for which there is no room is dropped and counted. Returns at once."""
        if isinstance(measurement, RawBytes | ClockState):
            return
        with self._lock:  # those of a base station come on the bus's thread
            self._take(measurement)

    def _take(self, measurement: Measurement) -> None:
        if self._process.exitcode is not None:
            if time.monotonic() - self._process.begun_s < AGAIN_S:
                return
            log.error("the odometry has ended with exit code %d: it begins anew", self._process.exitcode)
            self._process.close()
            self._process = _Process(self._config, self._known, self._publish)
        self._process.take(measurement)

    def finish(self) -> None:
        """No more measurements come: the mapper adjusts all photos once more, and stays for those who ask."""
        self._process.finish()

    def close(self) -> None:
        """End the process, if it began."""
        self._process.close()


class _Process:
    """One process, with queues of its own: a process that is killed may leave locks of its queues behind."""

    def __init__(self, config: AirConfig, known: Known, publish: Publish) -> None:
        context = multiprocessing.get_context("spawn")
        self._measurements: Queue[Item] = context.Queue(WAITING)
        self._room: BoundedSemaphore = context.BoundedSemaphore(FRAMES)
        self.dropped: Dropped = context.RawValue("L", 0)
        records: Queue[Any] = context.Queue()
        told, self._outlet = context.Pipe(duplex=False)
        self._teller = threading.Thread(target=_pass_on, args=(told, publish), name="told", daemon=True)
        shared = (self._measurements, self._room, self.dropped, self._outlet, records)
        self._process = context.Process(target=_navigate, args=(config, known, flight_now(), *shared), name="odometry")
        self._listener = QueueListener(records, *logging.getLogger().handlers)
        self.begun_s = 0.0

    @property
    def exitcode(self) -> int | None:
        """None until it has begun and ended."""
        return self._process.exitcode

    def take(self, measurement: Measurement) -> None:
        if isinstance(measurement, CameraFrame) and not self._room.acquire(block=False):
            self.dropped.value += 1
            return
        try:
            self._measurements.put_nowait((time.monotonic(), measurement))
        except queue.Full:
            self.dropped.value += 1
            if isinstance(measurement, CameraFrame):
                self._room.release()
        if self._process.pid is None and isinstance(measurement, CameraFrame | ImuSample):
            self.begun_s = time.monotonic()
            self._listener.start()
            self._process.start()
            self._outlet.close()  # so that what it tells ends with the process
            self._teller.start()

    def finish(self) -> None:
        if self._process.pid is not None:
            self._measurements.put(None)

    def close(self) -> None:
        # What was put and not taken must not hold up the end of this program.
        self._measurements.cancel_join_thread()
        if self._process.pid is None:
            return
        self._process.terminate()
        self._process.join(STOP_S)
        self._process.kill()
        if self._process.exitcode == 0:  # one that was killed may have left its queue locked, for ever
            self._listener.stop()


def _pass_on(told: Connection, publish: Publish) -> None:
    """Publish what a process tells, until it is gone."""
    while True:
        try:
            key, payload, stream = told.recv()
        except (EOFError, OSError):
            return
        try:
            publish(key, payload, stream)
        except BusError as error:
            log.warning("not published: %s", error)


@dataclass(frozen=True)
class _Outlet:
    """What the odometry tells goes to the process that it serves."""

    connection: Connection

    def publish(self, key: str, payload: bytes, stream: Stream) -> None:
        try:
            self.connection.send((key, payload, stream))
        except OSError as error:
            raise BusError(f"{key!r}: the node of the devices is gone") from error


def _navigate(
    config: AirConfig,
    known: Known,
    flight: str,
    measurements: Queue[Item],
    room: BoundedSemaphore,
    dropped: Dropped,
    outlet: Connection,
    records: Queue[Any],
) -> None:
    """The process: until SIGTERM, or until the one that it serves is gone."""
    root = logging.getLogger()
    root.addHandler(QueueHandler(records))
    root.setLevel(logging.INFO)
    stop, parent = threading.Event(), multiprocessing.parent_process()
    # Ctrl-C reaches every process of a terminal; the node of the devices tells this one when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    from air.mapping_process import MappingProcess
    from air.odometry_node import OdometryNode

    mapping = MappingProcess(config, flight)
    node = OdometryNode(config, known, flight, _Outlet(outlet), mapping.take)
    try:
        while not stop.is_set() and (parent is None or parent.is_alive()):
            node.beat(dropped.value)
            try:
                item = measurements.get(timeout=LOOK_S)
            except queue.Empty:
                continue
            if item is None:
                mapping.finish()
                continue
            put_s, measurement = item
            node.take(measurement)
            if isinstance(measurement, CameraFrame):
                room.release()
                node.note_delay(time.monotonic() - put_s)
    finally:
        mapping.close()
