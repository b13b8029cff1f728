"""Settings of the ground service, with defaults that work on one machine."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from common.bus import BusConfig
from common.config import Range
from common.errors import ConfigError
from common.export.surface import MIN_VIEWS

_NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")


@dataclass(frozen=True)
class StationBus:
    """How the station joins: as the router that listens for everyone, or as a client of another station.

    `listen` counts for a router, `connect` for both: endpoints read like `tcp/192.168.1.10:7447`.
    """

    mode: Literal["router", "client"] = "router"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[str, ...] = ()
    shared_memory: bool = True

    @property
    def of_station(self) -> BusConfig:
        """Settings of the station's own session."""
        listen = self.listen if self.mode == "router" else ()
        return BusConfig(self.mode, self.connect, listen, self.shared_memory)

    @property
    def of_guest(self) -> BusConfig:
        """Settings of another program on the station's machine."""
        if self.mode == "client":
            return self.of_station
        local = (re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", endpoint) for endpoint in self.listen)
        return BusConfig("client", tuple(local), (), self.shared_memory)


@dataclass(frozen=True)
class StoreConfig:
    """Where the map is kept: a file, created with its folder."""

    path: Path = Path("luojia-data/ground.sqlite")


@dataclass(frozen=True)
class ViewerConfig:
    """Where browsers find the viewer, and how many points each of them draws at most."""

    enabled: bool = True
    host: str = "127.0.0.1"
    port: Annotated[int, Range(1, 65535)] = 8080
    point_budget: Annotated[int, Range(1_000, 20_000_000)] = 400_000


@dataclass(frozen=True)
class TelemetryConfig:
    """The drone's own telemetry (MAVLink) at the ground; off without a `url`.

    `url` is a path, tcp:HOST:PORT or udp:HOST:PORT (listens there); `baud` counts for serial ports alone. `vehicle`
    is the aircraft's name on the bus, `system` its MAVLink system id (0: the first that is heard).
    """

    url: str = ""
    baud: Annotated[int, Range(300, 4_000_000)] = 57_600
    vehicle: str = "uav1"
    system: Annotated[int, Range(0, 255)] = 0

    def __post_init__(self) -> None:
        _check_link("telemetry", self.url, self.vehicle)


@dataclass(frozen=True)
class CorrectionsConfig:
    """A base station's receiver at the ground, which sends RTCM 3 (1005 or 1006, MSM4 to MSM7); off without a `url`.

    `url` and `baud` are as for the telemetry, `vehicle` is the aircraft's name on the bus. `position` is latitude and
    longitude, degrees, and height above the WGS84 ellipsoid, m, of the antenna where that was surveyed; empty: as the
    receiver says.
    """

    url: str = ""
    baud: Annotated[int, Range(300, 4_000_000)] = 115_200
    vehicle: str = "uav1"
    position: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        _check_link("corrections", self.url, self.vehicle)
        told = self.position
        if told and not (len(told) == 3 and abs(told[0]) <= 90 and abs(told[1]) <= 360 and abs(told[2]) <= 10_000):
            allowed = "latitude, longitude (degrees) and height (m above the ellipsoid), or nothing"
            raise ConfigError(f"corrections.position is {list(told)}; allowed: {allowed}")


def _check_link(section: str, url: str, vehicle: str) -> None:
    if url and not re.fullmatch(r"/.+|(udp|tcp):[^:\s]*:\d{1,5}", url):
        raise ConfigError(f"{section}.url is {url!r}; allowed: a path, tcp:HOST:PORT, udp:HOST:PORT, or nothing")
    if not _NAME.fullmatch(vehicle):
        raise ConfigError(f"{section}.vehicle is {vehicle!r}; allowed: 1 to 32 letters, digits, - and _")


@dataclass(frozen=True)
class GroundConfig:
    """One ground station; `station` is its name on the bus, `min_views` how many photos must agree on a cell."""

    station: str = "ground"
    min_views: Annotated[int, Range(1, 255)] = MIN_VIEWS
    bus: StationBus = field(default_factory=StationBus)
    store: StoreConfig = field(default_factory=StoreConfig)
    viewer: ViewerConfig = field(default_factory=ViewerConfig)
    telemetry: TelemetryConfig = field(default_factory=TelemetryConfig)
    corrections: CorrectionsConfig = field(default_factory=CorrectionsConfig)

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.station):
            raise ConfigError(f"station is {self.station!r}; allowed: 1 to 32 letters, digits, - and _")
        if self.bus.mode == "client" and not self.bus.connect:
            raise ConfigError("bus.connect is empty; a client needs the endpoint of a station, tcp/HOST:7447")
