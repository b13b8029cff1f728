"""What travels on the bus: every stream with its rate, bytes, age and faults."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass

from common.bus import Bus
from common.keys import PREFIX
from ground.inbox import Inbox


@dataclass(frozen=True)
class StreamReport:
    """One stream of one vehicle since the spy began to listen."""

    vehicle: str
    stream: str
    messages: int
    bytes: int
    rate_hz: float
    bytes_per_s: float
    age_s: float
    stale: bool
    gaps: int
    faults: int
    fault: str


class Spy:
    """Listens to everything and counts."""

    def __init__(self, bus: Bus) -> None:
        """Begin to listen. Raises BusError."""
        self._inbox = Inbox()
        self._lock = threading.Lock()
        self._subscription = bus.subscribe(f"{PREFIX}/**", self._hear)

    def report(self) -> list[StreamReport]:
        """Every stream that was heard, sorted by vehicle and stream."""
        now_ns = time.monotonic_ns()
        with self._lock:
            return list(self._rows(now_ns))

    @property
    def strangers(self) -> tuple[int, str]:
        """How many messages came under a key that is no stream of ours, and why the last one was refused."""
        return self._inbox.strangers, self._inbox.stranger

    def close(self) -> None:
        """Stop listening."""
        self._subscription.close()

    def _hear(self, key: str, payload: bytes) -> None:
        with self._lock:
            self._inbox.receive(key, payload, time.monotonic_ns())

    def _rows(self, now_ns: int) -> Iterator[StreamReport]:
        for _, count in sorted(self._inbox.streams.items()):
            yield StreamReport(
                vehicle=count.vehicle,
                stream=count.stream.name,
                messages=count.messages,
                bytes=count.bytes,
                rate_hz=round(count.rate_hz(now_ns), 2),
                bytes_per_s=round(count.bytes_per_s(now_ns), 1),
                age_s=round(count.age_s(now_ns) or 0.0, 2),
                stale=count.stale(now_ns),
                gaps=count.gaps,
                faults=count.faults,
                fault=count.fault,
            )


def as_json(reports: list[StreamReport]) -> list[dict[str, object]]:
    """The reports as plain values."""
    return [asdict(report) for report in reports]


def as_table(reports: list[StreamReport]) -> str:
    """The reports as text, one line a stream, and the last fault of each below its line."""
    titles = f"{'messages':>9}{'Hz':>8}{'kB/s':>9}{'MB':>9}{'age s':>8}{'gaps':>6}{'faults':>8}"
    lines = [f"{'vehicle':<14}{'stream':<12}{titles}"]
    for r in reports:
        numbers = f"{r.messages:>9}{r.rate_hz:>8.1f}{r.bytes_per_s / 1e3:>9.1f}{r.bytes / 1e6:>9.2f}{r.age_s:>8.1f}"
        stale = "  stale" if r.stale else ""
        lines.append(f"{r.vehicle:<14}{r.stream:<12}{numbers}{r.gaps:>6}{r.faults:>8}{stale}")
        if r.fault:
            lines.append(f"    last fault: {r.fault}")
    return "\n".join(lines if reports else [*lines, "nothing has arrived yet"])
