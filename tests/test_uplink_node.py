"""The uplink as a node between a map and a ground station: nothing is lost, nothing is sent twice without need."""

import time
from collections.abc import Callable, Iterator

import pytest
from bus_network import wait_until
from synthetic_map import DATUM_HERE, FLIGHT, keyframe, pose, site_tile, small_tile

from air.config import UplinkConfig
from air.uplink.uplink import BURST_BYTES, Uplink
from common.bus_memory import MemoryBroker, MemoryBus
from common.keys import all_of
from common.messages import Level, MapTile
from common.streams import TILE
from common.wire import decode
from ground.gateway import Gateway
from ground.station import Station

FAST = UplinkConfig(1e9)


class LossyBus(MemoryBus):
    """Loses the first messages of the stream of tiles."""

    lose = 0

    def publish(self, key, payload, stream) -> None:  # type: ignore[no-untyped-def]
        if stream is TILE and self.lose > 0:
            self.lose -= 1
            return
        super().publish(key, payload, stream)


@pytest.fixture
def broker() -> MemoryBroker:
    return MemoryBroker()


@pytest.fixture
def start(broker: MemoryBroker) -> Iterator[Callable[..., Uplink]]:
    """Starts uplinks, and stops them at the end."""
    running: list[Uplink] = []

    def start_one(lose: int = 0, config: UplinkConfig = FAST) -> Uplink:
        bus = LossyBus(broker)
        bus.lose = lose
        uplink = Uplink(bus, "uav1", FLIGHT, config, lambda: 0)
        uplink.start()
        running.append(uplink)
        return uplink

    yield start_one
    for uplink in running:
        uplink.close()


@pytest.fixture
def ground(broker: MemoryBroker) -> Iterator[Gateway]:
    gateway = Gateway(MemoryBus(broker), Station("ground"), None, lambda: 0)
    gateway.start()
    yield gateway
    gateway.close()


def held(ground: Gateway) -> list[tuple[int, int, int]]:
    return sorted((t.id.x, t.id.y, t.revision) for t in ground.scene().tiles)


def test_lost_tiles_are_sent_again_and_the_others_once(
    start: Callable[..., Uplink], ground: Gateway, broker: MemoryBroker
) -> None:
    tiles: list[str] = []
    MemoryBus(broker).subscribe(all_of(TILE), lambda key, _: tiles.append(key))
    uplink = start(lose=3)
    uplink.send([], [small_tile(x, 0) for x in range(8)])
    wait_until(lambda: held(ground) == [(x, 0, 1) for x in range(8)])
    time.sleep(1.2)
    assert len(tiles) == 8


def test_a_ground_that_joins_late_gets_everything(start: Callable[..., Uplink], broker: MemoryBroker) -> None:
    uplink = start()
    uplink.say(DATUM_HERE, Level.OK, "18 read, 18 placed", {"placed": 18})
    uplink.send([keyframe(0), keyframe(1, revision=2)], [small_tile(x, 0, x + 1) for x in range(4)])
    uplink.send_pose(pose(10**9, 1.0, 2.0))
    wait_until(lambda: uplink.waiting == 0)
    late = Gateway(MemoryBus(broker), Station("late"), None, lambda: 0)
    late.start()
    wait_until(lambda: held(late) == [(x, 0, x + 1) for x in range(4)])
    wait_until(lambda: [(k.keyframe.index, k.keyframe.revision) for k in late.scene().keyframes] == [(0, 1), (1, 2)])
    wait_until(lambda: [row.text for row in late.scene().health if row.role == "mapper"] == ["18 read, 18 placed"])
    assert late.scene().origin == DATUM_HERE
    late.close()


def test_the_link_is_given_no_more_than_its_rate(start: Callable[..., Uplink], broker: MemoryBroker) -> None:
    sizes: list[int] = []
    times_s: list[float] = []

    def note(_key: str, payload: bytes) -> None:
        sizes.append(len(payload))
        times_s.append(time.monotonic())

    MemoryBus(broker).subscribe(all_of(TILE), note)
    uplink = start(config=UplinkConfig(200_000.0))
    uplink.send([], [site_tile(x, y, n=128, cell=0.2) for x in range(-2, 2) for y in range(-2, 2)])
    wait_until(lambda: len(sizes) == 16)
    over = sum(sizes) - BURST_BYTES
    assert over > 50_000
    assert times_s[-1] - times_s[0] >= over / 200_000.0 - 0.05


def test_a_change_while_the_link_is_busy_skips_the_older_revision(
    start: Callable[..., Uplink], broker: MemoryBroker
) -> None:
    revisions: list[int] = []
    MemoryBus(broker).subscribe(all_of(TILE), lambda _, payload: revisions.append(decode(MapTile, payload).revision))
    told: list[int] = []
    uplink = start()
    uplink.send([], [small_tile(x, 0) for x in range(30)] + [small_tile(99, 0, r) for r in range(1, 6)])
    uplink.send([], [], lambda: told.append(len(revisions)))
    wait_until(lambda: bool(told))
    assert told == [31]
    assert revisions[-1] == 5


def test_a_bad_request_changes_nothing(start: Callable[..., Uplink], broker: MemoryBroker, ground: Gateway) -> None:
    uplink = start()
    MemoryBus(broker).publish("luojia/@v1/uav1/cmd/tiles", b"\xc1", TILE)
    uplink.send([], [small_tile(0, 0)])
    wait_until(lambda: held(ground) == [(0, 0, 1)])


def test_it_closes_at_once(start: Callable[..., Uplink]) -> None:
    uplink = start(config=UplinkConfig(1_000.0))
    uplink.send([], [small_tile(x, y) for x in range(20) for y in range(20)])
    begun_s = time.monotonic()
    uplink.close()
    assert time.monotonic() - begun_s < 1.0
