"""What only a network can do: be absent, restart, die, be in use, and carry a quality of service."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest
import zenoh
from bus_network import K, client_of, collect, free_endpoint, peer_of, router_at, settle, wait_until

from common.bus import Bus, BusConfig, ZenohBus
from common.errors import BusError
from common.streams import POSE, STREAMS, TILE, TILE_REQUEST, Priority


def test_a_query_ends_with_its_timeout_or_with_the_bus() -> None:
    endpoint = free_endpoint()
    gateway, station = router_at(endpoint), client_of(endpoint)
    release = threading.Event()

    def hangs(key_expr: str, payload: bytes) -> Iterator[tuple[str, bytes]]:
        yield f"{K}/datum", b"first"
        release.wait(20.0)

    gateway.serve(f"{K}/datum", hangs)
    settle(gateway, station)
    start = time.monotonic()
    assert list(station.query(f"{K}/datum", timeout_s=0.5)) == [(f"{K}/datum", b"first")]
    assert 0.4 < time.monotonic() - start < 2.0
    waiting = iter(station.query(f"{K}/datum", timeout_s=30.0))
    threading.Timer(0.2, station.close).start()
    start = time.monotonic()
    assert list(waiting) == []
    assert time.monotonic() - start < 3.0
    release.set()
    gateway.close()


def test_a_peer_starts_without_its_router_and_finds_it_again_after_a_restart() -> None:
    endpoint = free_endpoint()
    air = peer_of(endpoint)
    seen: list[tuple[str, bool]] = []
    try:
        requests, _ = collect(air, f"{K}/cmd/tiles")
        air.declare_alive(f"{K}/alive/uplink")
        for round_ in range(2):
            gateway = router_at(endpoint)
            poses, _ = collect(gateway, f"{K}/pose")
            seen.clear()
            gateway.watch_alive(f"{K}/alive/*", lambda key, alive: seen.append((key, alive)))
            wait_until(lambda: seen, timeout_s=15.0)
            air.publish(f"{K}/pose", b"%d" % round_, POSE)
            gateway.publish(f"{K}/cmd/tiles", b"%d" % round_, TILE_REQUEST)
            wait_until(lambda r=round_, got=poses: got and len(requests) == r + 1)  # type: ignore[misc]
            gateway.close()
    finally:
        air.close()


def test_a_station_finds_its_router_again_after_a_restart() -> None:
    endpoint = free_endpoint()
    gateway = router_at(endpoint)
    station = client_of(endpoint)
    try:
        got, _ = collect(station, f"{K}/pose")
        gateway.close()
        gateway = router_at(endpoint)
        deadline = time.monotonic() + 15.0
        while not got and time.monotonic() < deadline:
            gateway.publish(f"{K}/pose", b"1", POSE)
            time.sleep(0.1)
        assert got
    finally:
        station.close()
        gateway.close()


def test_a_router_whose_port_is_taken_names_the_endpoint() -> None:
    endpoint = free_endpoint()
    first = router_at(endpoint)
    with pytest.raises(BusError, match=f"cannot open the bus as router listening on {endpoint}.*in use"):
        router_at(endpoint)
    first.close()


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:1", "nonsense"])
def test_a_client_without_its_router_names_the_endpoint(endpoint: str) -> None:
    with pytest.raises(BusError, match=f"as client connecting to {endpoint}"):
        client_of(endpoint)


FROZEN_ROUTER = """
import sys, time
from common.bus import BusConfig, ZenohBus
bus = ZenohBus(BusConfig("router", listen=(sys.argv[1],), shared_memory=False))
bus.subscribe("luojia/@v1/**", lambda key, payload: None)
print("ready", flush=True)
time.sleep(60)
"""


def test_closing_on_a_dead_link_takes_less_than_two_seconds() -> None:
    endpoint = free_endpoint()
    router = subprocess.Popen([sys.executable, "-c", FROZEN_ROUTER, endpoint], stdout=subprocess.PIPE)
    try:
        assert router.stdout is not None
        assert router.stdout.readline() == b"ready\n"
        air = peer_of(endpoint)
        settle(air)
        time.sleep(0.3)
        router.send_signal(signal.SIGSTOP)
        start = time.monotonic()
        for _ in range(100):
            air.publish(f"{K}/pose", bytes(100_000), POSE)
        assert time.monotonic() - start < 2.0, "a stream that drops must not wait for the link"
        blocked = threading.Thread(target=lambda: publish_until_closed(air), daemon=True)
        blocked.start()
        start = time.monotonic()
        air.close()
        assert time.monotonic() - start < 2.0
    finally:
        router.kill()
        router.wait()


LEFT_OPEN = """
import sys
from common.bus import BusConfig, ZenohBus
bus = ZenohBus(BusConfig("router", listen=(sys.argv[1],), shared_memory=False))
bus.subscribe("luojia/@v1/**", lambda key, payload: None)
bus.serve("luojia/@v1/**", lambda key, payload: [])
raise SystemExit(7)
"""


def test_a_program_that_fails_without_closing_the_bus_still_ends() -> None:
    done = subprocess.run([sys.executable, "-c", LEFT_OPEN, free_endpoint()], timeout=20, check=False)
    assert done.returncode == 7


def publish_until_closed(bus: Bus) -> None:
    try:
        for _ in range(10):
            bus.publish(f"{K}/map/tile/0/0/0", bytes(200_000), TILE)
    except BusError:
        return


def test_the_row_of_the_table_decides_the_quality_of_service() -> None:
    endpoint = free_endpoint()
    air = ZenohBus(BusConfig("peer", listen=(endpoint,), shared_memory=False))
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        got: dict[str, zenoh.Sample] = {}
        session.declare_subscriber("luojia/@v1/**", lambda sample: got.update({str(sample.key_expr): sample}))
        settle(air)
        deadline = time.monotonic() + 10.0
        while len(got) < len(STREAMS) and time.monotonic() < deadline:
            for stream in STREAMS:
                air.publish(f"{K}/{stream.name}", b"", stream)
            time.sleep(0.05)
        for stream in STREAMS:
            sample = got[f"{K}/{stream.name}"]
            assert str(sample.priority).split(".")[-1] == stream.priority.name
            assert str(sample.congestion_control).split(".")[-1] == stream.congestion.name
            assert sample.express == stream.express
    air.close()
    assert len({stream.priority for stream in STREAMS} & set(Priority)) >= 3
