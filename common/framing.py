"""Finds whole frames of several protocols in bytes that may begin anywhere and be damaged."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

from common.counts import Counts

UNFINISHED = -1
"""What a probe says of a frame that may be valid once more bytes have come."""

Probe = Callable[[bytes, int], int]
"""How many bytes long the valid frame at a place is; 0 when there is none, UNFINISHED while nobody can tell."""


class FrameScanner:
    """Gives the frames of one port, each protocol known by the first byte of its frames.

    Bytes that belong to no frame are counted as dropped; it holds no more than one unfinished frame.
    """

    def __init__(self, counts: Counts, probes: Mapping[int, Probe]) -> None:
        self._counts = counts
        self._probes = probes
        self._begin = re.compile(b"[" + b"".join(re.escape(bytes([first])) for first in probes) + b"]")
        self._held = b""
        self._in_burst = False

    @property
    def held(self) -> int:
        """How many bytes of an unfinished frame it holds."""
        return len(self._held)

    def feed(self, data: bytes) -> list[bytes]:
        """The whole frames, in their order, that these bytes complete."""
        self._counts.received_bytes += len(data)
        held, at, frames = self._held + data, 0, []
        while begin := self._begin.search(held, at):
            self._drop(begin.start() - at)
            at = begin.start()
            length = self._probes[held[at]](held, at)
            if length == UNFINISHED:
                break
            if length == 0:
                self._drop(1)
                at += 1
                continue
            frames.append(held[at : at + length])
            self._in_burst = False
            at += length
        else:
            self._drop(len(held) - at)
            at = len(held)
        self._held = held[at:]
        return frames

    def _drop(self, count: int) -> None:
        if count:
            self._counts.dropped_bytes += count
            self._counts.bursts += not self._in_burst
            self._in_burst = True
