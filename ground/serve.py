"""The ground service as a whole: bus, gateway, store and viewer, from its settings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from common.bus import ZenohBus
from common.clock import SystemClock
from ground.config import GroundConfig
from ground.corrections import CorrectionsNode
from ground.gateway import Gateway
from ground.station import Station
from ground.store import Store
from ground.telemetry import TelemetryNode
from ground.viewer.viewer import Viewer


@contextmanager
def running(config: GroundConfig) -> Iterator[Viewer | None]:
    """The service while the context lasts, with its viewer if one is wanted.

    Raises BusError or ConfigError, which name the address, when it cannot listen.
    """
    with ExitStack() as stack:
        bus = ZenohBus(config.bus.of_station)
        stack.callback(bus.close)
        station = Station(config.station, config.min_views)
        gateway = Gateway(bus, station, Store(config.store.path), SystemClock().now_ns)
        viewer = None
        if config.viewer.enabled:
            viewer = Viewer(config.viewer, config.station, config.min_views, gateway.scene)
            stack.callback(viewer.close)
        stack.callback(gateway.close)
        gateway.start()
        if config.telemetry.url:
            telemetry = TelemetryNode(config.telemetry, bus, SystemClock())
            stack.callback(telemetry.close)
            telemetry.start()
        if config.corrections.url:
            corrections = CorrectionsNode(config.corrections, bus, SystemClock())
            stack.callback(corrections.close)
            corrections.start()
        yield viewer
