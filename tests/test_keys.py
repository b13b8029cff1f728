"""Keys say which vehicle and stream a message belongs to, and nothing else passes for one."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.bus_memory import intersects
from common.errors import WireError
from common.keys import Key, alive_key, all_of, parse_key, stream_key, tile_key
from common.messages import TileId
from common.streams import STREAMS, TILE, Stream

VEHICLES = st.from_regex(r"[A-Za-z0-9_-]{1,32}", fullmatch=True)
STREAM = st.sampled_from(STREAMS)
CHUNKS = st.lists(st.from_regex(r"[A-Za-z0-9_.-]{1,8}", fullmatch=True), max_size=3)


@given(VEHICLES, STREAM, CHUNKS)
def test_a_key_is_read_as_it_was_built(vehicle: str, stream: Stream, chunks: list[str]) -> None:
    rest = chunks if stream.keyed else []
    assert parse_key(stream_key(vehicle, stream, *rest)) == Key(vehicle, stream, tuple(rest))


@given(VEHICLES, st.integers(0, 30), st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1))
def test_a_tile_is_found_again_from_its_key(vehicle: str, level: int, x: int, y: int) -> None:
    key = parse_key(tile_key(vehicle, TILE, TileId(level, x, y)))
    assert key.stream is TILE
    assert tuple(map(int, key.rest)) == (level, x, y)


@given(VEHICLES, VEHICLES, STREAM, STREAM, CHUNKS)
def test_a_subscription_to_a_stream_gets_that_stream_and_no_other(
    vehicle: str, other: str, stream: Stream, wrong: Stream, chunks: list[str]
) -> None:
    key = stream_key(vehicle, stream, *(chunks if stream.keyed else []))
    assert intersects(all_of(stream), key)
    assert intersects(all_of(stream, vehicle), key)
    assert intersects("luojia/@v1/**", key)
    assert not intersects("luojia/**", key), "the version chunk is verbatim: a wildcard must not reach it"
    assert intersects(all_of(stream, other), key) == (vehicle == other)
    assert intersects(all_of(wrong), key) == (wrong is stream)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "luojia",
        "luojia/@v1",
        "luojia/@v1/",
        "luojia/@v1//pose",
        "luojia/@v2/uav1/pose",
        "luojia/@v1/uav1",
        "luojia/@v1/uav1/poses",
        "luojia/@v1/uav1/pose/0",
        "luojia/@v1/uav 1/pose",
        "luojia/@v1/*/pose",
        "luojia/@v1/" + "x" * 33 + "/pose",
        "other/@v1/uav1/pose",
        "luojia/@v1/uav1/map",
        "luojia/@v1/uav1/map/tiles/0/0/0",
        "luojia/@v1/uav1/alive/uplink",
    ],
)
def test_a_key_that_is_not_ours_is_refused_by_name(key: str) -> None:
    with pytest.raises(WireError, match="key '"):
        parse_key(key)


@given(st.text(max_size=40))
def test_any_text_is_a_key_or_refused(text: str) -> None:
    for key in (text, f"luojia/@v1/{text}", f"luojia/@v1/uav1/{text}"):
        try:
            parsed = parse_key(key)
        except WireError:
            continue
        assert stream_key(parsed.vehicle, parsed.stream, *parsed.rest) == key


@given(VEHICLES)
def test_a_liveliness_token_is_under_its_vehicle(vehicle: str) -> None:
    assert intersects(f"luojia/@v1/{vehicle}/alive/*", alive_key(vehicle, "uplink"))
