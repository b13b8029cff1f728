"""The bus: publish, subscribe, serve and query by key, over a Zenoh session or inside one process.

The ground's gateway is a router, other stations are its clients, the aircraft is a peer: it starts without the ground
and keeps trying. Two peers do not reach each other through a router (Zenoh 1.10).
"""

from __future__ import annotations

import atexit
import json
import logging
import queue
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol

import zenoh

from common.errors import BusError
from common.streams import Congestion, Priority, Stream

log = logging.getLogger(__name__)

Handler = Callable[[str, bytes], None]
Server = Callable[[str, bytes], Iterable[tuple[str, bytes]]]


class Subscription(Protocol):
    """Something that stops when closed: a subscriber, a queryable, a liveliness token."""

    def close(self) -> None:
        """Stop; nothing is delivered afterwards."""
        ...


class Bus(Protocol):
    """What nodes need of a transport. Handlers run on the transport's thread: hand over and return.

    A handler's exception is logged and stops nothing. Every method raises BusError on a closed bus or a malformed key.
    """

    def publish(self, key: str, payload: bytes, stream: Stream) -> None:
        """Send bytes under a key with the quality of service of the stream."""
        ...

    def subscribe(self, key_expr: str, handler: Handler) -> Subscription:
        """Call `handler(key, payload)` for each message that matches."""
        ...

    def serve(self, key_expr: str, server: Server) -> Subscription:
        """Answer queries that match: `server(key_expr, payload)` gives the replies as (key, payload)."""
        ...

    def query(self, key_expr: str, payload: bytes = b"", timeout_s: float = 5.0) -> Iterable[tuple[str, bytes]]:
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


def check_key(key: str) -> None:
    """Raises BusError for a key expression where one key is needed."""
    if "*" in key:
        raise BusError(f"{key!r} stands for many keys; publishing and tokens need one")


@dataclass(frozen=True)
class BusConfig:
    """How to open a Zenoh session: endpoints read like `tcp/127.0.0.1:7447`.

    `peer` retries its connections for ever in the background, `client` needs its router at the start, `router`
    listens and forwards. Nothing is searched by multicast. `shared_memory` bypasses the network on one machine.
    """

    mode: Literal["peer", "client", "router"] = "peer"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    shared_memory: bool = True


_PRIORITY = {
    Priority.REAL_TIME: zenoh.Priority.REAL_TIME,
    Priority.DATA_HIGH: zenoh.Priority.DATA_HIGH,
    Priority.DATA: zenoh.Priority.DATA,
    Priority.DATA_LOW: zenoh.Priority.DATA_LOW,
    Priority.BACKGROUND: zenoh.Priority.BACKGROUND,
}
_CONGESTION = {Congestion.DROP: zenoh.CongestionControl.DROP, Congestion.BLOCK: zenoh.CongestionControl.BLOCK}
_CLOSE_TIMEOUT_S = 1.8


