"""`luojia-air check`: the devices that are there, those that are configured, and how each is doing."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Protocol

from rich.console import Console, Group, RenderableType
from rich.live import Live as LiveDisplay
from rich.table import Column, Table
from rich.text import Text

from air.config import AirConfig
from air.devices.finding import Found, everything
from air.devices.status import DeviceStatus, State
from air.sources.live import Live
from common.bus import Bus, BusConfig, ZenohBus
from common.errors import BusError, WireError
from common.keys import all_of
from common.messages import Health
from common.streams import HEALTH
from common.wire import decode

ASK_S = 2.5
"""A program that flies tells how its devices are doing every second."""
PATIENCE_S = 9.0
"""How long a device has to come up, or to be found at another baud rate, before a verdict for scripts."""
SETTLED_S = 2.5
REFRESH_S = 0.25
_COLOURS = {State.ALIVE: "yellow", State.OPENED: "yellow"}
_UNDECIDED = (State.OPENED, State.SILENT, State.GARBLED)


class Watcher(Protocol):
    """Somebody who knows how the devices are doing."""

    def statuses(self) -> Sequence[DeviceStatus]:
        """How each configured device is doing now."""
        ...

    def close(self) -> None:
        """Stop watching."""
        ...


def check(config: AirConfig, once: bool, as_json: bool, console: Console) -> int:
    """Exit code 1 when a configured device is not well, else 0; a terminal shows them until Ctrl-C unless `once`.

    Where `luojia-air run` holds the devices, it is asked; else they are opened here. Raises ConfigError.
    """
    logging.getLogger("air.devices").addHandler(logging.NullHandler())  # the table says what the log would
    watcher, told_by = _watcher(config)
    try:
        statuses = _verdict(watcher) if once or as_json else _show_live(watcher, told_by, console)
    finally:
        watcher.close()
    if as_json:
        found = [asdict(thing) for thing in everything()]
        told = [asdict(status) | {"well": status.well} for status in statuses]
        console.out(json.dumps({"devices": told, "found": found, "told_by": told_by}, indent=2), highlight=False)
    elif once:
        console.print(_page(statuses, everything(), told_by))
    return 0 if all(status.well for status in statuses) else 1


def _watcher(config: AirConfig) -> tuple[Watcher, str]:
    """Whoever knows, and who that is."""
    if not config.devices.places:
        return Nobody(), "nobody: no device is configured"
    for endpoint in config.bus.listen:
        if asked := _asked(config, endpoint):
            return asked, "luojia-air run, which holds the devices"
    return Opened(config), "this program, which opened the devices"


class Nobody:
    """Watches nothing."""

    def statuses(self) -> Sequence[DeviceStatus]:
        """None."""
        return ()

    def close(self) -> None:
        """Nothing to stop."""


class Opened:
    """Opens the devices and reads them."""

    def __init__(self, config: AirConfig) -> None:
        """Raises ConfigError for a calibration that cannot be read."""
        self._live = Live("live:", config.devices)
        self._thread = threading.Thread(target=self._read, name="check", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        for _ in self._live:
            pass

    def statuses(self) -> Sequence[DeviceStatus]:
        """How each device is doing now."""
        return self._live.statuses()

    def close(self) -> None:
        """Let go of the devices."""
        self._live.close()
        self._thread.join(1.0)


class Asked:
    """Listens to the health of the devices that another program holds."""

    def __init__(self, bus: Bus, vehicle: str, places: dict[str, str]) -> None:
        self._bus, self._places = bus, places
        self._heard: dict[str, tuple[float, DeviceStatus]] = {}
        self._subscription = bus.subscribe(all_of(HEALTH, vehicle), self._hear)

    def _hear(self, _key: str, payload: bytes) -> None:
        try:
            status = DeviceStatus.from_health(decode(Health, payload))
        except WireError:
            return
        if status is not None and status.device in self._places:
            self._heard[status.device] = (time.monotonic(), status)

    def statuses(self) -> Sequence[DeviceStatus]:
        """How each device was doing a second ago at most; closed where nothing was heard of it lately."""
        now_s = time.monotonic()
        recent = {name: status for name, (t_s, status) in self._heard.items() if now_s - t_s < 2 * ASK_S}
        missing = "luojia-air run does not tell of it; was it started with other settings?"
        return [
            recent.get(name, DeviceStatus(name, place, State.CLOSED, fault=missing))
            for name, place in self._places.items()
        ]

    @property
    def heard(self) -> bool:
        """Whether anything was heard."""
        return bool(self._heard)

    def close(self) -> None:
        """Leave the bus."""
        self._subscription.close()
        self._bus.close()


def _asked(config: AirConfig, endpoint: str) -> Asked | None:
    """A running program's word, None where none runs."""
    try:
        bus = ZenohBus(BusConfig("client", connect=(endpoint,), shared_memory=False))
    except BusError:
        return None
    asked = Asked(bus, config.vehicle, config.devices.places)
    until_s = time.monotonic() + ASK_S
    while time.monotonic() < until_s:
        if asked.heard:
            return asked
        time.sleep(REFRESH_S)
    asked.close()
    return None


def _verdict(watcher: Watcher) -> Sequence[DeviceStatus]:
    """The statuses once they can be told: a rate takes a while, and a baud rate longer."""
    begun_s = time.monotonic()
    while True:
        statuses = watcher.statuses()
        waited_s = time.monotonic() - begun_s
        undecided = any(status.state in _UNDECIDED for status in statuses)
        if not statuses or waited_s > (PATIENCE_S if undecided else SETTLED_S):
            return statuses
        time.sleep(REFRESH_S)


def _show_live(watcher: Watcher, told_by: str, console: Console) -> Sequence[DeviceStatus]:
    """The statuses at the moment of Ctrl-C."""
    with LiveDisplay(console=console, refresh_per_second=1 / REFRESH_S) as display:
        try:
            while True:
                display.update(_page(watcher.statuses(), everything(), told_by))
                time.sleep(REFRESH_S)
        except KeyboardInterrupt:
            return watcher.statuses()


def _page(statuses: Sequence[DeviceStatus], found: Sequence[Found], told_by: str) -> RenderableType:
    devices = Table("device", Column("where", overflow="fold"), "state", "rate", "age", "dropped")
    for status in statuses:
        state = Text(status.state, "green" if status.well else _COLOURS.get(status.state, "red"))
        age = "–" if status.age_s is None else f"{status.age_s:.2f} s"
        dropped = f"{status.counts.get('dropped_bytes', 0)} bytes"
        devices.add_row(status.device, status.place, state, f"{status.rate_hz:.1f} Hz", age, dropped)
    faults = [Text(f"{status.device}: {status.fault}", "red") for status in statuses if status.fault]
    there = Table("plugged in", "what it is", "serial number")
    for thing in found:
        there.add_row(thing.path, Text(thing.what), Text(thing.serial))
    return Group(
        Text(f"told by {told_by}"), devices, *faults, there if found else "no serial port and no camera is plugged in"
    )
