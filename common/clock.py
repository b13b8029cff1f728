"""The time of day as a part that is passed in, so that a test or a replay can be its own clock."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

GPST_MINUS_UTC_NS = 18_000_000_000  # leap seconds since 1980, unchanged since 2017


class Clock(Protocol):
    """Tells and waits for time."""

    def now_ns(self) -> int:
        """GNSS time (GPST), ns since 1970-01-01: Unix time without its leap seconds."""
        ...

    def sleep(self, seconds: float) -> None:
        """Return after so many seconds; at once when they are not positive."""
        ...


class SystemClock:
    """The computer's clock, as far as it is set."""

    def now_ns(self) -> int:
        """GNSS time (GPST), ns since 1970-01-01."""
        return time.time_ns() + GPST_MINUS_UTC_NS

    def sleep(self, seconds: float) -> None:
        """Block for so many seconds."""
        time.sleep(max(0.0, seconds))


@dataclass
class ManualClock:
    """A clock that stands still until somebody sleeps on it."""

    t_ns: int = 0

    def now_ns(self) -> int:
        """The time that was set, ns."""
        return self.t_ns

    def sleep(self, seconds: float) -> None:
        """Move the time on, without waiting."""
        self.t_ns += max(0, round(seconds * 1e9))
