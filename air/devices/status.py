"""How a device is doing: what it sent lately, and what is wrong with it (pure: the time is passed in)."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

from common.messages import Health, Level

WINDOW_S = 2.0
"""Rates are taken over so long."""
SILENT_S = 2.0
"""Without a byte for so long, a device is silent."""
GARBLED_S = 1.5
"""Bytes without a single whole frame for so long are garbage."""
GARBLED_BYTES = 64


class State(StrEnum):
    """What a device does."""

    CLOSED = "closed"
    OPENED = "opened"
    ALIVE = "alive"
    SILENT = "silent"
    GARBLED = "garbled"


@dataclass(frozen=True)
class DeviceStatus:
    """One device at one moment: where it is, its state, measurements/s of its main kind, age of its last bytes in s.

    `fault` says in one line what is wrong and what to do; it is empty when nothing is. `counts` are those of its
    driver, and how often it was opened.
    """

    device: str
    place: str
    state: State
    rate_hz: float = 0.0
    age_s: float | None = None
    fault: str = ""
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def well(self) -> bool:
        """Whether it does what it is there for."""
        return self.state is State.ALIVE and not self.fault

    def health(self, t_ns: int) -> Health:
        """The same as a message, at GNSS time `t_ns`."""
        level = Level.OK if self.well else Level.DEGRADED if self.state is State.ALIVE else Level.FAILED
        counts = self.counts | {"rate_mhz": round(self.rate_hz * 1000)}
        if self.age_s is not None:
            counts["age_ms"] = round(self.age_s * 1000)
        return Health(t_ns, self.device, level, f"{self.state} | {self.place} | {self.fault}"[:1000], counts)

    @staticmethod
    def from_health(health: Health) -> DeviceStatus | None:
        """The status that a message of a device tells, None for a message of something else."""
        state, *rest = health.text.split(" | ", 2)
        if state not in set(State) or len(rest) != 2:
            return None
        counts = dict(health.counts)
        rate_hz, age_ms = counts.pop("rate_mhz", 0) / 1000, counts.pop("age_ms", None)
        age_s = None if age_ms is None else age_ms / 1000
        return DeviceStatus(health.role, rest[0], State(state), rate_hz, age_s, rest[1], counts)


@dataclass(frozen=True)
class _Arrival:
    t_s: float
    size: int
    frames: int
    dropped: int
    kinds: Counter[str]


class Watch:
    """Keeps what a device did in the last seconds. Times are of one monotonic clock, s; one thread writes."""

    def __init__(self, device: str, place: str) -> None:
        self._device, self._place = device, place
        self._arrivals: deque[_Arrival] = deque()
        self._closed_text = "not opened yet"
        self._opened_s: float | None = None
        self._last_s: float | None = None
        self._fault = ""
        self.opened_count = 0

    def opened(self, now_s: float) -> None:
        """The link is open."""
        self._opened_s, self._closed_text = now_s, ""
        self._arrivals.clear()
        self.opened_count += 1

    def closed(self, text: str) -> None:
        """The link is gone, or could not be opened: one line why."""
        self._opened_s, self._closed_text = None, text
        self._arrivals.clear()

    def received(self, now_s: float, size: int, frames: int, dropped: int, kinds: Iterable[str]) -> None:
        """Bytes came: how many, how many frames they completed, how many were dropped, and the measurements' kinds."""
        self._last_s = now_s
        self._arrivals.append(_Arrival(now_s, size, frames, dropped, Counter(kinds)))
        while self._arrivals and self._arrivals[0].t_s < now_s - WINDOW_S:
            self._arrivals.popleft()

    def note(self, fault: str) -> None:
        """Something that is wrong until further notice; empty when it is over."""
        self._fault = fault

    def restart(self, now_s: float) -> None:
        """Judge the link anew from now on, after a setting of it has changed."""
        self._opened_s = now_s
        self._arrivals.clear()

    def state(self, now_s: float) -> State:
        """What the device does now."""
        if self._opened_s is None:
            return State.CLOSED
        recent = self._recent(now_s)
        if self.decodes(now_s):
            return State.ALIVE
        listened_s = self._listened_s(now_s)
        if not recent and listened_s >= SILENT_S:
            return State.SILENT
        if listened_s >= GARBLED_S and sum(a.size for a in recent) >= GARBLED_BYTES:
            return State.GARBLED
        return State.OPENED

    def decodes(self, now_s: float) -> bool:
        """Whether most of what came lately was whole frames: garbage too holds a frame by chance."""
        recent = self._recent(now_s)
        return any(a.frames for a in recent) and 2 * sum(a.dropped for a in recent) < sum(a.size for a in recent)

    def status(self, now_s: float, counts: dict[str, int]) -> DeviceStatus:
        """How the device is doing, with the counts of its driver."""
        state, rate_hz = self.state(now_s), self._rate_hz(now_s)
        age_s = None if self._last_s is None else max(0.0, now_s - self._last_s)
        fault = self._closed_text if state is State.CLOSED else self._fault or _FAULTS.get(state, "")
        if state is State.ALIVE and not rate_hz and self._listened_s(now_s) > WINDOW_S:
            fault = fault or "frames arrive, but none with a measurement: is the device set up?"
        counts = counts | {"opened": self.opened_count}
        return DeviceStatus(self._device, self._place, state, rate_hz, age_s, fault, counts)

    def _listened_s(self, now_s: float) -> float:
        return 0.0 if self._opened_s is None else now_s - self._opened_s

    def _recent(self, now_s: float) -> list[_Arrival]:
        return [a for a in list(self._arrivals) if a.t_s >= now_s - WINDOW_S]

    def _rate_hz(self, now_s: float) -> float:
        """Measurements per second of the most frequent kind."""
        total: Counter[str] = sum((a.kinds for a in self._recent(now_s)), Counter())
        if self._opened_s is None or not total:
            return 0.0
        return max(total.values()) / min(WINDOW_S, max(self._listened_s(now_s), 0.1))


_FAULTS = {
    State.SILENT: "open, but silent: check power, cable, and that the device is set to send",
    State.GARBLED: "bytes arrive but no frame decodes: wrong baud rate, or another device",
}
