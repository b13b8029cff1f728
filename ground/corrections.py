"""What a base station's receiver measures, from a link at the ground to the aircraft: as much as a slow radio takes."""

from __future__ import annotations

from collections.abc import Callable

from common import rtcm
from common.arrays import F64
from common.bus import Bus
from common.clock import Clock
from common.geo import geodetic_to_ecef
from common.keys import stream_key
from common.link import Link, open_link
from common.measurements import BASE, RawBytes
from common.streams import RTCM
from common.wire import encode
from ground.config import CorrectionsConfig
from ground.link_reader import LinkReader

PLACE_EVERY_NS = 10_000_000_000
ENOUGH_BYTES = 10_000
"""Among so many there is a frame, or never."""
_PASSED = {1230, 1033}
"""Besides measurements and places: biases of GLONASS codes, and the kind of receiver."""


class Corrections:
    """What is sent of what a receiver says: measurements once a second, the place every ten (core: no link, no clock).

    A place that the settings give replaces the receiver's own, which may be some metres off.
    """

    def __init__(self, p_ecef: F64 | None = None) -> None:
        """`p_ecef` (3,) m is where the antenna stands, where that is better known than by the receiver."""
        self.filter = rtcm.RtcmFilter()
        self._p_ecef = p_ecef
        self._seconds: dict[int, int] = {}
        self._placed_ns: int | None = None

    def feed(self, data: bytes, now_ns: int) -> bytes:
        """The frames to send, of those that these bytes complete."""
        return b"".join(out for frame in self.filter.feed(data) for out in self._of(frame, now_ns))

    def _of(self, frame: bytes, now_ns: int) -> list[bytes]:
        number, payload = rtcm.message_number(frame), rtcm.payload_of(frame)
        if rtcm.is_msm(number):
            second = rtcm.second_of(payload)
            if self._seconds.get(number) == second:
                return []
            self._seconds[number] = second
            return [*self._placed(rtcm.station_of(payload), now_ns), frame]
        if number in rtcm.PLACES:
            return [frame] if self._p_ecef is None and self._is_due(now_ns) else []
        return [frame] if number in _PASSED else []

    def _placed(self, station: int, now_ns: int) -> list[bytes]:
        if self._p_ecef is None or not self._is_due(now_ns):
            return []
        return [rtcm.frame(rtcm.pack_place(station, self._p_ecef))]

    def _is_due(self, now_ns: int) -> bool:
        """Whether the place is to be told now, which it then is."""
        due = self._placed_ns is None or not 0 <= now_ns - self._placed_ns < PLACE_EVERY_NS
        if due:
            self._placed_ns = now_ns
        return due


class CorrectionsNode(LinkReader):
    """Publishes what is to be sent."""

    def __init__(
        self, config: CorrectionsConfig, bus: Bus, clock: Clock, open_it: Callable[[str, int], Link] = open_link
    ) -> None:
        super().__init__("corrections", config.url, config.baud, self._publish, open_it)
        self._bus, self._clock = bus, clock
        self._key = stream_key(config.vehicle, RTCM)
        self._corrections = Corrections(_place(config.position))

    def _publish(self, data: bytes) -> bool:
        passed = self._corrections.feed(data, self._clock.now_ns())
        counts = self._corrections.filter.counts
        if counts.received_bytes > ENOUGH_BYTES and not counts.frames:
            self._note("no RTCM 3 arrives; check the baud rate, and that the receiver sends it")
        if passed:
            self._bus.publish(self._key, encode(RawBytes(self._clock.now_ns(), BASE, passed)), RTCM)
        return bool(passed)


def _place(position: tuple[float, ...]) -> F64 | None:
    """ECEF (3,) m of latitude, longitude and height."""
    return geodetic_to_ecef(*position) if position else None
