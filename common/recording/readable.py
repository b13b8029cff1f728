"""Payloads as JSON, for viewers that know no MessagePack: columns as lists, other bytes as base64."""

from __future__ import annotations

import base64
import json
import math
from functools import cache
from typing import Any

import msgpack
import numpy as np

import schemas
from schemas import Schema

_DTYPES = {"float64": "<f8", "int32": "<i4", "bool": "u1"}
_NUMBERS = {"type": "array", "items": {"type": ["number", "null"]}}


def readable_json(payload: bytes, name: str) -> bytes | None:
    """A payload as UTF-8 JSON, or None when it is no map that fits the schema of this name (`imu_sample.v1`)."""
    try:
        fields = msgpack.unpackb(payload)
        return json.dumps(_readable(fields, _schema(name)), ensure_ascii=False, allow_nan=False).encode()
    except (ValueError, TypeError, KeyError, AttributeError, msgpack.UnpackException):
        return None


def readable_schema(schema: Schema) -> Schema:
    """The schema of the JSON form of messages that fit a schema."""
    if schema.get("bin"):
        told = {name: value for name, value in schema.items() if name not in ("bin", "dtype")}
        return told | (_NUMBERS if "dtype" in schema else {"type": "string", "contentEncoding": "base64"})
    return {
        name: {key: readable_schema(inner) for key, inner in value.items()}
        if name in ("properties", "$defs")
        else value
        for name, value in schema.items()
    }


@cache
def _schema(name: str) -> Schema:
    base, _, number = name.rpartition(".v")
    return schemas.load(base, int(number))


def _readable(value: Any, schema: Schema) -> Any:
    if isinstance(value, bytes):
        if "dtype" not in schema:
            return base64.b64encode(value).decode()
        numbers = np.frombuffer(value, _DTYPES[schema["dtype"]]).tolist()
        return [number if math.isfinite(number) else None for number in numbers]
    if isinstance(value, dict):
        inner = schema.get("properties", {})
        return {name: _readable(item, inner.get(name, {})) for name, item in value.items()}
    return value
