"""The recorder: everything on the bus into a file, as a process of its own, until somebody stops it."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO

import cv2

from air.config import AirConfig, CameraFormat, RecorderConfig
from air.sensors.h264 import H264Encoder, image_of
from common.bus import Bus, BusConfig, ZenohBus
from common.clock import SystemClock
from common.errors import SourceError, WireError
from common.keys import PREFIX, alive_key, parse_key, stream_key
from common.measurements import CameraFrame, Encoding
from common.messages import Health, Level
from common.recording.writer import RecordingWriter
from common.streams import HEALTH, RAW_CAMERA
from common.wire import decode, encode

log = logging.getLogger(__name__)

ROLE = "recorder"
FLUSH_NS = 500_000_000
HEALTH_NS = 1_000_000_000
WAIT_S = 0.1
MB = 1_000_000


@dataclass(frozen=True)
class Arrival:
    """A message as it came from the bus at `t_ns` (GPST)."""

    t_ns: int
    key: str
    payload: bytes


def record(config: AirConfig, out: Path) -> int:
    """Exit code 0 after SIGINT or SIGTERM; until then records the vehicle's streams. Raises SourceError, BusError."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    clock, settings = SystemClock(), config.recorder
    recorder = Recorder(out, config.vehicle, settings, clock.now_ns)
    inflow = Inflow(settings.queue_mb * MB, clock.now_ns)
    bus = ZenohBus(BusConfig("peer", connect=settings.connect))
    try:
        token = bus.declare_alive(alive_key(config.vehicle, ROLE))
        subscription = bus.subscribe(f"{PREFIX}/{config.vehicle}/**", inflow.put)
        log.info("recording %s into %s", config.vehicle, recorder.path)
        _record_until(stop, recorder, inflow, bus, config.vehicle)
        for part in (subscription, token):
            part.close()
        recorder.write(inflow.take(0.0))
    finally:
        recorder.close()
        bus.close()
    log.info("recorded %s", recorder.health(inflow.dropped).text)
    return 0


def _record_until(stop: threading.Event, recorder: Recorder, inflow: Inflow, bus: Bus, vehicle: str) -> None:
    told_ns = 0
    while not stop.is_set():
        recorder.write(inflow.take(WAIT_S))
        health = recorder.health(inflow.dropped)
        if health.t_ns - told_ns >= HEALTH_NS:
            bus.publish(stream_key(vehicle, HEALTH, ROLE), encode(health), HEALTH)
            told_ns = health.t_ns


class Inflow:
    """Messages on their way to the file: so many bytes may wait; what comes beyond them is dropped and counted."""

    def __init__(self, max_bytes: int, now_ns: Callable[[], int]) -> None:
        self.dropped = 0
        self._max_bytes, self._now_ns = max_bytes, now_ns
        self._waiting: deque[Arrival] = deque()
        self._bytes = 0
        self._last_ns = 0
        self._changed = threading.Condition()

    def put(self, key: str, payload: bytes) -> None:
        """Take a message from the bus; its time never runs back, though the clock may be set."""
        with self._changed:
            if self._bytes + len(payload) > self._max_bytes:
                self.dropped += 1
                return
            self._last_ns = max(self._last_ns, self._now_ns())
            self._waiting.append(Arrival(self._last_ns, key, payload))
            self._bytes += len(payload)
            self._changed.notify()

    def take(self, wait_s: float) -> list[Arrival]:
        """All that wait; after so many seconds none."""
        with self._changed:
            if not self._waiting:
                self._changed.wait(wait_s)
            taken, self._bytes = list(self._waiting), 0
            self._waiting.clear()
        return taken


