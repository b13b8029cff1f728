"""Settings of the aircraft, with defaults that work on one machine."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from air.alignment.settings import AlignmentSettings
from air.devices.settings import DevicesConfig
from air.mapping.settings import MappingSettings
from air.odometry.settings import OdometrySettings
from common.bus import BusConfig
from common.config import Range
from common.errors import ConfigError
from common.streams import STREAMS


@dataclass(frozen=True)
class UplinkConfig:
    """How much of the video link the map may take, bytes/s: 80 % of what was measured on it."""

    bytes_per_s: Annotated[float, Range(1_000, 1e9)] = 5_000_000.0


class CameraFormat(StrEnum):
    """How the recorder stores camera frames that come as raw pixels."""

    AS_IS = "as-is"
    JPEG = "jpeg"
    H264 = "h264"


@dataclass(frozen=True)
class RecorderConfig:
    """What is recorded and how; the recorder is a process of its own that connects to the aircraft's bus."""

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7448",)
    leave_out: tuple[str, ...] = ()
    camera: CameraFormat = CameraFormat.JPEG
    jpeg_quality: Annotated[int, Range(1, 100)] = 90
    h264_crf: Annotated[int, Range(0, 51)] = 20
    readable: bool = True
    queue_mb: Annotated[int, Range(10, 100_000)] = 256
    warn_free_mb: Annotated[int, Range(0, 1e9)] = 5_000
    min_free_mb: Annotated[int, Range(0, 1e9)] = 1_000

    def __post_init__(self) -> None:
        """Raises ConfigError for a stream that is not in the table."""
        names = [stream.name for stream in STREAMS]
        for name in self.leave_out:
            if name not in names:
                raise ConfigError(f"leave_out names {name!r}; allowed: {', '.join(names)}")


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
    devices: DevicesConfig = field(default_factory=DevicesConfig)
    recorder: RecorderConfig = field(default_factory=RecorderConfig)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    alignment: AlignmentSettings = field(default_factory=AlignmentSettings)
    mapping: MappingSettings = field(default_factory=MappingSettings)

    def __post_init__(self) -> None:
        """Raises ConfigError for a name that makes no key, and for a lever arm that is none."""
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,32}", self.vehicle):
            raise ConfigError(f"vehicle is {self.vehicle!r}; allowed: 1 to 32 letters, digits, - and _")
        if len(lever_arm := self.odometry.gnss.p_body_antenna) != 3:
            raise ConfigError(f"odometry.gnss.p_body_antenna is {list(lever_arm)}; allowed: three numbers, m")
