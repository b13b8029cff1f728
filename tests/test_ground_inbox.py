"""The inbox: nothing that arrives can stop it, and everything is counted."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_map import DATUM_HERE, keyframe, pose, small_tile

from common.keys import stream_key, tile_key
from common.messages import TileId
from common.streams import DATUM, KEYFRAME, POSE, STREAMS, TILE
from common.wire import encode
from ground.inbox import Inbox

SECOND = 10**9
TILE_BYTES = encode(small_tile(2, -3))
KEYS = [stream_key("uav1", stream, *(("0",) if stream.keyed else ())) for stream in STREAMS]


@settings(max_examples=200, deadline=None)
@given(
    key=st.sampled_from([*KEYS, "luojia/@v1", "other/key", ""]) | st.text(max_size=40), payload=st.binary(max_size=200)
)
def test_no_bytes_raise(key: str, payload: bytes) -> None:
    inbox = Inbox()
    assert inbox.receive(key, payload, 0) is None
    assert inbox.faults == 1


@settings(max_examples=100, deadline=None)
@given(at=st.integers(0, len(TILE_BYTES) - 1), bit=st.integers(0, 7))
def test_a_flipped_bit_never_raises(at: int, bit: int) -> None:
    damaged = bytearray(TILE_BYTES)
    damaged[at] ^= 1 << bit
    inbox = Inbox()
    received = inbox.receive(tile_key("uav1", TILE, TileId(0, 2, -3)), bytes(damaged), 0)
    assert (received is None) == (inbox.faults == 1)


def test_a_good_message_comes_through_with_its_bytes() -> None:
    received = Inbox().receive(tile_key("uav1", TILE, TileId(0, 2, -3)), TILE_BYTES, 7)
    assert received is not None
    assert (received.vehicle, received.stream, received.arrival_ns) == ("uav1", TILE, 7)
    assert received.payload is TILE_BYTES


def test_a_message_under_the_key_of_another_place_is_refused_by_name() -> None:
    inbox = Inbox()
    assert inbox.receive(tile_key("uav1", TILE, TileId(0, 2, 3)), TILE_BYTES, 0) is None
    count = inbox.streams["uav1", "map/tile"]
    assert (count.messages, count.faults) == (1, 1)
    assert "0/2/3" in count.fault


def test_rate_bytes_and_age_follow_the_arrivals() -> None:
    inbox = Inbox()
    for i in range(200):
        payload = encode(pose(i * SECOND // 10, 0.0, 0.0))
        inbox.receive(stream_key("uav1", POSE), payload, i * SECOND // 10)
    count, now_ns = inbox.streams["uav1", "pose"], 20 * SECOND
    np.testing.assert_allclose(count.rate_hz(now_ns), 10.0, rtol=0.02)
    np.testing.assert_allclose(count.bytes_per_s(now_ns), 10.0 * count.bytes / count.messages, rtol=0.02)
    np.testing.assert_allclose(count.age_s(now_ns), 0.1)
    assert not count.stale(now_ns)
    assert count.stale(now_ns + 2 * SECOND)
    assert count.rate_hz(now_ns + 20 * SECOND) == 0.0


def test_a_pause_longer_than_the_table_allows_is_a_gap() -> None:
    inbox = Inbox()
    for second in (0, 1, 2, 9, 10):
        inbox.receive(stream_key("uav1", DATUM), encode(DATUM_HERE), second * SECOND)
    assert inbox.streams["uav1", "datum"].gaps == 1


def test_keyframes_that_never_came_are_gaps_until_they_come() -> None:
    inbox = Inbox()

    def gaps_after(index: int) -> int:
        inbox.receive(stream_key("uav1", KEYFRAME, index), encode(keyframe(index)), index * SECOND)
        return inbox.streams["uav1", "keyframe"].gaps

    assert [gaps_after(index) for index in (0, 1, 4, 3, 2, 2)] == [0, 0, 2, 1, 0, 0]
