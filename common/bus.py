"""The bus: publish, subscribe, serve and query by key, over a Zenoh session or inside one process."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Protocol

from common.streams import Stream

Handler = Callable[[str, bytes], None]
Server = Callable[[str, bytes], Iterable[tuple[str, bytes]]]


class Subscription(Protocol):
    """Something that stops when closed: a subscriber, a queryable, a liveliness token."""

    def close(self) -> None:
        """Stop; nothing is delivered afterwards."""
        ...


class Bus(Protocol):
    """What nodes need of a transport. Handlers run on the transport's thread: hand over and return."""

    def publish(self, key: str, payload: bytes, stream: Stream) -> None:
        """Send bytes under a key with the quality of service of the stream."""
        ...

    def subscribe(self, key_expr: str, handler: Handler) -> Subscription:
        """Call `handler(key, payload)` for each message that matches."""
        ...

    def serve(self, key_expr: str, server: Server) -> Subscription:
        """Answer queries that match: `server(key_expr, payload)` gives the replies as (key, payload)."""
        ...

    def query(
        self, key_expr: str, payload: bytes = b"", timeout_s: float = 5.0
    ) -> Iterable[tuple[str, bytes]]:
        """All replies (key, payload) that arrive within the timeout."""
        ...

    def declare_alive(self, key: str) -> Subscription:
        """Hold a liveliness token under a key until closed."""
        ...

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Subscription:
        """Call `handler(key, alive)` for tokens that exist, appear and vanish."""
        ...

    def close(self) -> None:
        """Close the transport; returns within two seconds even when the link is dead."""
        ...
