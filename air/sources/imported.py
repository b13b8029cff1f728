"""What the sources of files that other programs wrote share: path and options in the URL, counted faults, merging."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import parse_qsl

from air.gnss.calendar import leap_seconds
from air.sensors.calibration import Calibration
from air.sources.source import Problem, Sensed, Truth
from common.errors import SourceError

GEOID_SIGMA = 30.0
"""m. Many logs know only heights above mean sea level. They stand in for ellipsoidal ones, and this is how far off
they are: the geoid's undulation, 30 m in the mean square over the earth (EGM96)."""


class Faults:
    """What is wrong with a recording. Faults of one kind are counted, so that a bad file fills no memory."""

    MOST = 100
    """Kinds of faults that are told apart; what comes then is counted as others."""

    def __init__(self) -> None:
        self._seen: dict[tuple[str, str], tuple[int, str]] = {}

    def add(self, name: str, text: str, where: str = "") -> None:
        """Count a fault of the part `name`; of equal ones only the first `where` is kept."""
        if (name, text) not in self._seen and len(self._seen) >= self.MOST:
            name, text, where = "others", "more faults than are told", ""
        count, first = self._seen.get((name, text), (0, where))
        self._seen[name, text] = (count + 1, first)

    def problems(self) -> tuple[Problem, ...]:
        """One problem for each kind of fault, with its count and its first place."""
        return tuple(Problem(name, text + _times(count, where)) for (name, text), (count, where) in self._seen.items())


def _times(count: int, where: str) -> str:
    if count == 1:
        return f" ({where})" if where else ""
    return f" ({count} times, first {where})" if where else f" ({count} times)"


Reader = Callable[[Faults], Iterator[Sensed]]
"""Reads a file from its start, adding what is wrong with it."""


class Imported:
    """A source that is read by one function, anew at every iteration.

    `calibrations` are those of its cameras by name, as far as they come with it.
    """

    def __init__(self, url: str, read: Reader, calibrations: Mapping[str, Calibration] | None = None):
        self.calibrations = calibrations or {}
        self._url = url
        self._read = read
        self._faults = Faults()

    @property
    def url(self) -> str:
        """The URL that opened it."""
        return self._url

    @property
    def truth(self) -> Truth | None:
        """None: recordings give their truth as files of their own."""
        return None

    @property
    def problems(self) -> Sequence[Problem]:
        """What was wrong in the latest iteration."""
        return self._faults.problems()

    def __iter__(self) -> Iterator[Sensed]:
        self._faults = Faults()
        return self._read(self._faults)


def split_options(url: str, rest: str, allowed: Sequence[str] = ()) -> tuple[Path, Mapping[str, str]]:
    """The path and the options of `PATH?key=value&…`. Raises SourceError for an option that is not allowed."""
    text, _, query = rest.partition("?")
    options: dict[str, str] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in allowed:
            known = f"allowed are {', '.join(allowed)}" if allowed else "it takes none"
            raise SourceError(f"source {url!r}: unknown option {key!r}; {known}")
        if key in options:
            raise SourceError(f"source {url!r}: option {key!r} is given twice; give it once")
        options[key] = value
    return Path(text).expanduser(), options


def find_file(url: str, rest: str) -> Path:
    """The file that a URL without options names. Raises SourceError where there is none."""
    path, _ = split_options(url, rest)
    if not path.is_file():
        what = "is a folder, not a file" if path.exists() else "does not exist"
        raise SourceError(f"source {url!r}: {str(path)!r} {what}")
    return path


def find_folder(url: str, rest: str) -> Path:
    """The folder that a URL without options names. Raises SourceError where there is none."""
    path, _ = split_options(url, rest)
    if not path.is_dir():
        what = "is a file, not a folder" if path.exists() else "does not exist"
        raise SourceError(f"source {url!r}: {str(path)!r} {what}")
    return path


def in_time_order(*streams: Iterable[Sensed]) -> Iterator[Sensed]:
    """Streams that are each in time order, merged into one; only one item of each is held."""
    return heapq.merge(*streams, key=lambda item: item.t_ns)


def reordered(stream: Iterable[Sensed], horizon_ns: int = 1_000_000_000, most: int = 10_000) -> Iterator[Sensed]:
    """A stream that is nearly in time order, in time order, as far as items are late by less than the horizon."""
    held: list[tuple[int, int, Sensed]] = []
    newest_ns = 0
    for number, item in enumerate(stream):
        heapq.heappush(held, (item.t_ns, number, item))
        newest_ns = max(newest_ns, item.t_ns)
        while held and (held[0][0] <= newest_ns - horizon_ns or len(held) > most):
            yield heapq.heappop(held)[2]
    while held:
        yield heapq.heappop(held)[2]


def gpst_of_unix(unix_ns: int) -> int:
    """GPST, ns, of Unix time (UTC), ns; times before or after all calendars are taken as they are."""
    try:
        return unix_ns + leap_seconds(datetime.fromtimestamp(unix_ns // 1_000_000_000, UTC)) * 1_000_000_000
    except (ValueError, OverflowError, OSError):
        return unix_ns


def one_line(error: BaseException) -> str:
    """What a foreign library says about a failure, as one line of at most 200 characters."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]
