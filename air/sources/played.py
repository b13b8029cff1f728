"""A recording at the pace of its time stamps: its devices, as whoever senses the real ones sees them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

from air.devices.status import DeviceStatus, Watch
from air.sources.known import Known, known_of
from air.sources.source import Source
from common.measurements import Measurement
from common.messages import Photo

GAP_S = 10.0
"""Longer pauses of the recorder, and stamps that are off, are not waited for."""
BEHIND_S = 1.0
"""From so much on it is said that the computer does not keep up."""
ROLE = "recording"


class Played:
    """The measurements of a source, each when its time has come; ends with the source, or when it is closed."""

    def __init__(self, source: Source, pace: float = 1.0, now_s: Callable[[], float] = time.monotonic) -> None:
        """`pace` 2 plays it twice as fast."""
        self._source, self._pace, self._now_s = source, pace, now_s
        self._closed = threading.Event()
        self._watch = Watch(ROLE, source.url)
        self._watch.opened(now_s())

    @property
    def known(self) -> Known:
        """What was calibrated before the flight."""
        return known_of(self._source)

    def statuses(self) -> list[DeviceStatus]:
        """How the recording is doing, in place of its devices."""
        return [self._watch.status(self._now_s(), {"problems": len(self._source.problems)})]

    def correct(self, data: bytes) -> None:
        """Nothing: what was recorded takes no corrections."""

    def close(self) -> None:
        """End the iteration."""
        self._closed.set()

    def __iter__(self) -> Iterator[Measurement]:
        due_s, latest_ns = self._now_s(), None
        for measurement in self._source:
            if isinstance(measurement, Photo):
                continue
            ahead_s = 0.0 if latest_ns is None else (measurement.t_ns - latest_ns) * 1e-9
            if latest_ns is None or ahead_s > 0.0:
                latest_ns = measurement.t_ns
                due_s += ahead_s / self._pace if ahead_s < GAP_S else 0.0
            behind_s = self._now_s() - due_s
            if self._closed.wait(max(0.0, -behind_s)):
                return
            self._note(measurement, behind_s)
            yield measurement

    def _note(self, measurement: Measurement, behind_s: float) -> None:
        self._watch.received(self._now_s(), 1, 1, 0, [type(measurement).__name__])
        slow = behind_s > BEHIND_S
        self._watch.note(f"{behind_s:.1f} s behind: this computer is too slow for the pace" if slow else "")
