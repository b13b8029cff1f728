"""Between the transport's thread and ours: of each key only the newest message waits."""

from __future__ import annotations

import threading
from dataclasses import dataclass


@dataclass(frozen=True)
class Letter:
    """Bytes under a key and when they came."""

    key: str
    payload: bytes
    arrival_ns: int


class Mailbox:
    """A dictionary that can be waited for. A slow reader skips what was replaced meanwhile and never falls behind."""

    def __init__(self) -> None:
        self._waiting: dict[str, Letter] = {}
        self._arrived = threading.Condition()
        self.replaced = 0

    def put(self, letter: Letter) -> None:
        """Leave a letter; one of the same key that still waits is dropped. Never blocks for long."""
        with self._arrived:
            if self._waiting.pop(letter.key, None) is not None:
                self.replaced += 1
            self._waiting[letter.key] = letter
            self._arrived.notify()

    def take(self, timeout_s: float) -> list[Letter]:
        """All letters in order of arrival, as soon as there is one; empty after the timeout."""
        with self._arrived:
            if not self._waiting:
                self._arrived.wait(timeout_s)
            letters, self._waiting = list(self._waiting.values()), {}
            return letters
