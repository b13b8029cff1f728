"""Buses on loopback for the tests, and ways to wait for what a network does in its own time."""

from __future__ import annotations

import itertools
import socket
import time
from collections.abc import Callable
from typing import Any

from common.bus import Bus, BusConfig, Subscription, ZenohBus

K = "luojia/@v1/uav1"
Got = list[tuple[str, bytes]]
_count = itertools.count()


def free_endpoint() -> str:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{s.getsockname()[1]}"


def router_at(endpoint: str) -> ZenohBus:
    return ZenohBus(BusConfig("router", listen=(endpoint,), shared_memory=False))


def peer_of(endpoint: str) -> ZenohBus:
    return ZenohBus(BusConfig("peer", connect=(endpoint,), shared_memory=False))


def client_of(endpoint: str) -> ZenohBus:
    return ZenohBus(BusConfig("client", connect=(endpoint,), shared_memory=False))


def wait_until(condition: Callable[[], Any], timeout_s: float = 10.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.005)


def settle(*buses: Bus) -> None:
    """Return when what each bus declared has reached the others: declarations travel in order, a token comes last."""
    keys = {f"settle/{next(_count)}" for _ in buses}
    tokens = [bus.declare_alive(key) for bus, key in zip(buses, keys, strict=True)]
    seen: list[set[str]] = [set() for _ in buses]
    watchers = [
        bus.watch_alive("settle/*", lambda key, alive, mine=mine: mine.add(key))  # type: ignore[misc]
        for bus, mine in zip(buses, seen, strict=True)
    ]
    wait_until(lambda: all(keys <= mine for mine in seen))
    for part in (*tokens, *watchers):
        part.close()


def collect(bus: Bus, key_expr: str) -> tuple[Got, Subscription]:
    got: Got = []
    return got, bus.subscribe(key_expr, lambda key, payload: got.append((key, payload)))
