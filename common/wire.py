"""Messages ⇄ bytes: MessagePack maps that fit the JSON Schemas in `schemas/`. The only file that knows the format.

`encode` refuses what does not fit as strictly as `decode` does, so a message that left is a message that arrives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, TypeVar, cast, overload

import msgpack
import numpy as np
import numpy.typing as npt

import schemas
from common.arrays import I32
from common.camera import CameraModel
from common.errors import WireError
from common.images import jpeg_size
from common.messages import Datum, Health, Keyframe, Level, MapDigest, MapTile, Message, Mode, Pose, TileId, TileRequest
from common.schema import Check, MismatchError, compile_schema
from common.se3 import SE3
from common.streams import STREAMS, Stream
from common.tile_images import pack_images, unpack_images

M = TypeVar("M", Datum, Pose, Keyframe, MapTile, MapDigest, TileRequest, Health)
Fields = dict[str, Any]

VERSION = 1
_TILE_OVERHEAD = 1_000  # bytes of a tile's map beside its images, with room to spare
_MAX_THUMBNAIL_SIDE = 1024
_QUATERNION_TOLERANCE = 1e-3
_ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Format:
    """How one message type is written: its schema's name, its check, and the functions to and from a map."""

    name: str
    check: Check
    pack: Callable[[Any], Fields]
    unpack: Callable[[Fields], Any]
    max_bytes: int


def encode(message: Message) -> bytes:
    """The payload of a message. Raises WireError, naming message and field, when it does not fit its schema."""
    form = _format(type(message))
    try:
        fields = {"v": VERSION, **form.pack(message)}
        form.check(fields, "")
        payload: bytes = msgpack.packb(fields, use_bin_type=True)
    except (MismatchError, ValueError, TypeError, OverflowError, AttributeError) as error:
        raise WireError(f"{form.name}: cannot encode: {error}") from error
    _check_size(form, payload)
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
    _check_size(form, payload)
    fields = _unpack_map(form, payload)
    try:
        form.check(fields, "")
        return form.unpack(fields)
    except (MismatchError, ValueError, OverflowError) as error:
        raise WireError(f"{form.name}: {error}") from error


def schema_name(message: type[Any]) -> str:
    """Name of the schema of a message type, for example `map_tile.v1`. Raises WireError for a type without one."""
    return f"{_format(message).name}.v{VERSION}"


def _format(kind: type[Any]) -> Format:
    try:
        return _FORMATS[kind]
    except KeyError:
        raise WireError(f"{kind.__name__} is no message of the wire") from None


def _check_size(form: Format, payload: bytes) -> None:
    if len(payload) > form.max_bytes:
        raise WireError(f"{form.name}: {len(payload)} bytes; its stream allows {form.max_bytes}")


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


# Parts


def _pack_se3(T: SE3, name: str) -> Fields:
    R = _array(T.R, (3, 3), name + ".R")
    if not (np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_TOLERANCE and R[0] @ np.cross(R[1], R[2]) > 0):
        raise ValueError(f"{name}.R is not a rotation matrix")
    return {"position": _floats(T.t, (3,), name + ".t"), "quaternion": T.wxyz.tolist()}


def _unpack_se3(fields: Fields, name: str) -> SE3:
    norm = float(np.linalg.norm(fields["quaternion"]))
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise ValueError(f"{name}.quaternion has norm {norm:.6g}, not 1")
    return SE3.from_quaternion(fields["quaternion"], fields["position"])


def _pack_camera(camera: CameraModel) -> Fields:
    return asdict(camera)


def _unpack_camera(fields: Fields) -> CameraModel:
    numbers = {name: float(value) for name, value in fields.items() if name not in {"width", "height"}}
    return CameraModel(fields["width"], fields["height"], **numbers)


def _pack_rows(rows: I32, name: str, columns: int) -> Fields:
    if not isinstance(rows, np.ndarray) or rows.dtype != np.int32 or rows.ndim != 2 or rows.shape[1] != columns:
        raise ValueError(f"{name} is {_describe(rows)}, not int32 of shape (M, {columns})")
    return {"shape": list(rows.shape), "data": rows.astype("<i4").tobytes()}


def _unpack_rows(fields: Fields, name: str) -> I32:
    rows, columns = fields["shape"]
    if len(fields["data"]) != 4 * rows * columns:
        raise ValueError(f"{name}.data has {len(fields['data'])} bytes, not {4 * rows * columns} for {rows} rows")
    return np.frombuffer(fields["data"], "<i4").reshape(rows, columns).astype(np.int32)


def _check_thumbnail(jpeg: bytes) -> None:
    if jpeg:
        try:
            side = max(jpeg_size(jpeg))
        except ValueError as error:
            raise ValueError(f"thumbnail {error}") from error
        if side > _MAX_THUMBNAIL_SIDE:
            raise ValueError(f"thumbnail is {side} px wide or high; allowed: {_MAX_THUMBNAIL_SIDE}")


def _array(value: Any, shape: tuple[int, ...], name: str) -> npt.NDArray[Any]:
    if not isinstance(value, np.ndarray) or value.shape != shape:
        raise ValueError(f"{name} is {_describe(value)}, not an array of shape {shape}")
    return value


def _floats(value: Any, shape: tuple[int, ...], name: str) -> list[float]:
    return cast(list[float], _array(value, shape, name).astype(np.float64).tolist())


def _describe(value: Any) -> str:
    return f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__


# Messages


def _pack_datum(m: Datum) -> Fields:
    return asdict(m)


