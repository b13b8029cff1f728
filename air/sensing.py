"""The node of the devices: what they measure goes onto the local bus, and how each is doing, every second."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Protocol

from air.config import AirConfig
from air.devices.status import DeviceStatus
from air.odometry_process import OdometryProcess
from air.sensors.gnss_rtcm import RtcmReceiver
from air.sources.known import Known
from air.sources.live import Live
from air.sources.played import Played
from air.sources.source import open_source
from common.bus import Bus, ZenohBus
from common.clock import Clock, SystemClock
from common.errors import BusError, WireError
from common.keys import alive_key, message_key, stream_key
from common.measurements import Measurement, RawBytes, ReceiverSolution
from common.messages import Health, Message
from common.streams import HEALTH, RTCM, STREAMS, Stream
from common.wire import decode, encode

log = logging.getLogger(__name__)

ROLE = "sensing"
BEAT_S = 1.0
STREAM_OF: dict[type[Message], Stream] = {stream.message: stream for stream in STREAMS if stream is not RTCM}
"""Where each kind of measurement goes; corrections are no measurement of ours."""


class Devices(Protocol):
    """Devices that are read until they are closed: those on board, simulated or recorded ones."""

    def __iter__(self) -> Iterator[Measurement]: ...

    @property
    def known(self) -> Known:
        """What was calibrated before the flight."""
        ...

    def statuses(self) -> list[DeviceStatus]:
        """How each device is doing now."""
        ...

    def correct(self, data: bytes) -> None:
        """Pass corrections from the ground on to the receiver."""
        ...

    def close(self) -> None:
        """Let go of the devices; the iteration ends."""
        ...


def sense(config: AirConfig, url: str) -> int:
    """Exit code 0 after SIGINT or SIGTERM; until then publishes what devices measure, where that says that the aircraft
    is, and the map of what it sees.

    `live:` alone takes the devices of `config`; a simulated flight, `sim:plain` and the like, is flown at the pace of
    time, and a recording at that of `config`. Raises SourceError, ConfigError and BusError.
    """
    live = _open(config, url)
    stop = threading.Event()

    def end(*_: object) -> None:
        stop.set()
        live.close()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    bus = ZenohBus(config.bus)
    odometry = OdometryProcess(config, live.known, bus.publish)
    sensing = Sensing(live, bus, config.vehicle, SystemClock(), odometry.take)
    try:
        sensing.run()
        odometry.finish()
        stop.wait()
    finally:
        odometry.close()
        live.close()
        bus.close()
    return 0


def _open(config: AirConfig, url: str) -> Devices:
    source = Live(url, config.devices) if url == "live:" else open_source(url)
    if isinstance(source, Live):
        return source
    if url.startswith("sim:"):
        from air.sources.simulated.flown import SimulatedFlight  # brings a compiler along
        from air.sources.simulated.live import LiveFlight

        if isinstance(source, SimulatedFlight):
            return LiveFlight(source)
    return Played(source, config.pace)


class Sensing:
    """Source → bus, until the source is closed."""

    def __init__(
        self, live: Devices, bus: Bus, vehicle: str, clock: Clock, tap: Callable[[Measurement], None] | None = None
    ) -> None:
        """`tap` is given every measurement after it was published."""
        self._live, self._bus, self._vehicle, self._clock, self._tap = live, bus, vehicle, clock, tap
        self._base = RtcmReceiver()
        self._ended = threading.Event()
        self._beat = threading.Thread(target=self._beat_on, name="beat", daemon=True)

    def run(self) -> None:
        """Publish all that comes. Raises BusError."""
        alive = self._bus.declare_alive(alive_key(self._vehicle, ROLE))
        corrections = self._bus.subscribe(stream_key(self._vehicle, RTCM), self._correct)
        self._beat.start()
        try:
            for measurement in self._live:
                self._tell(measurement)
                if isinstance(measurement, ReceiverSolution):
                    self._base.near_ns = measurement.t_ns
        finally:
            self._ended.set()
            corrections.close()
            alive.close()

    def _correct(self, key: str, payload: bytes) -> None:
        """Hand what a base station sends to the receiver on board, and what it measured to the odometry."""
        try:
            data = decode(RawBytes, payload).data
        except WireError as error:
            log.warning("%s: %s", key, error)
            return
        self._live.correct(data)
        for epoch in self._base.feed(data, 0):
            self._tell(epoch)

    def _tell(self, measurement: Measurement) -> None:
        self._publish(STREAM_OF[type(measurement)], measurement)
        if self._tap is not None:
            self._tap(measurement)

    def _beat_on(self) -> None:
        while not self._ended.wait(BEAT_S):
            for status in self._live.statuses():
                self._publish(HEALTH, status.health(self._clock.now_ns()))

    def _publish(self, stream: Stream, message: Measurement | Health) -> None:
        try:
            self._bus.publish(message_key(self._vehicle, stream, message), encode(message), stream)
        except (WireError, BusError) as error:
            if not self._ended.is_set():
                log.warning("not published: %s", error)
