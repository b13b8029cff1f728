"""What a reader of bytes that come from outside has seen, and what it had to drop."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Counts:
    """What a driver has seen so far: bytes, whole frames by kind, and what it had to drop.

    A burst is an unbroken run of dropped bytes; `refused` counts frames that arrived whole but made no sense,
    `missing` those that the device's own count says never arrived.
    """

    received_bytes: int = 0
    dropped_bytes: int = 0
    bursts: int = 0
    refused: int = 0
    missing: int = 0
    frames: Counter[str] = field(default_factory=Counter)
