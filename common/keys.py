"""Key expressions: `luojia/@v1/{vehicle}/{stream}[/…]`. The only place that knows how they are built.

`**` does not match the verbatim chunk `@v1`, so subscriptions name it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from common.errors import WireError
from common.measurements import CameraFrame, ClockState, GlonassEphemeris, Ionosphere, KeplerEphemeris, RawBytes
from common.messages import Health, Keyframe, MapTile, Message, TileId
from common.streams import STREAMS, Stream

PREFIX = "luojia/@v1"
_VEHICLE = re.compile(r"[A-Za-z0-9_-]{1,32}")


@dataclass(frozen=True)
class Key:
    """A parsed key: the vehicle, the stream, and the chunks behind the stream's name."""

    vehicle: str
    stream: Stream
    rest: tuple[str, ...]


def stream_key(vehicle: str, stream: Stream, *rest: str | int) -> str:
    """Key of a stream of a vehicle, with further chunks appended."""
    return "/".join([PREFIX, vehicle, stream.name, *map(str, rest)])


def tile_key(vehicle: str, stream: Stream, tile: TileId) -> str:
    """Key of one map tile: level, x, y."""
    return stream_key(vehicle, stream, tile.level, tile.x, tile.y)


def place_of(stream: Stream, message: Message) -> tuple[str, ...]:
    """The chunks that a message adds to the name of its stream: a tile's place, a device, a satellite."""
    if not stream.keyed:
        return ()
    match message:
        case MapTile(id=TileId(level, x, y)):
            return (str(level), str(x), str(y))
        case Keyframe(index=index):
            return (str(index),)
        case Health(role=name) | CameraFrame(camera=name) | Ionosphere(system=name):
            return (name,)
        case RawBytes(device=name) | ClockState(device=name):
            return (name,)
        case KeplerEphemeris(satellite=name) | GlonassEphemeris(satellite=name):
            return (name,)
        case _:
            raise TypeError(f"{type(message).__name__} has no place in a keyed stream")


def message_key(vehicle: str, stream: Stream, message: Message) -> str:
    """Key under which a message is published."""
    return stream_key(vehicle, stream, *place_of(stream, message))


def all_of(stream: Stream, vehicle: str = "*") -> str:
    """Key expression for a stream of one vehicle or of all."""
    return f"{PREFIX}/{vehicle}/{stream.name}" + ("/**" if stream.keyed else "")


def alive_key(vehicle: str, role: str) -> str:
    """Key of the liveliness token of a role of a vehicle (or of a ground station)."""
    return f"{PREFIX}/{vehicle}/alive/{role}"


def parse_key(key: str) -> Key:
    """The vehicle, stream and remaining chunks of a key. Raises WireError for a key that is not ours."""
    chunks = key.removeprefix(PREFIX + "/").split("/")
    if not key.startswith(PREFIX + "/") or not _VEHICLE.fullmatch(chunks[0]):
        raise WireError(f"key {key!r} does not begin with {PREFIX}/VEHICLE")
    name = "/".join(chunks[1:])
    for stream in STREAMS:
        if name == stream.name:
            return Key(chunks[0], stream, ())
        if stream.keyed and name.startswith(stream.name + "/"):
            return Key(chunks[0], stream, tuple(name[len(stream.name) + 1 :].split("/")))
    raise WireError(f"key {key!r} names no stream of the table")