class Recorder:
    """One file that takes messages until it is closed, or the disk has no room: then it is closed by itself.

    `free_bytes` tells the room on the disk of a folder. Raises SourceError when the file cannot be created.
    """

    def __init__(
        self,
        folder: Path,
        vehicle: str,
        config: RecorderConfig,
        now_ns: Callable[[], int],
        free_bytes: Callable[[Path], int] = lambda folder: shutil.disk_usage(folder).free,
    ) -> None:
        self._folder, self._config, self._now_ns, self._free_bytes = folder, config, now_ns, free_bytes
        self._packer = CameraPacker(config)
        self._fault = ""
        self._closed = False
        self._messages, self._strangers = 0, 0
        self._begun_ns = self._flushed_ns = self._looked_ns = now_ns()
        self._flushed_bytes = 0
        start = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        self.path, self._file = _create(folder, f"{vehicle}_{start}")
        try:
            self._free = free_bytes(folder)
            self._writer = RecordingWriter(self._file, _about(vehicle, start, self._begun_ns), config.readable)
            self._flush(self._begun_ns)
        except OSError as error:
            raise SourceError(f"{self.path}: cannot be written: {error.strerror}") from error

    def write(self, arrivals: Iterable[Arrival]) -> None:
        """Append messages; whatever the disk does, nothing is raised."""
        for arrival in arrivals:
            if self._closed:
                return
            try:
                self._append(arrival)
            except WireError as error:
                self._strangers += 1
                log.debug("not recorded: %s", error)
            except OSError as error:
                self._give_up(f"the disk refuses: {error.strerror}")
        self._tend()

    def health(self, dropped: int) -> Health:
        """How the recording goes, with the number of messages that were dropped before they came to the file."""
        seconds = max((self._now_ns() - self._begun_ns) * 1e-9, 1e-3)
        rate = self._flushed_bytes / seconds
        text = f"{self._messages} messages, {self._flushed_bytes / MB:.1f} MB in {self.path}"
        level = Level.DEGRADED if dropped else Level.OK
        if dropped:
            text += f"; {dropped} messages dropped: the disk or the processor is too slow"
        if self._free < self._config.warn_free_mb * MB:
            room = max(self._free - self._config.min_free_mb * MB, 0)
            text += f"; {self._free / MB:.0f} MB free, enough for {room / max(rate, 1.0) / 60:.0f} min"
            level = Level.DEGRADED
        if self._fault:
            level, text = Level.FAILED, f"stopped: {self._fault}; {text}"
        counts = {
            "messages": self._messages,
            "dropped": dropped,
            "strangers": self._strangers,
            "written_bytes": self._flushed_bytes,
            "free_bytes": self._free,
        }
        return Health(self._now_ns(), ROLE, level, text[:1000], counts)

    def close(self) -> None:
        """Write the index and close the file; one that was closed stays as it is."""
        if self._closed:
            return
        self._closed = True
        try:
            self._writer.close()
            self._file.close()
            self._flushed_bytes = self.path.stat().st_size
        except OSError as error:
            self._cut(f"the disk refuses: {error.strerror}")

    def _append(self, arrival: Arrival) -> None:
        stream = parse_key(arrival.key).stream
        if stream.name in self._config.leave_out:
            return
        payload = self._packer.pack(arrival.payload) if stream is RAW_CAMERA else arrival.payload
        self._writer.add(arrival.key, payload, arrival.t_ns)
        self._messages += 1

    def _tend(self) -> None:
        """Flush, and look at the disk, when it is time."""
        now_ns = self._now_ns()
        if self._closed or abs(now_ns - self._flushed_ns) < FLUSH_NS:
            return
        try:
            self._flush(now_ns)
            self._free = self._free_bytes(self._folder)
        except OSError as error:
            self._give_up(f"the disk refuses: {error.strerror}")
            return
        if self._free < self._config.min_free_mb * MB:
            self._fault = f"only {self._free / MB:.0f} MB are free; delete old recordings in {self._folder}"
            log.error("recording %s", self._fault)
            self.close()

    def _flush(self, now_ns: int) -> None:
        self._writer.flush()
        self._file.flush()
        os.fdatasync(self._file.fileno())  # the battery may be pulled
        self._flushed_ns, self._flushed_bytes = now_ns, self._file.tell()

    def _give_up(self, fault: str) -> None:
        self._closed = True
        self._cut(fault)

    def _cut(self, fault: str) -> None:
        """Leave the file as it was after the last flush: without an index, but readable."""
        self._fault = fault
        log.error("recording stopped: %s", fault)
        with suppress(OSError):  # what was not flushed is lost
            self._file.close()
        with suppress(OSError):  # the disk may be gone altogether
            os.truncate(self.path, self._flushed_bytes)


class CameraPacker:
    """Compresses the raw frames of cameras as the settings say; what is compressed already stays as it is."""

    def __init__(self, config: RecorderConfig) -> None:
        self._config = config
        self._encoders: dict[str, H264Encoder] = {}

    def pack(self, payload: bytes) -> bytes:
        """The payload of a camera frame, compressed. Raises WireError for bytes that are no frame."""
        if self._config.camera is CameraFormat.AS_IS:
            return payload
        frame = decode(CameraFrame, payload)
        if frame.encoding not in (Encoding.MONO8, Encoding.BGR8):
            return payload
        even = frame.width % 2 == 0 and frame.height % 2 == 0
        if self._config.camera is CameraFormat.H264 and even:
            encoder = self._encoders.setdefault(frame.camera, H264Encoder(self._config.h264_crf))
            return encode(encoder.encode(frame))
        return encode(_jpeg(frame, self._config.jpeg_quality))


def _jpeg(frame: CameraFrame, quality: int) -> CameraFrame:
    _, data = cv2.imencode(".jpg", image_of(frame), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return replace(frame, encoding=Encoding.JPEG, data=data.tobytes())


def _about(vehicle: str, start: str, begun_ns: int) -> dict[str, str]:
    about = {"vehicle": vehicle, "software": f"luojia {version('luojia')}", "start": start}
    return about | {"start_t_ns": str(begun_ns), "time": "GPST: ns since 1970-01-01 without leap seconds"}


def _create(folder: Path, name: str) -> tuple[Path, BinaryIO]:
    """A new file in a folder, created when it is missing; an older recording is never overwritten."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for ending in ("", *(f"-{i}" for i in range(2, 100))):
            path = folder / f"{name}{ending}.mcap"
            if not path.exists():
                return path, path.open("xb")
    except OSError as error:
        raise SourceError(f"{folder}: no recording can be created: {error.strerror}") from error
    raise SourceError(f"{folder}: no recording can be created: {name} exists a hundred times")
