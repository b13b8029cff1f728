"""A ROS 1 or ROS 2 bag, opened as `bag:PATH` or `bag:PATH?map=FILE.toml`.

Without a map every topic of a known type is read: images, one IMU, positions, and the messages of gnss_comm. A map
names the topics to read:

    stamp_offset_s = 18.0            # GPST minus the clock of the stamps; without it they are taken as UTC

    [[topics]]
    name = "/cam0/image_raw"
    device = "cam0"                  # without it, made from the topic's name
    calibration = "cam0.yaml"        # beside the map
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PosixPath
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from air.sensors.calibration import read_calibration
from air.sources import gnss_comm, ros
from air.sources.imported import Faults, Imported, gpst_of_unix, one_line, reordered, split_options
from air.sources.source import Sensed
from common.config import load
from common.errors import SourceError
from common.measurements import CameraFrame, Measurement

CONVERTERS = {**ros.CONVERTERS, **gnss_comm.CONVERTERS}
UNIMPORTANT = ("image", "raw", "color", "compressed", "data", "fix")
"""Parts of a topic's name that do not tell one device from another."""

_LARGE = 1 << 20


@dataclass(frozen=True)
class Topic:
    """A topic to read, the name of its device, and the calibration file of a camera."""

    name: str
    device: str = ""
    calibration: Path | None = None


@dataclass(frozen=True)
class BagMap:
    """What to read from a bag; without topics, everything that is known."""

    topics: tuple[Topic, ...] = ()
    stamp_offset_s: float | None = None


def open_bag(url: str, rest: str) -> Imported:
    """Frames, IMU samples, positions and raw GNSS measurements with ephemerides, by time.

    The IMU's frame is that of the bag. The time pulse of gnss_comm tells nothing that is needed here. Raises
    SourceError for a path that is no bag that can be read, and ConfigError for a wrong map.
    """
    path, options = split_options(url, rest, ("map",))
    if not path.exists():
        raise SourceError(f"source {url!r}: {str(path)!r} does not exist")
    map_path = Path(options["map"]).expanduser() if "map" in options else None
    bag_map = load(map_path, BagMap)
    try:
        with _reader(path) as reader:
            topics, unread = _topics(reader, bag_map, url)
    except SourceError:
        raise
    except Exception as error:  # rosbags, its YAML and its SQLite raise nearly everything on damaged files.
        raise SourceError(
            f"source {url!r}: no bag that can be read, maybe one to be reindexed: {one_line(error)}"
        ) from error
    folder = map_path.parent if map_path else Path()
    calibrations = {
        topic.device: read_calibration(folder / topic.calibration) for topic in topics.values() if topic.calibration
    }

    def read(faults: Faults) -> Iterator[Sensed]:
        for name in unread:
            faults.add(name, "is another IMU and left out; a map can choose it")
        return reordered(_messages(path, topics, bag_map.stamp_offset_s, faults))

    return Imported(url, read, calibrations)


class _BoundedFile(io.BufferedReader):
    """A file that takes no memory for more bytes than it has, whatever length a damaged bag claims."""

    def read(self, size: int | None = -1) -> bytes:
        if size is not None and size > _LARGE:
            size = min(size, max(os.fstat(self.fileno()).st_size - self.tell(), 0))
        return super().read(size)


class _BoundedPath(PosixPath):
    """A path whose files are read in this way."""

    def open(self, *_: Any, **__: Any) -> io.BufferedReader:  # type: ignore[override]
        return _BoundedFile(io.FileIO(self))


def _reader(path: Path) -> AnyReader:
    # A folder (ROS 2) is read by SQLite or MCAP, and its YAML as text.
    return AnyReader([path if path.is_dir() else _BoundedPath(path)], default_typestore=typestore())


def typestore() -> Typestore:
    """The messages of ROS 2 and of gnss_comm, for bags that carry no definitions."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in gnss_comm.DEFINITIONS.items():
        store.register(get_types_from_msg(text, f"gnss_comm/msg/{name}"))
    return store


def _topics(reader: AnyReader, bag_map: BagMap, url: str) -> tuple[dict[str, Topic], list[str]]:
    """The topics to read by name, and the IMUs that are not: samples do not say which IMU they are from."""
    known = {c.topic: _kind(c.msgtype) for c in reader.connections if _kind(c.msgtype) in CONVERTERS}
    for topic in bag_map.topics:
        if topic.name not in known:
            there = ", ".join(sorted(known)) or "none"
            raise SourceError(f"source {url!r}: no topic {topic.name!r} that can be read; there are {there}")
    other_imus = [] if bag_map.topics else sorted(name for name, kind in known.items() if kind == "Imu")[1:]
    wanted = bag_map.topics or tuple(Topic(name) for name in known if name not in other_imus)
    if not wanted:
        raise SourceError(f"source {url!r}: holds no message of {', '.join(CONVERTERS)}")
    named = {topic.name: replace(topic, device=topic.device or device_name(topic.name)) for topic in wanted}
    return named, other_imus


def device_name(topic: str) -> str:
    """A short name for the device behind a topic: /cam0/image_raw is cam0."""
    parts = [part for part in topic.replace("_", "/").split("/") if part]
    telling = [part for part in parts if part not in UNIMPORTANT]
    return "-".join(telling or parts) or "device"


def _kind(msgtype: str) -> str:
    return msgtype.rsplit("/", 1)[-1]


def _messages(path: Path, topics: dict[str, Topic], offset_s: float | None, faults: Faults) -> Iterator[Measurement]:
    frames: dict[str, int] = {}
    try:
        with _reader(path) as reader:
            connections = [c for c in reader.connections if c.topic in topics and _kind(c.msgtype) in CONVERTERS]
            for connection, arrival_ns, data in reader.messages(connections) if connections else ():
                try:
                    message = reader.deserialize(data, connection.msgtype)
                    t_ns = _stamp(message, arrival_ns, offset_s)
                    item = CONVERTERS[_kind(connection.msgtype)](message, topics[connection.topic].device, t_ns)
                except Exception as error:  # a damaged message is any message
                    faults.add(connection.topic, "a message is left out", one_line(error))
                    continue
                if isinstance(item, CameraFrame):
                    frames[item.camera] = frames.get(item.camera, -1) + 1
                    item = replace(item, index=frames[item.camera])
                if item is not None:
                    yield item
    except Exception as error:  # as in open_bag
        faults.add(path.name, f"cannot be read to its end: {one_line(error)}")


def _stamp(message: Any, arrival_ns: int, offset_s: float | None) -> int:
    """GPST, ns, of a message's header, or of its arrival where it has none."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    t_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) if stamp else 0
    t_ns = t_ns or arrival_ns
    return gpst_of_unix(t_ns) if offset_s is None else t_ns + round(offset_s * 1e9)
