"""Checks of MessagePack values, compiled from a JSON Schema: tens of times faster than a general validator.

The schema stays the single truth. Only the keywords that our schemas use are understood, and any other is refused
at compilation. On top of JSON Schema (draft 2020-12) `bin: true` stands for a MessagePack byte string, and, as
JSON knows neither, `number` excludes NaN and infinity and `integer` excludes floats.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from schemas import Schema

Check = Callable[[Any, str], None]

_TYPES: dict[str, Callable[[Any], bool]] = {
    "object": lambda value: isinstance(value, dict),
    "array": lambda value: isinstance(value, list),
    "boolean": lambda value: type(value) is bool,
    "string": lambda value: isinstance(value, str),
    "integer": lambda value: type(value) is int,
    "number": lambda value: type(value) is int or (isinstance(value, float) and math.isfinite(value)),
    "null": lambda value: value is None,
}
_SILENT = {
    *("$schema", "$id", "$defs", "title", "description", "unit", "frame", "shape", "dtype"),
    *("contentMediaType", "bitDepth", "channels", "maxSide"),
}
_SHAPE = {"required", "properties", "additionalProperties", "propertyNames", "maxProperties"}
_ITEMS = {"items", "prefixItems", "minItems", "maxItems"}
_LENGTH = {"minLength", "maxLength"}
_RANGE = {"minimum", "maximum", "exclusiveMinimum"}
_KNOWN = {*_SILENT, *_SHAPE, *_ITEMS, *_LENGTH, *_RANGE, "$ref", "type", "bin", "const", "enum"}


class MismatchError(Exception):
    """A value does not fit its schema; the text names the field."""


def compile_schema(schema: Schema) -> Check:
    """A function that raises MismatchError when a value, found at a named place, does not fit the schema.

    Raises ValueError for a schema with a keyword that is not understood here.
    """
    return _compile(schema, schema.get("$defs", {}))


def _compile(schema: Schema, defs: dict[str, Schema]) -> Check:
    if unknown := sorted(schema.keys() - _KNOWN):
        raise ValueError(f"schema keyword {', '.join(unknown)} is not understood")
    if "$ref" in schema:
        return _compile(defs[schema["$ref"].removeprefix("#/$defs/")], defs)
    checks = [build(schema, defs) for keywords, build in _BUILDERS if schema.keys() & keywords]

    def check(value: Any, at: str) -> None:
        for one in checks:
            one(value, at)

    return checks[0] if len(checks) == 1 else check


def _bin(schema: Schema, defs: dict[str, Schema]) -> Check:
    def check(value: Any, at: str) -> None:
        if not isinstance(value, bytes):
            raise MismatchError(f"{at} is {_show(value)}, not a byte string")

    return check


def _const(schema: Schema, defs: dict[str, Schema]) -> Check:
    allowed = schema["enum"] if "enum" in schema else [schema["const"]]
    pairs = [(type(item), item) for item in allowed]

    def check(value: Any, at: str) -> None:
        for kind, item in pairs:
            if type(value) is kind and value == item:
                return
        raise MismatchError(f"{at} is {_show(value)}; allowed: {', '.join(map(repr, allowed))}")

    return check


def _type(schema: Schema, defs: dict[str, Schema]) -> Check:
    names = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    tests = [_TYPES[name] for name in names]

    def check(value: Any, at: str) -> None:
        for test in tests:
            if test(value):
                return
        finite = "finite " if "number" in names else ""
        raise MismatchError(f"{at} is {_show(value)}, not {finite}{' or '.join(names)}")

    return check


def _range(schema: Schema, defs: dict[str, Schema]) -> Check:
    low, high = schema.get("minimum", -math.inf), schema.get("maximum", math.inf)
    above = schema.get("exclusiveMinimum", -math.inf)

    def check(value: Any, at: str) -> None:
        if value is None:
            return
        if not low <= value <= high:
            raise MismatchError(f"{at} is {_show(value)}; allowed: {low} to {high}")
        if not value > above:
            raise MismatchError(f"{at} is {_show(value)}; allowed: more than {above}")

    return check


def _length(schema: Schema, defs: dict[str, Schema]) -> Check:
    low, high = schema.get("minLength", 0), schema.get("maxLength", math.inf)

    def check(value: Any, at: str) -> None:
        if value is None:
            return
        if not low <= len(value) <= high:
            raise MismatchError(f"{at} has {len(value)} characters; allowed: {low} to {high}")

    return check


def _array(schema: Schema, defs: dict[str, Schema]) -> Check:
    low, high = schema.get("minItems", 0), schema.get("maxItems", math.inf)
    prefix = [_compile(item, defs) for item in schema.get("prefixItems", [])]
    rest = _compile(schema["items"], defs) if "items" in schema else None

    def check(value: Any, at: str) -> None:
        if value is None:
            return
        if not low <= len(value) <= high:
            raise MismatchError(f"{at} has {len(value)} items; allowed: {low} to {high}")
        for i, item in enumerate(value):
            one = prefix[i] if i < len(prefix) else rest
            if one is not None:
                one(item, f"{at}[{i}]")

    return check


def _object(schema: Schema, defs: dict[str, Schema]) -> Check:
    required = schema.get("required", [])
    fields = {name: _compile(field, defs) for name, field in schema.get("properties", {}).items()}
    other = schema.get("additionalProperties", True)
    rest = _compile(other, defs) if isinstance(other, dict) else None
    name_check = _compile(schema["propertyNames"], defs) if "propertyNames" in schema else None
    limit = schema.get("maxProperties", math.inf)

    def check(value: Any, at: str) -> None:
        if len(value) > limit:
            raise MismatchError(f"{at} has {len(value)} entries; allowed: at most {limit}")
        for name in required:
            if name not in value:
                raise MismatchError(f"{at}.{name} is missing".lstrip("."))
        for name, item in value.items():
            place = f"{at}.{name}" if at else str(name)
            if name_check is not None:
                name_check(name, f"the name {place!r}")
            one = fields.get(name, rest)
            if one is not None:
                one(item, place)
            elif not other:
                raise MismatchError(f"{place!r} is not a field of this message")

    return check


def _show(value: Any) -> str:
    """A value as short text, for error messages."""
    if isinstance(value, bytes | list | dict):
        return f"{type(value).__name__} of length {len(value)}"
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


# The order matters: a value that passed the type check can be measured by the rest.
_BUILDERS: list[tuple[set[str], Callable[[Schema, dict[str, Schema]], Check]]] = [
    ({"bin"}, _bin),
    ({"const", "enum"}, _const),
    ({"type"}, _type),
    (_RANGE, _range),
    (_LENGTH, _length),
    (_ITEMS, _array),
    (_SHAPE, _object),
]
