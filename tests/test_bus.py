"""One contract for both buses: the real Zenoh session (router, clients, peer on loopback) and the one in memory."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol

import pytest
import zenoh
from bus_network import K, client_of, collect, free_endpoint, peer_of, router_at, settle, wait_until
from hypothesis import given
from hypothesis import strategies as st

from common.bus import Bus
from common.bus_memory import MemoryBroker, MemoryBus, intersects
from common.errors import BusError
from common.streams import POSE, TILE, TILE_REQUEST


class Network(Protocol):
    """An aircraft, a gateway and a station, connected as in the field."""

    air: Bus
    gateway: Bus
    station: Bus


class MemoryNetwork:
    def __init__(self) -> None:
        broker = MemoryBroker()
        self.air, self.gateway, self.station = MemoryBus(broker), MemoryBus(broker), MemoryBus(broker)


class ZenohNetwork:
    def __init__(self) -> None:
        endpoint = free_endpoint()
        self.gateway = router_at(endpoint)
        self.air = peer_of(endpoint)
        self.station = client_of(endpoint)
        settle(self.air, self.gateway, self.station)


@pytest.fixture(params=[MemoryNetwork, ZenohNetwork], ids=["memory", "zenoh"])
def net(request: pytest.FixtureRequest) -> Iterator[Network]:
    network: Network = request.param()
    yield network
    for bus in (network.air, network.station, network.gateway):
        bus.close()


def test_every_subscriber_gets_what_matches_once(net: Network) -> None:
    everything, _ = collect(net.gateway, "luojia/@v1/**")
    tiles, _ = collect(net.station, "luojia/@v1/*/map/tile/**")
    other, _ = collect(net.station, "luojia/@v1/uav2/**")
    unversioned, _ = collect(net.station, "luojia/**")
    settle(net.air, net.gateway, net.station)
    sent = [(f"{K}/map/tile/0/3/-2", b"tile"), (f"{K}/pose", b""), (f"{K}/map/tile/0/3/-1", bytes(range(256)))]
    for key, payload in sent:
        net.air.publish(key, payload, TILE)
    wait_until(lambda: len(everything) >= 3 and len(tiles) >= 2)
    assert everything == sent
    assert tiles == [sent[0], sent[2]]
    assert other == unversioned == []


def test_a_request_from_a_station_reaches_the_aircraft(net: Network) -> None:
    got, _ = collect(net.air, f"{K}/cmd/tiles")
    settle(net.air, net.station, net.gateway)
    net.station.publish(f"{K}/cmd/tiles", b"again", TILE_REQUEST)
    net.gateway.publish(f"{K}/cmd/tiles", b"and again", TILE_REQUEST)
    wait_until(lambda: len(got) == 2)
    assert {payload for _, payload in got} == {b"again", b"and again"}


def test_a_late_subscriber_gets_only_what_comes_later(net: Network) -> None:
    early, _ = collect(net.gateway, f"{K}/**")
    settle(net.air, net.gateway)
    net.air.publish(f"{K}/pose", b"1", POSE)
    wait_until(lambda: early)
    late, _ = collect(net.station, f"{K}/**")
    settle(net.air, net.station)
    net.air.publish(f"{K}/pose", b"2", POSE)
    wait_until(lambda: len(early) == 2 and late)
    assert late == [(f"{K}/pose", b"2")]


def test_a_closed_subscription_gets_nothing_more(net: Network) -> None:
    kept, _ = collect(net.gateway, f"{K}/pose")
    closed, subscription = collect(net.gateway, f"{K}/pose")
    settle(net.air, net.gateway)
    subscription.close()
    subscription.close()
    net.air.publish(f"{K}/pose", b"1", POSE)
    wait_until(lambda: kept)
    assert closed == []


def test_messages_of_a_stream_arrive_in_order(net: Network) -> None:
    got, _ = collect(net.station, f"{K}/map/tile/**")
    settle(net.air, net.station)
    for i in range(500):
        net.air.publish(f"{K}/map/tile/0/0/{i % 7}", str(i).encode(), TILE)
    wait_until(lambda: len(got) == 500)
    assert [int(payload) for _, payload in got] == list(range(500))


def test_a_handler_that_fails_is_logged_and_stops_nothing(net: Network, caplog: pytest.LogCaptureFixture) -> None:
    def fail(key: str, payload: bytes) -> None:
        raise RuntimeError("handler broke")

    net.gateway.subscribe(f"{K}/pose", fail)
    got, _ = collect(net.gateway, f"{K}/pose")
    settle(net.air, net.gateway)
    net.air.publish(f"{K}/pose", b"1", POSE)
    net.air.publish(f"{K}/pose", b"2", POSE)
    wait_until(lambda: len(got) == 2 and caplog.text.count("handler broke") >= 2)


def test_a_handler_may_publish(net: Network) -> None:
    net.gateway.subscribe(f"{K}/map/digest", lambda key, payload: net.gateway.publish(f"{K}/cmd/tiles", payload, POSE))
    got, _ = collect(net.air, f"{K}/cmd/tiles")
    settle(net.air, net.gateway)
    net.air.publish(f"{K}/map/digest", b"all", POSE)
    wait_until(lambda: got == [(f"{K}/cmd/tiles", b"all")])


def test_a_query_collects_every_reply_of_every_server(net: Network) -> None:
    """More replies than Zenoh's own channel holds, two of them under the same key."""

    def tiles(who: str) -> Callable[[str, bytes], Iterable[tuple[str, bytes]]]:
        def server(key_expr: str, payload: bytes) -> Iterable[tuple[str, bytes]]:
            assert payload == b"since 5"
            return ((f"{K}/map/tile/0/0/{i}", f"{who}{i}".encode()) for i in range(400))

        return server

    net.gateway.serve("luojia/@v1/*/map/tile/**", tiles("g"))
    net.station.serve(f"{K}/map/**", tiles("s"))
    net.station.serve("luojia/@v1/uav2/**", tiles("x"))
    settle(net.air, net.gateway, net.station)
    replies = list(net.station.query(f"{K}/map/tile/**", b"since 5"))
    expected = [(f"{K}/map/tile/0/0/{i}", f"{who}{i}".encode()) for who in "gs" for i in range(400)]
    assert sorted(replies) == sorted(expected)


