"""From a key and bytes to a checked message, and the book-keeping of every stream."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from common.errors import WireError
from common.keys import Key, parse_key, place_of
from common.messages import Keyframe, Message
from common.streams import Stream
from common.wire import decode

WINDOW_NS = 10_000_000_000


@dataclass(frozen=True, eq=False)
class Received:
    """A message that fits its schema and its key; `arrival_ns` as the receiving node stamped it."""

    vehicle: str
    stream: Stream
    message: Message
    payload: bytes
    arrival_ns: int


@dataclass
class StreamCount:
    """What arrived on one stream of one vehicle.

    `gaps` counts for keyframes the indices below the highest that never came, for other streams the pauses that
    were longer than the stream's `stale_after_s`. `fault` is the last reason why something was refused.
    """

    vehicle: str
    stream: Stream
    messages: int = 0
    bytes: int = 0
    faults: int = 0
    fault: str = ""
    gaps: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    _window: deque[tuple[int, int]] = field(default_factory=deque)
    _keyframes: dict[str, set[int]] = field(default_factory=dict)

    def arrived(self, size: int, now_ns: int) -> None:
        """Count bytes that came, good or bad."""
        if self.last_ns is not None and 0 < self.stream.stale_after_s < (now_ns - self.last_ns) / 1e9:
            self.gaps += 1
        self.last_ns = now_ns
        self.first_ns = now_ns if self.first_ns is None else self.first_ns
        self.messages += 1
        self.bytes += size
        self._window.append((now_ns, size))
        self._forget(now_ns)

    def accepted(self, message: Message) -> None:
        """Note a message that was good."""
        if isinstance(message, Keyframe):
            seen = self._keyframes.setdefault(message.flight, set())
            if message.index not in seen:
                seen.add(message.index)
                self.gaps = sum(max(indices) + 1 - len(indices) for indices in self._keyframes.values())

    def refused(self, reason: str) -> None:
        """Note why bytes were not accepted."""
        self.faults += 1
        self.fault = reason

    def rate_hz(self, now_ns: int) -> float:
        """Messages per second over the last ten seconds, or since the first message."""
        self._forget(now_ns)
        return len(self._window) / self._span_s(now_ns)

    def bytes_per_s(self, now_ns: int) -> float:
        """Bytes per second over the last ten seconds, or since the first message."""
        self._forget(now_ns)
        return sum(size for _, size in self._window) / self._span_s(now_ns)

    def age_s(self, now_ns: int) -> float | None:
        """Seconds since the last message, or None before the first."""
        return None if self.last_ns is None else (now_ns - self.last_ns) / 1e9

    def stale(self, now_ns: int) -> bool:
        """Whether the stream has been silent for longer than the table of streams allows."""
        age_s = self.age_s(now_ns)
        return age_s is not None and 0 < self.stream.stale_after_s < age_s

    def _span_s(self, now_ns: int) -> float:
        """The window, or what has passed of it since the first message."""
        since_first_ns = now_ns - self.first_ns if self.first_ns is not None else 0
        return min(max(since_first_ns, 1_000_000_000), WINDOW_NS) / 1e9

    def _forget(self, now_ns: int) -> None:
        while self._window and self._window[0][0] <= now_ns - WINDOW_NS:
            self._window.popleft()


class Inbox:
    """Decodes what arrives, and never raises whatever the bytes."""

    def __init__(self) -> None:
        self.streams: dict[tuple[str, str], StreamCount] = {}
        self.strangers = 0
        self.stranger = ""

    def receive(self, key: str, payload: bytes, arrival_ns: int) -> Received | None:
        """The message under a key, or None when key or bytes are not what they should be; that is counted."""
        try:
            parsed = parse_key(key)
        except WireError as error:
            self.strangers += 1
            self.stranger = str(error)
            return None
        count = self._count(parsed)
        count.arrived(len(payload), arrival_ns)
        try:
            message = decode(parsed.stream, payload)
            _check_place(parsed, message)
        except WireError as error:
            count.refused(str(error))
            return None
        count.accepted(message)
        return Received(parsed.vehicle, parsed.stream, message, payload, arrival_ns)

    @property
    def faults(self) -> int:
        """Messages refused so far, on all streams."""
        return self.strangers + sum(count.faults for count in self.streams.values())

    def _count(self, key: Key) -> StreamCount:
        return self.streams.setdefault((key.vehicle, key.stream.name), StreamCount(key.vehicle, key.stream))


def _check_place(key: Key, message: Message) -> None:
    """Raises WireError when the chunks behind the stream's name are not the place that the message gives."""
    place = place_of(key.stream, message)
    if key.rest != place:
        raise WireError(f"{key.stream.name}: the key ends in {'/'.join(key.rest)!r}, the message says {place}")
