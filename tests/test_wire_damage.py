"""Whatever arrives instead of a message, the decoder says WireError or gives a message that could be sent on."""

from __future__ import annotations

from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_samples import SAMPLES, TYPES

from common.errors import WireError
from common.messages import MapTile, Message
from common.wire import decode, encode

PAYLOADS = {type(sample): encode(sample) for sample in SAMPLES}
by_type = pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.__name__)

JUNK = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=5)
    | st.binary(max_size=9)
    | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=3)),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3) | st.binary(max_size=2), inner),
    max_leaves=6,
)


def refused_or_whole(kind: type[Message], payload: bytes) -> None:
    try:
        message = decode(kind, payload)
    except WireError:
        return
    assert isinstance(message, kind)
    encode(message)


@by_type
@settings(max_examples=100, deadline=None)
@given(payload=st.binary(max_size=300) | JUNK.map(msgpack.packb))
def test_bytes_that_are_no_message_are_refused(kind: type[Message], payload: bytes) -> None:
    with pytest.raises(WireError):
        decode(kind, payload)


@by_type
@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_flipped_bits_and_lost_ends_raise_nothing_but_wire_errors(kind: type[Message], data: st.DataObject) -> None:
    payload = bytearray(PAYLOADS[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    refused_or_whole(kind, bytes(payload))
    with pytest.raises(WireError):
        decode(kind, PAYLOADS[kind][: data.draw(st.integers(0, len(payload) - 1))])


@by_type
@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_field_of_junk_raises_nothing_but_wire_errors(kind: type[Message], data: st.DataObject) -> None:
    fields: dict[str, Any] = msgpack.unpackb(PAYLOADS[kind])
    where, name = fields, data.draw(st.sampled_from(sorted(fields)))
    while isinstance(where[name], dict) and where[name] and data.draw(st.booleans()):
        where = where[name]
        name = data.draw(st.sampled_from(sorted(where)))
    where[name] = data.draw(JUNK)
    refused_or_whole(kind, msgpack.packb(fields))


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_damaged_images_of_a_tile_raise_nothing_but_wire_errors(data: st.DataObject) -> None:
    fields: dict[str, Any] = msgpack.unpackb(PAYLOADS[MapTile])
    name = data.draw(st.sampled_from(["height_png", "sigma_png", "views_png", "disputed_png", "colour_jpeg"]))
    image = bytearray(fields[name])
    start = data.draw(st.integers(0, len(image) - 1))
    image[start : start + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    refused_or_whole(MapTile, msgpack.packb({**fields, name: bytes(image)}))


def test_every_single_flipped_bit_in_a_plane_is_noticed() -> None:
    """PNG carries checksums: a changed height never passes for a measured one."""
    fields: dict[str, Any] = msgpack.unpackb(PAYLOADS[MapTile])
    whole = fields["height_png"]
    for i in range(len(whole)):
        damaged = bytearray(whole)
        damaged[i] ^= 0x10
        with pytest.raises(WireError, match="height_png"):
            decode(MapTile, msgpack.packb({**fields, "height_png": bytes(damaged)}))


def test_a_deeply_nested_payload_is_refused() -> None:
    with pytest.raises(WireError):
        decode(TYPES[0], b"\x91" * 900 + b"\xc0")
    with pytest.raises(WireError):
        decode(TYPES[6], b"\x81\xa1v" + b"\x91" * 400 + b"\xc0")