def test_a_query_without_a_server_ends_at_once(net: Network) -> None:
    start = time.monotonic()
    assert list(net.station.query(f"{K}/map/tile/**", timeout_s=5.0)) == []
    assert time.monotonic() - start < 2.0


def test_a_server_that_fails_loses_only_its_own_replies(net: Network, caplog: pytest.LogCaptureFixture) -> None:
    def fails_half_way(key_expr: str, payload: bytes) -> Iterator[tuple[str, bytes]]:
        yield f"{K}/datum", b"first"
        raise RuntimeError("server broke")

    net.gateway.serve(f"{K}/datum", fails_half_way)
    net.gateway.serve(f"{K}/datum", lambda key, payload: [("elsewhere", b"unasked"), (f"{K}/datum", b"good")])
    settle(net.gateway, net.station)
    replies = {payload for _, payload in net.station.query(f"{K}/datum")}
    assert replies == {b"first", b"good"}
    wait_until(lambda: "server broke" in caplog.text)


def test_a_watcher_learns_who_is_there_appears_and_vanishes(net: Network) -> None:
    seen: list[tuple[str, bool]] = []
    uplink, mapper = f"{K}/alive/uplink", f"{K}/alive/mapper"
    net.air.declare_alive(uplink)
    settle(net.air, net.station)
    net.station.watch_alive(f"{K}/alive/*", lambda key, alive: seen.append((key, alive)))
    wait_until(lambda: seen == [(uplink, True)])
    token = net.air.declare_alive(mapper)
    wait_until(lambda: seen[1:] == [(mapper, True)])
    token.close()
    wait_until(lambda: seen[2:] == [(mapper, False)])
    net.air.close()
    wait_until(lambda: seen[3:] == [(uplink, False)])


def test_a_closed_bus_says_so_and_closes_again(net: Network) -> None:
    net.station.close()
    net.station.close()
    with pytest.raises(BusError, match="closed"):
        net.station.publish(f"{K}/pose", b"", POSE)
    with pytest.raises(BusError, match="closed"):
        net.station.subscribe(f"{K}/pose", lambda key, payload: None)
    with pytest.raises(BusError, match="closed"):
        net.station.query(f"{K}/pose")


def test_a_malformed_key_is_refused_by_name(net: Network) -> None:
    for key in ("", "a//b", "/a", "a/", "a/#", "a/b*"):
        for send in (
            lambda k: net.air.subscribe(k, lambda key, payload: None),
            lambda k: net.air.serve(k, lambda key, payload: []),
            lambda k: net.air.watch_alive(k, lambda key, alive: None),
            lambda k: net.air.publish(k, b"", POSE),
            lambda k: net.air.query(k),
        ):
            with pytest.raises(BusError, match=f"^'{re.escape(key)}'"):
                send(key)


def test_publishing_under_many_keys_at_once_is_refused(net: Network) -> None:
    with pytest.raises(BusError, match="stands for many keys"):
        net.air.publish(f"{K}/*", b"", POSE)
    with pytest.raises(BusError, match="stands for many keys"):
        net.air.declare_alive(f"{K}/alive/**")


def test_streams_flow_fast_enough(net: Network) -> None:
    """Ten times the pose rate and the tile rate of a flight, side by side, nothing lost on a free link."""
    poses, _ = collect(net.gateway, f"{K}/pose")
    tiles, _ = collect(net.station, f"{K}/map/tile/**")
    settle(net.air, net.gateway, net.station)
    start = time.monotonic()
    tile = bytes(100_000)
    for i in range(200):
        net.air.publish(f"{K}/map/tile/0/0/{i}", tile, TILE)
        for _ in range(10):
            net.air.publish(f"{K}/pose", b"p" * 216, TILE_REQUEST)
    wait_until(lambda: len(tiles) == 200 and len(poses) == 2000)
    assert time.monotonic() - start < 5.0


CHUNK = st.sampled_from(["a", "b", "*", "**", "@v1", "@v2"])


@given(st.lists(CHUNK, min_size=1, max_size=5), st.lists(CHUNK, min_size=1, max_size=5))
def test_the_bus_in_memory_matches_keys_as_zenoh_does(a: list[str], b: list[str]) -> None:
    left, right = (zenoh.KeyExpr.autocanonize("/".join(chunks)) for chunks in (a, b))
    assert intersects(str(left), str(right)) == left.intersects(right)
