"""Replays a recording on the bus: the stored bytes under the stored keys, at the pace at which they came."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from common.bus import Bus
from common.clock import Clock
from common.errors import SourceError, WireError
from common.keys import alive_key, parse_key
from common.recording.reader import Recorded, Recording
from common.streams import Congestion

LISTENER_S = 3.0


@dataclass(frozen=True)
class Passage:
    """Which part of a recording is replayed, s from its start, and how: `speed` 2 is twice as fast as it came."""

    speed: float = 1.0
    start_s: float = 0.0
    end_s: float = float("inf")
    loop: bool = False

    def __post_init__(self) -> None:
        """Raises SourceError for a passage that is none."""
        if not self.speed > 0:
            raise SourceError(f"speed is {self.speed}; allowed: more than 0, inf is as fast as possible")
        if not 0 <= self.start_s < self.end_s:
            raise SourceError(f"start is {self.start_s} s, end {self.end_s} s; allowed: 0 ≤ start < end")


def paced(recording: Recording, passage: Passage, clock: Clock) -> Iterator[Recorded]:
    """The messages of a passage, each when its time has come. Raises SourceError when there is none."""
    first_ns = recording.first_ns + round(passage.start_s * 1e9)
    last_ns = None if passage.end_s == float("inf") else recording.first_ns + round(passage.end_s * 1e9)
    given = True
    while given:
        given, begun_ns = False, clock.now_ns()
        for message in recording.messages(first_ns, last_ns):
            due_s = (message.log_ns - first_ns) * 1e-9 / passage.speed
            clock.sleep(due_s - (clock.now_ns() - begun_ns) * 1e-9)
            given = True
            yield message
        if not given:
            raise SourceError(f"{recording.path}: holds no message in this passage")
        if not passage.loop:
            return


def publish(messages: Iterable[Recorded], bus: Bus) -> int:
    """How many messages were published; a full link is waited for, and keys that are no longer ours are left out."""
    count = 0
    for message in messages:
        try:
            stream = parse_key(message.key).stream
        except WireError:
            continue
        bus.publish(message.key, message.payload, replace(stream, congestion=Congestion.BLOCK))
        count += 1
    return count


def await_listener(bus: Bus) -> None:
    """Return once some other program of ours is connected, or after three seconds."""
    somebody = threading.Event()
    watch = bus.watch_alive(alive_key("*", "*"), lambda _, alive: somebody.set() if alive else None)
    somebody.wait(LISTENER_S)
    watch.close()
