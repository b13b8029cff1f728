"""The drone's own telemetry from a MAVLink link at the ground, told on the bus as if it came from on board."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from common.bus import Bus
from common.clock import Clock
from common.errors import BusError, DeviceError
from common.keys import stream_key
from common.link import Link, open_link
from common.mavlink import Telemetry
from common.streams import VEHICLE
from common.wire import encode
from ground.config import TelemetryConfig

log = logging.getLogger(__name__)

RETRY_S = 1.0


class TelemetryNode:
    """A thread that reads a link and publishes the vehicle's state; a link that breaks is opened again."""

    def __init__(
        self, config: TelemetryConfig, bus: Bus, clock: Clock, open_it: Callable[[str, int], Link] = open_link
    ) -> None:
        self._config, self._bus, self._clock, self._open_it = config, bus, clock, open_it
        self._key = stream_key(config.vehicle, VEHICLE)
        self._fault = ""
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)

    def start(self) -> None:
        """Begin to read, as soon as the link is there."""
        self._thread.start()

    def close(self) -> None:
        """Stop and let go of the link."""
        self._stopped.set()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                link = self._open_it(self._config.url, self._config.baud)
            except DeviceError as error:
                self._note(str(error))
            else:
                try:
                    self._read(link)
                except OSError as error:
                    self._note(f"{self._config.url}: {error.strerror or error}")
                finally:
                    link.close()
            self._stopped.wait(RETRY_S)

    def _read(self, link: Link) -> None:
        telemetry = Telemetry(self._config.system or None)
        while not self._stopped.is_set():
            for state in telemetry.feed(link.read(), self._clock.now_ns()):
                self._note("")
                try:
                    self._bus.publish(self._key, encode(state), VEHICLE)
                except BusError as error:
                    self._note(str(error))

    def _note(self, fault: str) -> None:
        """Log what is wrong, or that nothing is any more, once."""
        if fault != self._fault:
            self._fault = fault
            if fault:
                log.warning("telemetry: %s", fault)
            else:
                log.info("telemetry: %s is read again", self._config.url)
