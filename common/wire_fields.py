"""Records ⇄ MessagePack maps, field by field: the type hint of a field and its JSON Schema say how it is written.

Vectors of a known length travel as lists of numbers, columns and tables as little-endian bytes. Where the schema of a
number allows null, null stands for NaN. Raises ValueError, naming the field, for what does not fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from enum import Enum
from operator import attrgetter
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from common.camera import CameraModel
from common.se3 import SE3
from schemas import Schema

Fields = dict[str, Any]
Convert = Callable[[Any], Any]

_DTYPES = {"float64": "<f8", "int32": "<i4", "bool": "u1"}
_NAN = float("nan")
_QUATERNION_TOLERANCE = 1e-3
_ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Codec:
    """To and from the value of a field on the wire; None where it needs no change."""

    pack: Convert | None = None
    unpack: Convert | None = None


def record_codec(kind: type[Any], schema: Schema) -> tuple[Callable[[Any], Fields], Callable[[Fields], Any]]:
    """How a dataclass becomes a map, and back. Raises TypeError for a field that has no form on the wire.

    A field that the schema does not require is left out where it is unknown, and then has its default.
    """
    hints, names = get_type_hints(kind), [f.name for f in fields(kind)]
    properties, required = schema["properties"], set(schema["required"])
    codecs = [_field_codec(name, hints[name], properties[name]) for name in names]
    packers = [(name, codec.pack) for name, codec in zip(names, codecs, strict=True)]
    unpackers = [(name, codec.unpack) for name, codec in zip(names, codecs, strict=True)]
    values_of = attrgetter(*names)
    check_rows = _rows_check([name for name in names if properties[name].get("shape") == ["N"]])

    def pack(record: Any) -> Fields:
        check_rows(record)
        pairs = zip(packers, values_of(record), strict=True)
        values = {name: value if convert is None else convert(value) for (name, convert), value in pairs}
        return {name: value for name, value in values.items() if name in required or not _is_unknown(value)}

    def unpack(f: Fields) -> Any:
        known = [(name, convert) for name, convert in unpackers if name in f]
        record = kind(**{name: f[name] if convert is None else convert(f[name]) for name, convert in known})
        check_rows(record)
        return record

    return pack, unpack


def describe(value: Any) -> str:
    """The type of a value, and the shape of an array, for error messages."""
    return f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__


def _is_unknown(value: Any) -> bool:
    """Whether a value on the wire says nothing."""
    return value is None or value == {} or (isinstance(value, list) and all(x is None for x in value))


def _rows_check(names: list[str]) -> Callable[[Any], None]:
    """Raises ValueError when fields that hold a value for each of N rows differ in length."""

    def check(record: Any) -> None:
        lengths = [len(getattr(record, name)) for name in names]
        for name, length in zip(names, lengths, strict=True):
            if length != lengths[0]:
                raise ValueError(f"{name} has {length} rows, {names[0]} has {lengths[0]}")

    return check


def _field_codec(name: str, hint: Any, schema: Schema) -> Codec:
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        (inner,) = (arg for arg in args if arg is not NoneType)
        return _optional(_field_codec(name, inner, schema))
    if hint in (int, str, bytes, bool) or origin is dict:
        return Codec()
    if hint is float:
        return _float(schema)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return Codec(str, hint)
    if hint is SE3:
        return Codec(lambda T: _pack_se3(T, name), lambda f: _unpack_se3(f, name))
    if hint is CameraModel:
        return Codec(asdict, _unpack_camera)
    if origin is tuple:
        return Codec(list, tuple) if args[0] is str else _floats(schema)
    if origin is np.ndarray:
        return _array(name, schema)
    raise TypeError(f"{name}: {hint} has no form on the wire")


def _optional(codec: Codec) -> Codec:
    def or_none(convert: Convert | None) -> Convert | None:
        return convert and (lambda value: None if value is None else convert(value))

    return Codec(or_none(codec.pack), or_none(codec.unpack))


def _nullable(schema: Schema) -> bool:
    return "null" in schema.get("type", ())


def _float(schema: Schema) -> Codec:
    if not _nullable(schema):
        return Codec(None, float)
    return Codec(
        lambda value: None if value is None or value != value else value,
        lambda value: _NAN if value is None else float(value),
    )


def _floats(schema: Schema) -> Codec:
    return Codec(_without_nan(schema), lambda values: tuple(_NAN if x is None else float(x) for x in values))


def _without_nan(schema: Schema) -> Callable[[Sequence[float]], list[float | None]]:
    """The values as a list, NaN as null where the schema has null for unknown."""
    if not _nullable(schema.get("items", {})):
        return list
    return lambda values: [None if x != x else x for x in values]


def _array(name: str, schema: Schema) -> Codec:
    if schema.get("type") == "object":
        return _table(name, schema)
    return _column(name, schema) if "dtype" in schema else _vector(name, schema)


def _vector(name: str, schema: Schema) -> Codec:
    shape, without_nan, is_quaternion = tuple(schema["shape"]), _without_nan(schema), name.startswith("q_")

    def pack(vector: Any) -> list[float | None]:
        values = without_nan(_checked(vector, shape, name).astype(np.float64, copy=False).tolist())
        if is_quaternion:
            _check_norm(values, name)
        return values

    def unpack(values: list[float | None]) -> Any:
        if is_quaternion:
            _check_norm(values, name)
        return np.array(values, np.float64)

    return Codec(pack, unpack)


def _column(name: str, schema: Schema) -> Codec:
    kind, wire = np.dtype(schema["dtype"]), np.dtype(_DTYPES[schema["dtype"]])

    def pack(column: Any) -> bytes:
        if not isinstance(column, np.ndarray) or column.dtype != kind or column.ndim != 1:
            raise ValueError(f"{name} is {describe(column)}, not {kind} of shape (N,)")
        return column.astype(wire, copy=False).tobytes()

    def unpack(data: bytes) -> Any:
        if len(data) % wire.itemsize:
            raise ValueError(f"{name} has {len(data)} bytes, no multiple of {wire.itemsize}")
        column = np.frombuffer(data, wire)
        if kind == np.bool_ and (column > 1).any():
            raise ValueError(f"{name} holds something else than 0 and 1")
        return column.astype(kind)

    return Codec(pack, unpack)


def _table(name: str, schema: Schema) -> Codec:
    columns, kind, wire = schema["shape"][1], np.dtype(schema["dtype"]), np.dtype(_DTYPES[schema["dtype"]])

    def pack(table: Any) -> Fields:
        if not isinstance(table, np.ndarray) or table.dtype != kind or table.ndim != 2 or table.shape[1] != columns:
            raise ValueError(f"{name} is {describe(table)}, not {kind} of shape (M, {columns})")
        return {"shape": list(table.shape), "data": table.astype(wire, copy=False).tobytes()}

    def unpack(f: Fields) -> Any:
        rows, data = f["shape"][0], f["data"]
        if len(data) != wire.itemsize * rows * columns:
            expected = wire.itemsize * rows * columns
            raise ValueError(f"{name}.data has {len(data)} bytes, not {expected} for {rows} rows")
        return np.frombuffer(data, wire).reshape(rows, columns).astype(kind)

    return Codec(pack, unpack)


def _pack_se3(T: SE3, name: str) -> Fields:
    R, t = _checked(T.R, (3, 3), name + ".R"), _checked(T.t, (3,), name + ".t")
    if not (np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_TOLERANCE and R[0] @ np.cross(R[1], R[2]) > 0):
        raise ValueError(f"{name}.R is not a rotation matrix")
    return {"position": t.astype(np.float64, copy=False).tolist(), "quaternion": T.wxyz.tolist()}


def _unpack_se3(f: Fields, name: str) -> SE3:
    _check_norm(f["quaternion"], name + ".quaternion")
    return SE3.from_quaternion(f["quaternion"], f["position"])


def _check_norm(wxyz: Sequence[Any], name: str) -> None:
    norm = float(np.linalg.norm(wxyz))
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise ValueError(f"{name} has norm {norm:.6g}, not 1")


def _unpack_camera(f: Fields) -> CameraModel:
    numbers = {name: float(value) for name, value in f.items() if name not in {"width", "height"}}
    return CameraModel(f["width"], f["height"], **numbers)


def _checked(value: Any, shape: tuple[int, ...], name: str) -> Any:
    if not isinstance(value, np.ndarray) or value.shape != shape:
        raise ValueError(f"{name} is {describe(value)}, not an array of shape {shape}")
    return value
