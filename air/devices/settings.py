"""Where the devices are and how they are spoken to."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from air.sensors.camera import StampPoint
from common.config import Range
from common.errors import ConfigError

BAUD = Range(300, 4_000_000)
_LINK = re.compile(r"/.+|(udp|tcp):[^:\s]*:\d{1,5}")
_CAMERA = re.compile(r"/.+|realsense(:\w+)?")


@dataclass(frozen=True)
class PortConfig:
    """A device behind a serial port, a TCP or UDP address, or nothing; `baud` counts for serial ports alone.

    `delay_s` is the least time from sampling (of an IMU, the middle of a sample) to arrival; for a receiver on a serial
    line, to its epoch's first byte.
    """

    port: str = ""
    baud: Annotated[int, BAUD] = 115_200
    delay_s: Annotated[float, Range(0.0, 1.0)] = 0.0
    table: ClassVar[str] = "devices"

    def __post_init__(self) -> None:
        """Raises ConfigError for a port that is no path and no address."""
        _check(f"{self.table}.port", self.port, _LINK, "a path, tcp:HOST:PORT, udp:HOST:PORT, or nothing")


@dataclass(frozen=True)
class GnssConfig(PortConfig):
    """The GNSS receiver (u-blox, UBX); `connector` is which of its own ports is used."""

    baud: Annotated[int, BAUD] = 460_800
    connector: Literal["usb", "uart1", "uart2"] = "usb"
    table: ClassVar[str] = "devices.gnss"


@dataclass(frozen=True)
class ImuConfig(PortConfig):
    """The IMU (Xsens, XBus)."""

    baud: Annotated[int, BAUD] = 921_600
    table: ClassVar[str] = "devices.imu"


@dataclass(frozen=True)
class MavlinkConfig(PortConfig):
    """The drone's telemetry (MAVLink)."""

    baud: Annotated[int, BAUD] = 57_600
    table: ClassVar[str] = "devices.mavlink"


@dataclass(frozen=True)
class CameraConfig:
    """The camera: /dev/videoN for any V4L2 camera, realsense or realsense:SERIAL, or nothing.

    `stamp` is what the stamps of a V4L2 camera mark. `calibration` names a file that `read_calibration` reads, or
    nothing; its line time and its time offset count for the stamps.
    """

    device: str = ""
    width: Annotated[int, Range(16, 16_384)] = 1280
    height: Annotated[int, Range(16, 16_384)] = 720
    rate_hz: Annotated[float, Range(0.1, 1000.0)] = 30.0
    stamp: StampPoint = StampPoint.READOUT
    calibration: str = ""

    def __post_init__(self) -> None:
        """Raises ConfigError for a device that is neither."""
        _check("devices.camera.device", self.device, _CAMERA, "/dev/videoN, realsense, realsense:SERIAL, or nothing")


@dataclass(frozen=True)
class DevicesConfig:
    """The devices on board; one without a port is not there."""

    gnss: GnssConfig = field(default_factory=GnssConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    mavlink: MavlinkConfig = field(default_factory=MavlinkConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)

    @property
    def places(self) -> dict[str, str]:
        """Where each device is that is there, by its name: gnss, imu, mavlink, camera."""
        all_places = {
            "gnss": self.gnss.port,
            "imu": self.imu.port,
            "mavlink": self.mavlink.port,
            "camera": self.camera.device,
        }
        return {name: place for name, place in all_places.items() if place}


def _check(key: str, value: str, pattern: re.Pattern[str], allowed: str) -> None:
    if value and not pattern.fullmatch(value):
        raise ConfigError(f"{key} is {value!r}; allowed: {allowed}")
