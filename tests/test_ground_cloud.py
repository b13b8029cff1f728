"""The cloud: whatever is lost, doubled or reordered, both ends finish with the same map."""

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_map import DATUM_HERE, FLIGHT, keyframe, small_tile

from common.messages import MapTile, TileId
from common.wire import encode
from ground.cloud import Cloud, FlightId
from ground.resync import Resync

UAV1 = FlightId("uav1", FLIGHT)
REVISIONS = {
    (x, revision): (tile := small_tile(x, 0, revision), encode(tile)) for x in range(5) for revision in range(1, 4)
}


def held(cloud: Cloud) -> dict[TileId, tuple[int, bytes]]:
    return {tile.id: (tile.revision, tile.payload) for tile in cloud.tiles(UAV1)}


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), loss=st.floats(0.0, 1.0))
def test_any_order_repetition_and_loss_end_in_the_same_map(seed: int, loss: float) -> None:
    rng = random.Random(seed)
    aircraft, ground = Cloud(), Cloud()
    messages = list(REVISIONS.values())
    for tile, payload in messages:
        aircraft.add("uav1", tile, payload)
    heard = [m for m in messages + rng.choices(messages, k=10) if rng.random() >= loss]
    rng.shuffle(heard)
    for tile, payload in heard:
        ground.add("uav1", tile, payload)

    for _ in range(1000):
        request = ground.missing("uav1", aircraft.digest(UAV1))
        if request is None:
            break
        for level, x, y in request.tiles.tolist():
            answer = aircraft.tile(UAV1, TileId(level, x, y))
            assert answer is not None
            if rng.random() >= loss * 0.9:
                ground.add("uav1", answer.decoded(), answer.payload)

    assert held(ground) == held(aircraft)
    assert {tile.revision for tile in ground.tiles()} == {3}
    np.testing.assert_array_equal(ground.digest(UAV1).tiles, aircraft.digest(UAV1).tiles)


def test_an_equal_or_older_revision_is_ignored() -> None:
    cloud = Cloud()
    assert cloud.add("uav1", *REVISIONS[0, 2])
    assert not cloud.add("uav1", *REVISIONS[0, 2])
    assert not cloud.add("uav1", *REVISIONS[0, 1])
    assert cloud.add("uav1", *REVISIONS[0, 3])
    assert cloud.payload_bytes == len(REVISIONS[0, 3][1])


def test_vehicles_and_flights_do_not_mix() -> None:
    cloud = Cloud()
    later = small_tile(0, 0, 1, flight="2024-06-01T08:00:00Z")
    cloud.add("uav1", *REVISIONS[0, 3])
    assert cloud.add("uav2", *REVISIONS[0, 1])
    assert cloud.add("uav1", later, encode(later))
    assert len(cloud.flights()) == 3
    assert [tile.revision for tile in cloud.tiles(UAV1)] == [3]
    assert cloud.missing("uav3", cloud.digest(UAV1)) is not None


def test_the_newest_revision_of_a_keyframe_wins() -> None:
    cloud = Cloud()
    new, old = keyframe(4, 1.0, revision=7), keyframe(4, 2.0, revision=3)
    assert cloud.add_keyframe("uav1", new, encode(new))
    assert not cloud.add_keyframe("uav1", old, encode(old))
    assert [kept.keyframe.revision for kept in cloud.keyframes(UAV1)] == [7]


def test_a_repeated_datum_is_no_news() -> None:
    cloud = Cloud()
    assert cloud.add_datum("uav1", DATUM_HERE, encode(DATUM_HERE))
    assert not cloud.add_datum("uav1", DATUM_HERE, encode(DATUM_HERE))


def test_a_record_tells_of_its_tile_without_decoding_it() -> None:
    tile = small_tile(0, 0)
    cloud = Cloud(min_views=3)
    record = cloud.add("uav1", tile, encode(tile))
    known = np.isfinite(tile.height)
    assert record is not None
    assert record.known == known.sum()
    assert record.confident == (known & ~tile.disputed & (tile.views >= 3)).sum()
    assert record.z_low <= np.median(tile.height[known]) <= record.z_high
    decoded = record.decoded()
    assert isinstance(decoded, MapTile)
    np.testing.assert_allclose(decoded.height[known], tile.height[known], atol=0.02)


def test_a_missing_tile_is_asked_for_at_once_then_ever_more_rarely() -> None:
    aircraft, ground, resync = Cloud(), Cloud(), Resync()
    aircraft.add("uav1", *REVISIONS[0, 1])
    asked = []
    for second in range(70):
        request = ground.missing("uav1", aircraft.digest(UAV1))
        if resync.due("uav1", request, FLIGHT, second * 10**9):
            asked.append(second)
    assert asked == [0, 2, 6, 14, 30, 62]


@pytest.mark.parametrize("arrives", [True, False])
def test_a_tile_that_arrived_may_be_asked_for_at_once_when_it_changes(arrives: bool) -> None:
    aircraft, ground, resync = Cloud(), Cloud(), Resync()
    aircraft.add("uav1", *REVISIONS[0, 1])
    assert resync.due("uav1", ground.missing("uav1", aircraft.digest(UAV1)), FLIGHT, 0)
    if arrives:
        ground.add("uav1", *REVISIONS[0, 1])
    resync.due("uav1", ground.missing("uav1", aircraft.digest(UAV1)), FLIGHT, 10**9 // 2)
    aircraft.add("uav1", *REVISIONS[0, 2])
    again = resync.due("uav1", ground.missing("uav1", aircraft.digest(UAV1)), FLIGHT, 10**9)
    assert (again is not None) == arrives
