"""A bus inside one process, with the semantics of the real one: for tests, and for aircraft and ground in one program.

Delivery is synchronous: `publish` returns when every handler has returned.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from common.bus import Handler, Server, Subscription, check_key
from common.errors import BusError
from common.streams import Stream

log = logging.getLogger(__name__)


def intersects(a: str, b: str) -> bool:
    """Whether a key exists that both key expressions match.

    `*` stands for one chunk, `**` for any number of chunks, neither for a chunk that begins with `@` (Zenoh,
    RFC "Key Expressions"). Raises BusError for a malformed expression.
    """
    return _intersects(_chunks(a), _chunks(b))


def _chunks(key_expr: str) -> list[str]:
    """The chunks of a key expression. Raises BusError for a malformed one."""
    chunks = key_expr.split("/")
    for chunk in chunks:
        if chunk not in ("*", "**") and (not chunk or set(chunk) & set("*$#?")):
            raise BusError(f"{key_expr!r} is no key expression: chunk {chunk!r} is not allowed")
    return chunks


def _intersects(a: list[str], b: list[str]) -> bool:
    if not a or not b:
        return all(chunk == "**" for chunk in a + b)
    if a[0] == "**":
        return _intersects(a[1:], b) or (not b[0].startswith("@") and _intersects(a, b[1:]))
    if b[0] == "**":
        return _intersects(b, a)
    same = a[0] == b[0] or ("*" in (a[0], b[0]) and not (a[0] + b[0]).strip("*").startswith("@"))
    return same and _intersects(a[1:], b[1:])


@dataclass(eq=False)
class _Entry:
    """Something declared on the broker: its key expression, what it calls, and whose it is."""

    key_expr: str
    call: Callable[..., Any]
    broker: MemoryBroker

    def close(self) -> None:
        """Withdraw it."""
        self.broker.withdraw(self)


@dataclass(eq=False)
class MemoryBroker:
    """The medium that several `MemoryBus` clients share."""

    subscribers: list[_Entry] = field(default_factory=list)
    servers: list[_Entry] = field(default_factory=list)
    watchers: list[_Entry] = field(default_factory=list)
    tokens: list[_Entry] = field(default_factory=list)

    def withdraw(self, entry: _Entry) -> None:
        """Forget an entry; watchers learn when it was the last liveliness token of its key."""
        for entries in (self.subscribers, self.servers, self.watchers):
            if entry in entries:
                entries.remove(entry)
        if entry in self.tokens:
            self.tokens.remove(entry)
            if not any(token.key_expr == entry.key_expr for token in self.tokens):
                deliver(self.watchers, entry.key_expr, False)


def deliver(entries: list[_Entry], key: str, what: Any) -> None:
    """Call every entry that matches a key; what a handler raises is logged. Raises BusError for a malformed key."""
    _chunks(key)
    for entry in list(entries):
        if intersects(entry.key_expr, key):
            call_safely(entry.call, key, what)


def call_safely(handler: Callable[[str, Any], object], key: str, what: Any) -> None:
    """Call a handler; log what it raises."""
    try:
        handler(key, what)
    except Exception:
        log.exception("the handler of %s failed", key)


class MemoryBus:
    """A client of a `MemoryBroker`; implements `Bus`."""

    def __init__(self, broker: MemoryBroker) -> None:
        self._broker = broker
        self._mine: list[_Entry] = []
        self._closed = False

    def publish(self, key: str, payload: bytes, stream: Stream) -> None:
        """Deliver a payload to every subscriber of the key, at once."""
        self._check_open()
        check_key(key)
        deliver(self._broker.subscribers, key, bytes(payload))

    def subscribe(self, key_expr: str, handler: Handler) -> Subscription:
        """Call `handler(key, payload)` for each message that matches, in the publisher's thread."""
        return self._declare(self._broker.subscribers, key_expr, handler)

    def serve(self, key_expr: str, server: Server) -> Subscription:
        """Answer queries that intersect the key expression."""
        return self._declare(self._broker.servers, key_expr, server)

    def query(self, key_expr: str, payload: bytes = b"", timeout_s: float = 5.0) -> Iterable[tuple[str, bytes]]:
        """All replies (key, payload); a server's exception is logged and ends its replies."""
        self._check_open()
        _chunks(key_expr)
        replies: list[tuple[str, bytes]] = []
        for entry in list(self._broker.servers):
            if intersects(entry.key_expr, key_expr):
                try:
                    replies.extend((key, reply) for key, reply in entry.call(key_expr, bytes(payload)))
                except Exception:
                    log.exception("the server of %s failed", entry.key_expr)
        return [(key, reply) for key, reply in replies if intersects(key_expr, key)]

    def declare_alive(self, key: str) -> Subscription:
        """Hold a liveliness token; watchers of its key learn at once."""
        check_key(key)
        known = any(token.key_expr == key for token in self._broker.tokens)
        token = self._declare(self._broker.tokens, key, lambda: None)
        if not known:
            deliver(self._broker.watchers, key, True)
        return token

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Subscription:
        """Call `handler(key, alive)` for tokens that exist, appear and vanish."""
        watcher = self._declare(self._broker.watchers, key_expr, handler)
        for key in dict.fromkeys(token.key_expr for token in self._broker.tokens):
            deliver([watcher], key, True)
        return watcher

    def close(self) -> None:
        """Withdraw everything that this client declared."""
        self._closed = True
        for entry in self._mine:
            entry.close()

    def _declare(self, entries: list[_Entry], key_expr: str, call: Callable[..., Any]) -> _Entry:
        self._check_open()
        _chunks(key_expr)
        entry = _Entry(key_expr, call, self._broker)
        entries.append(entry)
        self._mine.append(entry)
        return entry

    def _check_open(self) -> None:
        if self._closed:
            raise BusError("the bus is closed")
