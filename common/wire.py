"""Messages ⇄ bytes: MessagePack maps that fit the JSON Schemas in `schemas/`. `encode` and `decode` are the way in.

`encode` refuses what does not fit as strictly as `decode` does, so a message that left is a message that arrives.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar, get_args, overload

import msgpack

import schemas
from common.errors import WireError
from common.images import jpeg_size
from common.measurements import CameraFrame, Encoding
from common.messages import Keyframe, MapTile, Message
from common.schema import Check, MismatchError, compile_schema
from common.streams import STREAMS, Stream
from common.wire_fields import Fields, record_codec
from common.wire_tile import pack_tile, unpack_tile

M = TypeVar("M", bound=Message)

VERSION = 1
_MAX_THUMBNAIL_SIDE = 1024
_BYTES_PER_PIXEL = {Encoding.MONO8: 1, Encoding.BGR8: 3}


@dataclass(frozen=True)
class Format:
    """How one message type is written: its schema's name, its check, and the functions to and from a map."""

    name: str
    check: Check
    pack: Callable[[Any], Fields]
    unpack: Callable[[Fields], Any]
    check_content: Callable[[Any], None]
    max_bytes: int


def encode(message: Message) -> bytes:
    """The payload of a message. Raises WireError, naming message and field, when it does not fit its schema."""
    form = _format(type(message))
    try:
        form.check_content(message)
        fields = {"v": VERSION, **form.pack(message)}
        form.check(fields, "")
        payload: bytes = msgpack.packb(fields, use_bin_type=True)
    except (MismatchError, ValueError, TypeError, OverflowError, AttributeError) as error:
        raise WireError(f"{form.name}: cannot encode: {error}") from error
    _check_size(form.name, payload, form.max_bytes)
    return payload


@overload
def decode(what: type[M], payload: bytes) -> M: ...
@overload
def decode(what: Stream, payload: bytes) -> Message: ...
def decode(what: Stream | type[Any], payload: bytes) -> Any:
    """The message in a payload of a stream, or of a message type.

    Raises WireError, naming message and field, for bytes that are no valid message of this type and version.
    """
    form = _format(what.message if isinstance(what, Stream) else what)
    _check_size(form.name, payload, what.max_bytes if isinstance(what, Stream) else form.max_bytes)
    fields = _unpack_map(form, payload)
    try:
        form.check(fields, "")
        message = form.unpack(fields)
        form.check_content(message)
    except (MismatchError, ValueError, OverflowError) as error:
        raise WireError(f"{form.name}: {error}") from error
    return message


def schema_name(message: type[Any]) -> str:
    """Name of the schema of a message type, for example `map_tile.v1`. Raises WireError for a type without one."""
    return f"{_format(message).name}.v{VERSION}"


def _format(kind: type[Any]) -> Format:
    try:
        return _FORMATS[kind]
    except KeyError:
        raise WireError(f"{kind.__name__} is no message of the wire") from None


def _check_size(name: str, payload: bytes, max_bytes: int) -> None:
    if len(payload) > max_bytes:
        raise WireError(f"{name}: {len(payload)} bytes; its stream allows {max_bytes}")


def _unpack_map(form: Format, payload: bytes) -> Fields:
    try:
        fields = msgpack.unpackb(payload, raw=False, strict_map_key=True, object_pairs_hook=_unique_keys)
    except (ValueError, msgpack.UnpackException) as error:
        raise WireError(f"{form.name}: not a MessagePack map: {error}") from error
    if not isinstance(fields, dict):
        raise WireError(f"{form.name}: not a MessagePack map but {type(fields).__name__}")
    version = fields.get("v")
    if type(version) is not int or version != VERSION:
        raise WireError(f"{form.name}: version v is {version!r:.20}; this program reads version {VERSION}")
    return fields


def _unique_keys(pairs: list[tuple[Any, Any]]) -> Fields:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        raise ValueError("a field occurs twice")
    return fields


# What a schema cannot say


def _accept(message: Any) -> None:
    """Nothing beyond the schema."""


def _check_thumbnail(m: Keyframe) -> None:
    if m.thumbnail:
        try:
            side = max(jpeg_size(m.thumbnail))
        except ValueError as error:
            raise ValueError(f"thumbnail {error}") from error
        if side > _MAX_THUMBNAIL_SIDE:
            raise ValueError(f"thumbnail is {side} px wide or high; allowed: {_MAX_THUMBNAIL_SIDE}")


def _check_pixels(m: CameraFrame) -> None:
    if m.encoding in _BYTES_PER_PIXEL:
        size = m.width * m.height * _BYTES_PER_PIXEL[m.encoding]
        if len(m.data) != size:
            raise ValueError(f"data has {len(m.data)} bytes, not {size} for {m.width} x {m.height} px {m.encoding}")


_CONTENT: dict[type[Any], Callable[[Any], None]] = {Keyframe: _check_thumbnail, CameraFrame: _check_pixels}


def _make_format(kind: type[Any]) -> Format:
    name = re.sub(r"(?<=.)(?=[A-Z])", "_", kind.__name__).lower()
    schema = schemas.load(name, VERSION)
    max_bytes = max(stream.max_bytes for stream in STREAMS if stream.message is kind)
    tile = (partial(pack_tile, max_bytes=max_bytes), unpack_tile)
    pack, unpack = tile if kind is MapTile else record_codec(kind, schema)
    return Format(name, compile_schema(schema), pack, unpack, _CONTENT.get(kind, _accept), max_bytes)


_FORMATS: dict[type[Any], Format] = {kind: _make_format(kind) for kind in get_args(Message)}
