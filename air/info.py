"""What is in a source: streams, rates and gaps, summed up while it passes, in bounded memory."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

from air.sources.source import Problem, Sensed, Source
from common.counts import Counts
from common.measurements import (
    CameraFrame,
    ClockState,
    GlonassEphemeris,
    GnssEpoch,
    ImuSample,
    Ionosphere,
    KeplerEphemeris,
    RawBytes,
    ReceiverSolution,
    VehicleState,
)

GAP = 1.5
"""An interval this many times longer than the stream's median is a gap."""
BINS_PER_E = 100
"""Intervals are counted in bins of one per cent, so that a long recording needs no more memory than a short one."""


@dataclass(frozen=True)
class Stream:
    """One stream of a source: `name` is the kind and the device, times in ns of its stamps.

    `rate_hz` is None for fewer than two stamps. `gaps` counts intervals of more than 1.5 median intervals, and
    `backward` stamps that lie before the one before them. All three are None for what comes when it pleases.
    """

    name: str
    count: int
    first_ns: int
    last_ns: int
    rate_hz: float | None
    gaps: int | None
    longest_gap_s: float | None
    backward: int | None


@runtime_checkable
class Counted(Protocol):
    """A source of device bytes, which counts what it had to drop."""

    @property
    def counts(self) -> Counts:
        """What its driver has seen."""
        ...


@dataclass(frozen=True)
class Summary:
    """All streams of a source by name, its duration in s, and what was wrong.

    `counts` are those of its driver, None for a source that has no device's bytes.
    """

    url: str
    streams: tuple[Stream, ...]
    duration_s: float
    counts: Counts | None
    problems: tuple[Problem, ...]


def summarize(source: Source, items: Iterable[Sensed] | None = None) -> Summary:
    """What a source holds. `items` are those of the source where the caller watches them go by."""
    tallies: dict[str, _Tally] = {}
    for item in source if items is None else items:
        name, steady = stream_of(item)
        tallies.setdefault(name, _Tally(steady)).add(item.t_ns)
    streams = tuple(tallies[name].stream(name) for name in sorted(tallies))
    steady_ends = [(s.first_ns, s.last_ns) for s in streams if s.gaps is not None]
    ends = steady_ends or [(s.first_ns, s.last_ns) for s in streams]
    duration_ns = max(last for _, last in ends) - min(first for first, _ in ends) if ends else 0
    counts = source.counts if isinstance(source, Counted) else None
    return Summary(source.url, streams, duration_ns * 1e-9, counts, tuple(source.problems))


def table(summary: Summary) -> list[tuple[str, ...]]:
    """Rows of text about the streams, the heading first; a dash where a figure makes no sense."""
    rows: list[tuple[str, ...]] = [("stream", "count", "rate Hz", "first s", "last s", "gaps", "longest s", "back")]
    start_ns = min((s.first_ns for s in summary.streams if s.gaps is not None), default=None)
    if start_ns is None:
        start_ns = min((s.first_ns for s in summary.streams), default=0)
    for s in summary.streams:
        seconds = (f"{(t_ns - start_ns) * 1e-9:.3f}" for t_ns in (s.first_ns, s.last_ns))
        rate, longest = _text(s.rate_hz, ".2f"), _text(s.longest_gap_s, ".3f")
        rows.append((s.name, str(s.count), rate, *seconds, _text(s.gaps, "d"), longest, _text(s.backward, "d")))
    return rows


def as_dict(summary: Summary) -> dict[str, Any]:
    """The summary as plain values, for JSON."""
    counts = summary.counts
    told = None if counts is None else vars(counts) | {"frames": dict(counts.frames)}
    return asdict(replace(summary, counts=None)) | {"counts": told}


def _text(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def stream_of(item: Sensed) -> tuple[str, bool]:
    """Name of the stream that an item belongs to, and whether it is expected at a steady rate."""
    match item:
        case ImuSample():
            return "imu", True
        case CameraFrame(camera=camera):
            return f"camera {camera}", True
        case GnssEpoch(receiver=receiver):
            return f"gnss {receiver}", True
        case ReceiverSolution(receiver=receiver):
            return f"solution {receiver}", True
        case VehicleState(system=system):
            return f"vehicle {system}", True
        case ClockState(device=device):
            return f"clock {device}", True
        case RawBytes(device=device):
            return f"bytes {device}", False
        case KeplerEphemeris(satellite=satellite, source=source):
            return f"ephemeris {satellite[:1]} {source}", False
        case GlonassEphemeris():
            return "ephemeris R", False
        case Ionosphere(system=system):
            return f"ionosphere {system}", False
        case _:
            return "photo", True


@dataclass
class _Tally:
    """What is known of a stream so far."""

    steady: bool
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    previous_ns: int = 0
    longest_ns: int = 0
    backward: int = 0
    intervals: Counter[int] = field(default_factory=Counter)

    def add(self, t_ns: int) -> None:
        if self.count:
            interval_ns = t_ns - self.previous_ns
            self.backward += interval_ns < 0
            self.longest_ns = max(self.longest_ns, interval_ns)
            self.intervals[round(BINS_PER_E * math.log(max(interval_ns, 1)))] += 1
        self.first_ns = min(self.first_ns, t_ns) if self.count else t_ns
        self.last_ns = max(self.last_ns, t_ns) if self.count else t_ns
        self.previous_ns = t_ns
        self.count += 1

    def stream(self, name: str) -> Stream:
        span_s = (self.last_ns - self.first_ns) * 1e-9
        rate_hz = (self.count - 1) / span_s if self.steady and span_s > 0 else None
        gaps = self._gaps() if self.steady else None
        longest_s = self.longest_ns * 1e-9 if gaps else None
        backward = self.backward if self.steady else None
        return Stream(name, self.count, self.first_ns, self.last_ns, rate_hz, gaps, longest_s, backward)

    def _gaps(self) -> int:
        """Intervals whose bin lies beyond that of 1.5 medians."""
        limit = _median(self.intervals) + BINS_PER_E * math.log(GAP)
        return sum(count for interval, count in self.intervals.items() if interval > limit)


def _median(counted: Counter[int]) -> int:
    """The median of values that are given with their counts; 0 of none."""
    passed, half = 0, sum(counted.values()) / 2
    for value in sorted(counted):
        passed += counted[value]
        if passed >= half:
            return value
    return 0
