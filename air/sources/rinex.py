"""RINEX files as a source: `rinex:OBS,NAV[,NAV…]`, each plain or gzipped."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import BinaryIO, cast

from air.gnss.rinex_lines import Lines
from air.gnss.rinex_navigation import read_navigation
from air.gnss.rinex_observation import read_observations
from air.sources.imported import Faults, Imported
from air.sources.source import Sensed
from common.errors import SourceError
from common.measurements import GlonassEphemeris

LONGEST_LINE = 8192
"""No line of RINEX is near as long; a file without line ends is not read into memory."""
HEADER_LINES = 20
RECEIVER = "gnss"


def open_rinex(url: str, rest: str) -> Imported:
    """All that the navigation files broadcast, then the epochs of the observation files, in the order of the URL.

    The navigation comes first because files are complete: whoever reads them after the flight need not wait for a
    satellite to repeat its ephemeris. Raises SourceError for a file that is missing, or that is no RINEX
    observation or navigation file of version 2 or 3.
    """
    paths = [Path(name).expanduser() for name in rest.split(",") if name]
    if not paths:
        raise SourceError(f"source {url!r} names no file; use rinex:OBS,NAV")
    kinds = {path: kind_of(url, path) for path in paths}

    def read(faults: Faults) -> Iterator[Sensed]:
        channels: dict[str, int] = {}
        for path in (path for path in paths if kinds[path] == "N"):
            with lines_of(path, faults) as lines:
                for message in read_navigation(lines):
                    if isinstance(message, GlonassEphemeris):
                        channels[message.satellite] = message.channel
                    yield message
        for path in (path for path in paths if kinds[path] == "O"):
            with lines_of(path, faults) as lines:
                yield from read_observations(lines, channels, RECEIVER)

    return Imported(url, read)


@contextmanager
def lines_of(path: Path, faults: Faults) -> Iterator[Lines]:
    """Lines of a file while it is open; what was damaged is noted when it is closed."""
    with _open(path) as file:
        lines = Lines(_decoded(file, path.name, faults))
        yield lines
    if lines.damaged:
        text = f"{lines.damaged} damaged lines or records were skipped, the first noticed at {lines.first_damage}"
        faults.add(path.name, text)


def _open(path: Path) -> BinaryIO:
    """The file as bytes, unpacked where it is gzipped."""
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    return cast(BinaryIO, gzip.open(path)) if packed else path.open("rb")


def _decoded(file: BinaryIO, name: str, faults: Faults) -> Iterator[str]:
    try:
        while line := file.readline(LONGEST_LINE):
            yield line.decode("ascii", "replace")
    except (OSError, EOFError, zlib.error) as error:
        faults.add(name, f"ends within its compression ({error})")


def kind_of(url: str, path: Path) -> str:
    """O (observation) or N (navigation): what the header of a file says that it is.

    Raises SourceError for a file that cannot be read, or that is neither in version 2 or 3.
    """
    try:
        with lines_of(path, Faults()) as lines:
            head = [line for line in islice(lines, HEADER_LINES) if line[60:80].strip() == "RINEX VERSION / TYPE"]
    except OSError as error:
        raise SourceError(f"source {url!r}: {str(path)!r} cannot be read: {error.strerror}") from error
    kind = {"O": "O", "N": "N", "G": "N"}.get(head[0][20:21]) if head else None
    if kind is None or head[0][:9].strip()[:1] not in ("2", "3"):
        raise SourceError(f"source {url!r}: {str(path)!r} is no RINEX observation or navigation file of version 2 or 3")
    return kind