class ZenohBus:
    """A Zenoh session; implements `Bus`. Each subscription calls its handler on a thread of its own, in order."""

    def __init__(self, config: BusConfig) -> None:
        """Open the session. Raises BusError, naming the endpoints, when it cannot listen or (client) not connect."""
        try:
            self._session = zenoh.open(_zenoh_config(config))
        except zenoh.ZError as error:
            raise BusError(_explain(config, error)) from error
        self._tokens: list[Subscription] = []
        atexit.register(self.close)

    def publish(self, key: str, payload: bytes, stream: Stream) -> None:
        """Send bytes under a key with the quality of service of the stream; a blocking stream waits for the link."""
        check_key(key)
        with _naming(key):
            self._session.put(
                key,
                payload,
                priority=_PRIORITY[stream.priority],
                congestion_control=_CONGESTION[stream.congestion],
                express=stream.express,
            )

    def subscribe(self, key_expr: str, handler: Handler) -> Subscription:
        """Call `handler(key, payload)` for each message that matches."""
        declare = self._session.declare_subscriber
        return _receive(key_expr, declare, lambda s: handler(str(s.key_expr), s.payload.to_bytes()))

    def serve(self, key_expr: str, server: Server) -> Subscription:
        """Answer queries that match; a reply outside of what was asked for is logged and not sent."""

        def answer(query: zenoh.Query) -> None:
            with query:
                asked = query.payload.to_bytes() if query.payload is not None else b""
                for key, payload in server(str(query.key_expr), asked):
                    _reply(query, key, payload)

        return _receive(key_expr, self._session.declare_queryable, answer)

    def query(self, key_expr: str, payload: bytes = b"", timeout_s: float = 5.0) -> Iterable[tuple[str, bytes]]:
        """All replies (key, payload) that arrive within the timeout, as they come; the question is sent at once."""
        replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
        # A queue without a limit: Zenoh's own channel holds 256 replies, then stalls everything that is received.
        collect = zenoh.handlers.Callback(replies.put, lambda: replies.put(None), indirect=False)
        with _naming(key_expr):
            self._session.get(
                key_expr,
                collect,
                payload=payload,
                timeout=timeout_s,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
        return _good_replies(key_expr, replies)

    def declare_alive(self, key: str) -> Subscription:
        """Hold a liveliness token under a key until closed."""
        check_key(key)
        with _naming(key):
            token = _Declared(self._session.liveliness().declare_token(key))
        self._tokens.append(token)  # a token that nobody holds is withdrawn by Zenoh
        return token

    def watch_alive(self, key_expr: str, handler: Callable[[str, bool], None]) -> Subscription:
        """Call `handler(key, alive)` for tokens that exist, appear and vanish."""
        declare = partial(self._session.liveliness().declare_subscriber, history=True)
        return _receive(key_expr, declare, lambda s: handler(str(s.key_expr), s.kind == zenoh.SampleKind.PUT))

    def close(self) -> None:
        """Close the session; returns within two seconds even when the link is dead, as Zenoh alone would not."""
        atexit.unregister(self.close)
        closing = threading.Thread(target=self._session.close, name="bus-close", daemon=True)
        closing.start()
        closing.join(_CLOSE_TIMEOUT_S)
        if closing.is_alive():
            log.warning("the link does not answer: the session was left to close by itself")


class _Receiver:
    """Calls a handler, on a daemon thread of its own, with what Zenoh's thread puts into its callback.

    Zenoh would start such a thread too, but one that keeps a program from ending until the session is closed.
    """

    def __init__(self, key_expr: str, handle: Callable[[Any], None]) -> None:
        self._items: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._key_expr, self._handle = key_expr, handle
        self._stopped = False
        self.callback = zenoh.handlers.Callback(self._items.put, lambda: self._items.put(None), indirect=False)

    def start(self) -> None:
        """Begin to call the handler."""
        threading.Thread(target=self._run, name=f"bus {self._key_expr}", daemon=True).start()

    def stop(self) -> None:
        """Call the handler no more."""
        self._stopped = True

    def _run(self) -> None:
        while (item := self._items.get()) is not None and not self._stopped:
            try:
                self._handle(item)
            except Exception:
                log.exception("the handler of %s failed", self._key_expr)


def _receive(key_expr: str, declare: Callable[..., Any], handle: Callable[[Any], None]) -> Subscription:
    receiver = _Receiver(key_expr, handle)
    with _naming(key_expr):
        declared = declare(key_expr, receiver.callback)
    receiver.start()
    return _Declared(declared, receiver)


class _Declared:
    """A declaration on a Zenoh session that can be withdrawn, also after the session was closed."""

    def __init__(self, declared: Any, receiver: _Receiver | None = None) -> None:
        self._declared, self._receiver = declared, receiver

    def close(self) -> None:
        if self._receiver is not None:
            self._receiver.stop()
        try:
            self._declared.undeclare()
        except zenoh.ZError as error:
            log.debug("already withdrawn: %s", error)


@contextmanager
def _naming(key_expr: str) -> Iterator[None]:
    """Turns Zenoh's errors into a BusError that names the key."""
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{key_expr!r}: {_reason(error)}") from error


def _reply(query: zenoh.Query, key: str, payload: bytes) -> None:
    try:
        query.reply(key, payload)
    except zenoh.ZError as error:
        log.warning("reply %s to a query of %s was not sent: %s", key, query.key_expr, _reason(error))


def _good_replies(key_expr: str, replies: queue.SimpleQueue[zenoh.Reply | None]) -> Iterator[tuple[str, bytes]]:
    while (reply := replies.get()) is not None:
        if reply.ok is not None:
            yield str(reply.ok.key_expr), reply.ok.payload.to_bytes()
        elif reply.err is not None:
            log.warning("query of %s: %s", key_expr, reply.err.payload.to_bytes().decode(errors="replace"))


def _zenoh_config(config: BusConfig) -> zenoh.Config:
    settings = {
        "mode": config.mode,
        "connect/endpoints": config.connect,
        "connect/retry": {"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 1.5},
        "listen/endpoints": config.listen,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": config.shared_memory,
    }
    result = zenoh.Config()
    for name, value in settings.items():
        result.insert_json5(name, json.dumps(value))
    return result


def _explain(config: BusConfig, error: zenoh.ZError) -> str:
    listen = f" listening on {', '.join(config.listen)}" if config.listen else ""
    connect = f" connecting to {', '.join(config.connect)}" if config.connect else ""
    return f"cannot open the bus as {config.mode}{listen}{connect}: {_reason(error)}"


def _reason(error: zenoh.ZError) -> str:
    """What Zenoh says, without the places in its source code."""
    return re.sub(r" at /\S+?:\d+\.", "", str(error)).strip()