def _unpack_datum(f: Fields) -> Datum:
    return Datum(f["flight"], float(f["latitude_deg"]), float(f["longitude_deg"]), float(f["height"]))


def _pack_pose(m: Pose) -> Fields:
    return {
        "flight": m.flight,
        "t_ns": m.t_ns,
        "revision": m.revision,
        "T_world_body": _pack_se3(m.T_world_body, "T_world_body"),
        "v_world": None if m.v_world is None else _floats(m.v_world, (3,), "v_world"),
        "sigma": _floats(m.sigma, (3,), "sigma"),
        "mode": str(m.mode),
    }


def _unpack_pose(f: Fields) -> Pose:
    return Pose(
        f["flight"],
        f["t_ns"],
        f["revision"],
        _unpack_se3(f["T_world_body"], "T_world_body"),
        None if f["v_world"] is None else np.array(f["v_world"], np.float64),
        np.array(f["sigma"], np.float64),
        Mode(f["mode"]),
    )


def _pack_keyframe(m: Keyframe) -> Fields:
    _check_thumbnail(m.thumbnail)
    return {
        "flight": m.flight,
        "index": m.index,
        "revision": m.revision,
        "t_ns": m.t_ns,
        "name": m.name,
        "T_world_cam": _pack_se3(m.T_world_cam, "T_world_cam"),
        "camera": _pack_camera(m.camera),
        "sigma": _floats(m.sigma, (3,), "sigma"),
        "thumbnail": m.thumbnail,
    }


def _unpack_keyframe(f: Fields) -> Keyframe:
    _check_thumbnail(f["thumbnail"])
    return Keyframe(
        f["flight"],
        f["index"],
        f["revision"],
        f["t_ns"],
        f["name"],
        _unpack_se3(f["T_world_cam"], "T_world_cam"),
        _unpack_camera(f["camera"]),
        np.array(f["sigma"], np.float64),
        f["thumbnail"],
    )


def _check_tile(m: MapTile) -> None:
    n = len(m.height)
    planes: tuple[tuple[str, type[Any], tuple[int, ...]], ...] = (
        ("height", np.float32, (n, n)),
        ("sigma", np.float32, (n, n)),
        ("colour", np.uint8, (n, n, 3)),
        ("views", np.uint8, (n, n)),
        ("disputed", np.bool_, (n, n)),
    )
    for name, dtype, shape in planes:
        plane = _array(getattr(m, name), shape, name)
        if plane.dtype != dtype:
            raise ValueError(f"{name} is {_describe(plane)}, not {dtype.__name__}")
    if np.isinf(m.height).any():
        raise ValueError("height is infinite somewhere; NaN says that a cell is unknown")
    sigma = m.sigma[np.isfinite(m.height)]
    if not (np.isfinite(sigma) & (sigma >= 0)).all():
        raise ValueError("sigma is negative or not finite where the height is known")


def _pack_tile(m: MapTile) -> Fields:
    _check_tile(m)
    place = {"flight": m.flight, "level": m.id.level, "x": m.id.x, "y": m.id.y}
    state = {"revision": m.revision, "t_ns": m.t_ns, "size": len(m.height), "cell": m.cell}
    return {**place, **state, **pack_images(m, _FORMATS[MapTile].max_bytes - _TILE_OVERHEAD)}


def _unpack_tile(f: Fields) -> MapTile:
    tile = TileId(f["level"], f["x"], f["y"])
    return MapTile(f["flight"], tile, f["revision"], f["t_ns"], float(f["cell"]), *unpack_images(f))


def _pack_digest(m: MapDigest) -> Fields:
    return {"flight": m.flight, "t_ns": m.t_ns, "tiles": _pack_rows(m.tiles, "tiles", 4)}


def _unpack_digest(f: Fields) -> MapDigest:
    return MapDigest(f["flight"], f["t_ns"], _unpack_rows(f["tiles"], "tiles"))


def _pack_request(m: TileRequest) -> Fields:
    return {"flight": m.flight, "tiles": _pack_rows(m.tiles, "tiles", 3)}


def _unpack_request(f: Fields) -> TileRequest:
    return TileRequest(f["flight"], _unpack_rows(f["tiles"], "tiles"))


def _pack_health(m: Health) -> Fields:
    return {"t_ns": m.t_ns, "role": m.role, "level": str(m.level), "text": m.text, "counts": dict(m.counts)}


def _unpack_health(f: Fields) -> Health:
    return Health(f["t_ns"], f["role"], Level(f["level"]), f["text"], f["counts"])


def _make_format(kind: type[Any], name: str, pack: Callable[[Any], Fields], unpack: Callable[[Fields], Any]) -> Format:
    max_bytes = max(stream.max_bytes for stream in STREAMS if stream.message is kind)
    return Format(name, compile_schema(schemas.load(name, VERSION)), pack, unpack, max_bytes)


_FORMATS: dict[type[Any], Format] = {
    kind: _make_format(kind, name, pack, unpack)
    for kind, name, pack, unpack in (
        (Datum, "datum", _pack_datum, _unpack_datum),
        (Pose, "pose", _pack_pose, _unpack_pose),
        (Keyframe, "keyframe", _pack_keyframe, _unpack_keyframe),
        (MapTile, "map_tile", _pack_tile, _unpack_tile),
        (MapDigest, "map_digest", _pack_digest, _unpack_digest),
        (TileRequest, "tile_request", _pack_request, _unpack_request),
        (Health, "health", _pack_health, _unpack_health),
    )
}
