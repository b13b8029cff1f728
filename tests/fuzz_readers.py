"""The readers of outside bytes that are fuzzed. To add one: a function of bytes, and what it usually reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from conftest import DATA

from air.sensors.driver import Driver


@dataclass(frozen=True)
class Reader:
    """`read` takes any bytes and returns; `seeds` gives what it usually reads, at least one, a few thousand bytes each.

    `read` may raise what it says it raises only if it catches that itself: here every exception is a failure.
    """

    name: str
    read: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]


def recorded(name: str, *parts: tuple[int, int]) -> list[bytes]:
    """Parts (first byte, length) of a real recording, none where it is not beside this checkout."""
    path = DATA / name
    if not path.exists():
        return []
    with path.open("rb") as file:
        out = []
        for first, length in parts:
            file.seek(first)
            out.append(file.read(length))
        return out


def of_driver(name: str, driver: Callable[[], Driver], seeds: Callable[[], list[bytes]]) -> Reader:
    """Feeds a new driver in pieces; it must account for every byte and hold no more than it was given."""

    def read(data: bytes) -> None:
        it, at, step = driver(), 0, 1 + len(data) % 997
        while at < len(data):
            it.feed(data[at : at + step], 0)
            at += step
        assert it.counts.received_bytes == len(data)
        assert 0 <= it.counts.dropped_bytes <= len(data)

    return Reader(name, read, seeds)


_ALL: tuple[Reader, ...] = ()

READERS = {reader.name: reader for reader in _ALL}
