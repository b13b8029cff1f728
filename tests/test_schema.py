"""Our compiled checks say the same as a general JSON Schema validator, and say it faster."""

from __future__ import annotations

import math
from typing import Any

import jsonschema
import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_samples import SAMPLES

import schemas
from common.messages import Level, Message, Mode
from common.schema import MismatchError, compile_schema
from common.wire import encode, schema_name

TYPES = jsonschema.Draft202012Validator.TYPE_CHECKER.redefine_many(
    {
        "integer": lambda _, value: type(value) is int,
        "number": lambda _, value: type(value) is int or (isinstance(value, float) and math.isfinite(value)),
    }
)


def _bin(validator: Any, wanted: bool, value: Any, schema: Any) -> Any:
    if wanted and not isinstance(value, bytes):
        yield jsonschema.ValidationError("not a byte string")


Oracle = jsonschema.validators.extend(jsonschema.Draft202012Validator, {"bin": _bin}, type_checker=TYPES)
VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.sampled_from([2**31 - 1, 2**31, 2**63 - 1, 2**63, -(2**31), 0, 1, 90, 1024, 1025]),
    st.floats(),
    st.text(max_size=70),
    st.binary(max_size=3),
    st.lists(st.floats(-1.1, 1.1) | st.integers(-1, 4), max_size=5),
    st.dictionaries(st.text(max_size=2), st.integers(0, 1), max_size=2),
    st.sampled_from([*Mode, *Level]).map(str),
)


def load(sample: Message) -> dict[str, Any]:
    name, version = schema_name(type(sample)).split(".v")
    return schemas.load(name, int(version))


@settings(max_examples=600, deadline=None)
@given(data=st.data())
def test_compiled_checks_agree_with_a_general_validator(data: st.DataObject) -> None:
    sample = data.draw(st.sampled_from(SAMPLES))
    schema, fields = load(sample), msgpack.unpackb(encode(sample))
    where = fields
    while True:
        name = data.draw(st.sampled_from([*sorted(where), "other"]))
        if isinstance(where.get(name), dict) and data.draw(st.booleans()):
            where = where[name]
            continue
        break
    if data.draw(st.integers(0, 9)) == 0:
        where.pop(name, None)
    else:
        where[name] = data.draw(VALUES)
    try:
        compile_schema(schema)(fields, "")
        ours = True
    except MismatchError:
        ours = False
    assert ours == Oracle(schema).is_valid(fields)


@pytest.mark.parametrize("name", schemas.names())
def test_every_schema_is_valid_and_says_what_each_field_means(name: str) -> None:
    schema = schemas.load(*_split(name))
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["title"]
    assert schema["description"]
    for field, definition in _leaves(schema):
        assert definition["description"], field
        if definition.get("type") == "number":
            assert "unit" in definition, f"{name}: {field} has no unit"


def _split(name: str) -> tuple[str, int]:
    stem, version = name.split(".v")
    return stem, int(version)


def _leaves(schema: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    objects = [schema, *schema.get("$defs", {}).values()]
    return [pair for one in objects for pair in one.get("properties", {}).items()]


def test_the_names_of_modes_and_levels_are_those_of_the_schemas() -> None:
    assert schemas.load("pose", 1)["properties"]["mode"]["enum"] == [str(mode) for mode in Mode]
    assert schemas.load("health", 1)["properties"]["level"]["enum"] == [str(level) for level in Level]


def test_a_schema_keyword_that_is_not_understood_is_refused() -> None:
    with pytest.raises(ValueError, match="multipleOf"):
        compile_schema({"type": "integer", "multipleOf": 2})
