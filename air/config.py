"""Settings of the aircraft, with defaults that work on one machine."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated

from air.alignment.settings import AlignmentSettings
from air.mapping.settings import MappingSettings
from common.bus import BusConfig
from common.config import Range
from common.errors import ConfigError


@dataclass(frozen=True)
class UplinkConfig:
    """How much of the video link the map may take, bytes/s: 80 % of what was measured on it."""

    bytes_per_s: Annotated[float, Range(1_000, 1e9)] = 5_000_000.0


@dataclass(frozen=True)
class AirConfig:
    """One aircraft: its name on the bus, where its photos come from and at which pace they are read.

    `pace` 1 reads a recorded source at the pace of its time stamps, 2 twice as fast.
    """

    vehicle: str = "uav1"
    source: str = "sim:survey?seed=1&photos=60"
    pace: Annotated[float, Range(0.01, 1000.0)] = 1.0
    bus: BusConfig = field(default_factory=lambda: BusConfig("peer", connect=("tcp/127.0.0.1:7447",)))
    uplink: UplinkConfig = field(default_factory=UplinkConfig)
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)
    mapping: MappingSettings = field(default_factory=MappingSettings)

    def __post_init__(self) -> None:
        """Raises ConfigError for a name that makes no key."""
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,32}", self.vehicle):
            raise ConfigError(f"vehicle is {self.vehicle!r}; allowed: 1 to 32 letters, digits, - and _")
