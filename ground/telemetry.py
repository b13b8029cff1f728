"""The drone's own telemetry from a MAVLink link at the ground, told on the bus as if it came from on board."""

from __future__ import annotations

from collections.abc import Callable

from common.bus import Bus
from common.clock import Clock
from common.keys import stream_key
from common.link import Link, open_link
from common.mavlink import Telemetry
from common.streams import VEHICLE
from common.wire import encode
from ground.config import TelemetryConfig
from ground.link_reader import LinkReader


class TelemetryNode(LinkReader):
    """Publishes the vehicle's state."""

    def __init__(
        self, config: TelemetryConfig, bus: Bus, clock: Clock, open_it: Callable[[str, int], Link] = open_link
    ) -> None:
        super().__init__("telemetry", config.url, config.baud, self._publish, open_it)
        self._bus, self._clock = bus, clock
        self._key = stream_key(config.vehicle, VEHICLE)
        self._telemetry = Telemetry(config.system or None)

    def _publish(self, data: bytes) -> bool:
        states = self._telemetry.feed(data, self._clock.now_ns())
        for state in states:
            self._bus.publish(self._key, encode(state), VEHICLE)
        return bool(states)
