"""What a base station's receiver measures, from a link at the ground to the aircraft: as much as a slow radio takes."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

import numpy as np

from common import rtcm
from common.arrays import F64
from common.bus import Bus
from common.clock import Clock
from common.errors import BusError, DeviceError
from common.geo import T_ecef_enu
from common.keys import stream_key
from common.link import Link, open_link
from common.measurements import RawBytes
from common.messages import Datum
from common.streams import RTCM
from common.wire import encode
from ground.config import CorrectionsConfig

log = logging.getLogger(__name__)

DEVICE = "base"
RETRY_S = 1.0
PLACE_EVERY_NS = 10_000_000_000
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


class CorrectionsNode:
    """A thread that reads a link and publishes what is to be sent; a link that breaks is opened again."""

    def __init__(
        self, config: CorrectionsConfig, bus: Bus, clock: Clock, open_it: Callable[[str, int], Link] = open_link
    ) -> None:
        self._config, self._bus, self._clock, self._open_it = config, bus, clock, open_it
        self._key = stream_key(config.vehicle, RTCM)
        self.sent_bytes = 0
        self._fault = ""
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="corrections", daemon=True)

    def start(self) -> None:
        """Begin to read, as soon as the link is there."""
        self._thread.start()

    def close(self) -> None:
        """Stop and let go of the link."""
        self._stopped.set()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                link = self._open_it(self._config.url, self._config.baud)
            except DeviceError as error:
                self._note(str(error))
            else:
                try:
                    self._read(link)
                except OSError as error:
                    self._note(f"{self._config.url}: {error.strerror or error}")
                finally:
                    link.close()
            self._stopped.wait(RETRY_S)

    def _read(self, link: Link) -> None:
        corrections = Corrections(_place(self._config.position))
        while not self._stopped.is_set():
            data = corrections.feed(link.read(), self._clock.now_ns())
            if data:
                self._send(data)

    def _send(self, data: bytes) -> None:
        try:
            self._bus.publish(self._key, encode(RawBytes(self._clock.now_ns(), DEVICE, data)), RTCM)
        except BusError as error:
            self._note(str(error))
        else:
            self.sent_bytes += len(data)
            self._note("")

    def _note(self, fault: str) -> None:
        """Log what is wrong, or that nothing is any more, once."""
        if fault != self._fault:
            self._fault = fault
            if fault:
                log.warning("corrections: %s", fault)
            else:
                log.info("corrections: %s is read again", self._config.url)


def _place(position: tuple[float, ...]) -> F64 | None:
    """ECEF (3,) m of latitude, longitude and height."""
    return T_ecef_enu(Datum("", *position)).apply(np.zeros(3)) if position else None
