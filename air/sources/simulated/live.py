"""A simulated flight at the pace of time: its devices, as whoever senses the real ones sees them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

from air.devices.status import DeviceStatus, Watch
from air.sources.known import Known
from air.sources.simulated.flown import Heard, SimulatedFlight
from common.measurements import Measurement

BEHIND_S = 1.0
"""From so much on it is said that the computer does not keep up."""


class LiveFlight:
    """The measurements of a flight, each when its time has come; ends with the flight, or when it is closed."""

    def __init__(self, flight: SimulatedFlight, now_s: Callable[[], float] = time.monotonic):
        self._flight, self._now_s = flight, now_s
        self._closed = threading.Event()
        self._watches: dict[str, Watch] = {}

    @property
    def known(self) -> Known:
        """What was calibrated before the flight."""
        return self._flight.known

    def statuses(self) -> list[DeviceStatus]:
        """How each device that was heard is doing now."""
        return [watch.status(self._now_s(), {}) for watch in list(self._watches.values())]

    def correct(self, data: bytes) -> None:
        """Nothing: the simulated receiver takes no corrections."""

    def close(self) -> None:
        """End the iteration."""
        self._closed.set()

    def __iter__(self) -> Iterator[Measurement]:
        begun_s: float | None = None
        for heard in self._flight.heard():
            begun_s = self._now_s() - heard.t_s if begun_s is None else begun_s
            behind_s = self._now_s() - begun_s - heard.t_s
            if self._closed.wait(max(0.0, -behind_s)):
                return
            self._note(heard, behind_s)
            yield from heard.measurements

    def _note(self, heard: Heard, behind_s: float) -> None:
        """Keep what is told of a device."""
        now_s = self._now_s()
        if heard.device not in self._watches:
            self._watches[heard.device] = Watch(heard.device, "simulated")
            self._watches[heard.device].opened(now_s)
        watch = self._watches[heard.device]
        watch.received(now_s, heard.size, heard.frames, heard.dropped, [type(m).__name__ for m in heard.found])
        slow = behind_s > BEHIND_S
        watch.note(f"{behind_s:.1f} s behind: this computer is too slow for the flight" if slow else "")
