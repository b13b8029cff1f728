"""A file of the bytes that a device sent, played through the driver of that device."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from air.sensors.driver import Counts, Driver
from air.sources.source import Problem, Truth
from common.errors import SourceError
from common.measurements import Measurement

CHUNK_BYTES = 4096


class DeviceFile:
    """The measurements in a file of raw bytes, opened as `ubx:FILE`, `xbus:FILE` and so on.

    The file says nothing about when its bytes arrived: the driver is told 0, and stamps come from the device. Every
    iteration plays the file from its beginning through a new driver. Raises SourceError for a file that is missing
    or cannot be read.
    """

    def __init__(self, url: str, path: str, driver: Callable[[], Driver]):
        self._url = url
        self._path = Path(path).expanduser()
        self._new_driver = driver
        self._driver = driver()
        self._problems: list[Problem] = []
        try:
            with self._path.open("rb"):
                pass
        except OSError as error:
            raise SourceError(
                f"source {url!r}: the file {str(self._path)!r} cannot be read: {error.strerror}"
            ) from error

    @property
    def url(self) -> str:
        """The URL that opened the file."""
        return self._url

    @property
    def truth(self) -> Truth | None:
        """None: nobody knows the truth of a real flight."""
        return None

    @property
    def counts(self) -> Counts:
        """What the driver has seen so far in the latest iteration."""
        return self._driver.counts

    @property
    def problems(self) -> Sequence[Problem]:
        """Bytes that were dropped, frames that made no sense, and a file that ended early, once the iteration ends."""
        return self._problems

    def __iter__(self) -> Iterator[Measurement]:
        self._driver, self._problems = self._new_driver(), []
        try:
            with self._path.open("rb") as file:
                while chunk := file.read(CHUNK_BYTES):
                    yield from self._driver.feed(chunk, 0)
        except OSError as error:
            self._note(f"cannot be read to its end: {error.strerror}")
        counts = self._driver.counts
        if counts.dropped_bytes:
            self._note(f"bytes of no frame: {counts.dropped_bytes} of {counts.received_bytes}, bursts: {counts.bursts}")
        if counts.missing:
            self._note(f"frames that the device numbered and that never came: {counts.missing}")
        if counts.refused:
            self._note(f"frames that made no sense, or had no time yet: {counts.refused}")

    def _note(self, text: str) -> None:
        self._problems.append(Problem(self._path.name, text))
