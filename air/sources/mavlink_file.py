"""A telemetry log (tlog) or the bytes of a MAVLink link, opened as `mavlink:FILE`."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from air.sensors.mavlink import MavlinkVehicle
from air.sources.device_file import DeviceFile
from common.errors import SourceError
from common.mavlink import Stamps, is_tlog

_BEGINNING = 4096


def open_mavlink(url: str, path: str) -> DeviceFile:
    """The states of the vehicle in a file: stamped as the log says, or else by the autopilot's time since its start.

    Raises SourceError for a file that is missing or cannot be read.
    """
    try:
        with Path(path).expanduser().open("rb") as file:
            beginning = file.read(_BEGINNING)
    except OSError as error:
        raise SourceError(f"source {url!r}: the file {path!r} cannot be read: {error.strerror}") from error
    stamps = Stamps.TLOG if is_tlog(beginning) else Stamps.BOOT
    return DeviceFile(url, path, partial(MavlinkVehicle, stamps=stamps))
