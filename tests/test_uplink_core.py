"""Pacing, tile queue and outbox of the aircraft: what is sent when, and that what is listed is what was sent."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from synthetic_map import DATUM_HERE, FLIGHT, keyframe, small_tile

from air.uplink.outbox import Outbox, Parcel
from air.uplink.pacing import TokenBucket
from air.uplink.tile_queue import SentTile, TileQueue
from common.keys import all_of
from common.messages import Keyframe, MapDigest, MapTile, TileId, TileRequest
from common.streams import DATUM, DIGEST, KEYFRAME, TILE, TILE_REQUEST
from common.wire import decode, encode

PLACES = [TileId(0, x, y) for x in (-1, 0) for y in (0, 1)]
TILES = {(place, r): small_tile(place.x, place.y, r) for place in PLACES for r in range(1, 7)}


# Pacing


class SimulatedTime:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@given(
    st.lists(st.tuples(st.integers(1, 300_000), st.floats(0, 3)), min_size=1, max_size=60),
    st.floats(1_000, 1e7),
    st.floats(1, 600_000),
)
def test_no_interval_carries_more_than_its_rate_and_one_burst(
    sends: list[tuple[int, float]], rate: float, burst: float
) -> None:
    time = SimulatedTime()
    bucket = TokenBucket(rate, burst, time)
    sent: list[tuple[float, int]] = []
    for size, idle_s in sends:
        time.now_s += idle_s
        time.now_s += bucket.take(size)
        sent.append((time.now_s, size))
    for first in range(len(sent)):
        # The bytes of the last message are only just beginning to leave.
        carried = np.cumsum([size for _, size in sent[first:]])[:-1]
        lasted = np.array([t for t, _ in sent[first + 1 :]]) - sent[first][0]
        assert (carried <= burst + rate * lasted + sent[first][1] + 1.0).all()


def test_a_link_that_is_idle_is_not_waited_for_and_a_busy_one_as_long_as_it_is_busy() -> None:
    time = SimulatedTime()
    bucket = TokenBucket(1_000.0, 500.0, time)
    assert bucket.take(500) == 0.0
    assert bucket.take(250) == pytest.approx(0.25)
    assert bucket.take(1_000) == pytest.approx(1.25)
    time.now_s += 3.0
    assert bucket.take(500) == 0.0


# Tile queue


class QueueMachine(RuleBasedStateMachine):
    """Any order of changes, requests and sending against a model: what the aircraft made and what left it."""

    def __init__(self) -> None:
        super().__init__()
        self.queue = TileQueue()
        self.made: dict[TileId, int] = {}
        self.left: dict[TileId, int] = {}
        self.turns: list[TileId] = []

    @rule(place=st.sampled_from(PLACES), step=st.integers(-1, 2))
    def change(self, place: TileId, step: int) -> None:
        revision = min(6, max(1, self.made.get(place, 0) + step))
        self.queue.put(TILES[place, revision])
        if revision > self.made.get(place, 0):
            self.made[place] = revision
            self.turns += [place] if place not in self.turns else []

    @rule(places=st.lists(st.sampled_from(PLACES), unique=True))
    def ask(self, places: list[TileId]) -> None:
        again = [place for place in places if place in self.left and place not in self.turns]
        assert self.queue.ask(places) == len(again)
        self.turns += again

    @rule()
    def send(self) -> None:
        tile = self.queue.pop()
        if not self.turns:
            assert tile is None
            return
        assert tile is not None
        assert (tile.id, tile.revision) == (self.turns[0], self.made[self.turns.pop(0)])
        if isinstance(tile, MapTile):
            assert tile is TILES[tile.id, tile.revision]
            tile = SentTile(tile.id, tile.revision, b"%d" % tile.revision)
        assert tile.payload == b"%d" % tile.revision
        self.queue.note_sent(tile)
        self.left[tile.id] = tile.revision

    @invariant()
    def lists_what_left(self) -> None:
        assert len(self.queue) == len(self.turns)
        digest = self.queue.digest()
        assert digest.dtype == np.int32
        assert digest.tolist() == [[p.level, p.x, p.y, r] for p, r in sorted(self.left.items())]

    def teardown(self) -> None:
        while self.turns:
            self.send()
        assert self.left == self.made


TestTileQueue = QueueMachine.TestCase


# Outbox


@pytest.fixture
def outbox() -> Outbox:
    return Outbox("uav1", FLIGHT)


def drained(outbox: Outbox) -> list[Parcel]:
    return list(iter(outbox.next, None))


def request(*places: TileId, flight: str = FLIGHT) -> TileRequest:
    return TileRequest(flight, np.array([(p.level, p.x, p.y) for p in places], np.int32).reshape(-1, 3))


def test_keyframes_go_before_tiles_and_only_the_newest_revision_of_each(outbox: Outbox) -> None:
    outbox.put_tile(small_tile(0, 0, 1))
    for revision in (1, 2):
        for index in (0, 1):
            outbox.put_keyframe(keyframe(index, revision=revision))
    outbox.put_tile(small_tile(1, 0, 1))
    outbox.put_tile(small_tile(0, 0, 2))
    parcels = drained(outbox)
    assert [p.key.removeprefix("luojia/@v1/uav1/") for p in parcels] == [
        "keyframe/0",
        "keyframe/1",
        "map/tile/0/0/0",
        "map/tile/0/1/0",
    ]
    assert [decode(Keyframe, p.payload).revision for p in parcels[:2]] == [2, 2]
    assert [decode(MapTile, p.payload).revision for p in parcels[2:]] == [2, 1]


def test_a_tile_is_listed_once_it_has_left_and_not_before(outbox: Outbox) -> None:
    outbox.put_tile(small_tile(0, 0, 3))
    assert len(outbox.digest(0).tiles) == 0
    assert outbox.next() is not None
    assert len(outbox.digest(0).tiles) == 0  # in hand: the link may make it wait
    assert outbox.next() is None
    assert outbox.digest(7).tiles.tolist() == [[0, 0, 0, 3]]
    assert outbox.digest(7).t_ns == 7


def test_what_is_asked_for_is_sent_again_byte_for_byte(outbox: Outbox) -> None:
    for place in PLACES:
        outbox.put_tile(small_tile(place.x, place.y))
    first = {p.key: p.payload for p in drained(outbox)}
    assert outbox.ask(request(*PLACES[:2], TileId(3, 9, 9))) == 2
    assert outbox.ask(request(PLACES[2], flight="another")) == 0
    again = drained(outbox)
    assert len(again) == 2
    assert all(first[p.key] == p.payload for p in again)


def test_a_message_that_fits_no_schema_stops_none_of_the_others(
    outbox: Outbox, caplog: pytest.LogCaptureFixture
) -> None:
    bad = small_tile(0, 0)
    bad.sigma[np.isfinite(bad.height)] = -1.0
    outbox.put_tile(bad)
    outbox.put_tile(small_tile(1, 0))
    assert [p.key[-5:] for p in drained(outbox)] == ["0/1/0"]
    assert "sigma" in caplog.text


def test_queries_are_answered_with_what_was_sent(outbox: Outbox) -> None:
    assert outbox.answer(DATUM, all_of(DATUM), b"", 0) == []
    outbox.datum = DATUM_HERE
    for index in (0, 1):
        outbox.put_keyframe(keyframe(index))
    for place in PLACES:
        outbox.put_tile(small_tile(place.x, place.y))
    sent = {p.key: p.payload for p in drained(outbox)}

    def ask(stream, key_expr: str, payload: bytes = b"") -> dict[str, bytes]:  # type: ignore[no-untyped-def]
        parcels = outbox.answer(stream, key_expr, payload, 5)
        assert all(p.stream is stream for p in parcels)
        return {p.key: p.payload for p in parcels}

    assert ask(DATUM, all_of(DATUM)) == {"luojia/@v1/uav1/datum": encode(DATUM_HERE)}
    assert ask(KEYFRAME, all_of(KEYFRAME)) | ask(TILE, all_of(TILE, "uav1")) == sent
    assert list(ask(KEYFRAME, "luojia/@v1/*/keyframe/1")) == ["luojia/@v1/uav1/keyframe/1"]
    assert ask(TILE, all_of(TILE, "uav2")) == {}
    (digest,) = ask(DIGEST, all_of(DIGEST)).values()
    assert decode(MapDigest, digest).tiles.tolist() == [[p.level, p.x, p.y, 1] for p in sorted(PLACES)]

    narrowed = ask(TILE, all_of(TILE), encode(request(PLACES[1])))
    assert list(narrowed) == ["luojia/@v1/uav1/map/tile/0/-1/1"]
    assert ask(TILE, all_of(TILE), encode(request(PLACES[1], flight="another"))) == {}
    assert ask(TILE, all_of(TILE), b"\x93 no request") == {}
    assert TILE_REQUEST.max_bytes >= len(encode(request(*PLACES)))
