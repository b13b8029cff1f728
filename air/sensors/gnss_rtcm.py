"""A base station's receiver that speaks RTCM 3: bytes → its epochs, each with the place where its antenna stands."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from air.gnss.msm import is_last, is_read, parse_msm
from air.sensors.driver import Counts, TimeScale
from common import rtcm
from common.arrays import F64
from common.framing import FrameScanner
from common.measurements import BASE, GnssEpoch, Measurement

AGAIN_NS = 60_000_000_000
"""What is so much older than the last epoch, or less, has come twice or too late."""


class RtcmReceiver:
    """The driver of a base station: messages 1005 or 1006, and MSM4 to MSM7 of GPS, GLONASS, Galileo, BeiDou and QZSS.

    The messages of one instant become one epoch, also where the last of them is lost. They do not tell the week: until
    `near_ns`, GPST to half a week, is set, there are no epochs.
    """

    def __init__(self, device: str = BASE, near_ns: int | None = None) -> None:
        self._device = device
        self.near_ns = near_ns
        self._counts = Counts()
        self._scanner = FrameScanner(self._counts, {rtcm.PREAMBLE: rtcm.probe})
        self._place: tuple[int, F64] | None = None
        self._parts: list[GnssEpoch] = []
        self._last_ns: int | None = None
        self._sent_ns = 0

    @property
    def device(self) -> str:
        """Name of the device, which is the receiver's in its epochs."""
        return self._device

    @property
    def scale(self) -> TimeScale:
        """GNSS time."""
        return TimeScale.GNSS

    @property
    def counts(self) -> Counts:
        """Bytes and frames so far, by number; refused are those that made no sense, came twice or before the time."""
        return self._counts

    @property
    def faults(self) -> tuple[str, ...]:
        """What is missing of what it should send."""
        measured = any(rtcm.is_msm(int(name.removeprefix("RTCM-"))) for name in self._counts.frames)
        silent = "the base station does not say where it stands; let it send RTCM 1005 or 1006"
        return (silent,) if measured and self._place is None else ()

    @property
    def sent_ns(self) -> int:
        """When the bytes fed last arrived: the way from the base takes any time."""
        return self._sent_ns

    def start(self) -> bytes:
        """Nothing: it is far away."""
        return b""

    def feed(self, data: bytes, t_ns: int) -> list[Measurement]:
        """The epochs that these bytes complete; `t_ns` tells only when they were sent."""
        self._sent_ns = t_ns
        return [epoch for frame in self._scanner.feed(data) for epoch in self._epochs(frame)]

    def _epochs(self, frame: bytes) -> Iterable[GnssEpoch]:
        number, payload = rtcm.message_number(frame), rtcm.payload_of(frame)
        self._counts.frames[f"RTCM-{number}"] += 1
        if (p_ecef := rtcm.parse_place(payload)) is not None:
            self._place = rtcm.station_of(payload), p_ecef
        if not rtcm.is_msm(number):
            return
        part = self._part(payload) if is_read(number) else None
        if part is not None:
            if self._parts and part.t_ns != self._parts[0].t_ns:
                yield self._whole()
            self._parts.append(part)
        if self._parts and is_last(payload):
            yield self._whole()

    def _part(self, payload: bytes) -> GnssEpoch | None:
        """What a message adds to an epoch, if anything."""
        part = None if self.near_ns is None else parse_msm(payload, self.near_ns, self._device)
        if part is None or self._is_old(part) or self._is_foreign(payload):
            self._counts.refused += 1
            return None
        return part if part.satellites else None

    def _is_old(self, part: GnssEpoch) -> bool:
        return self._last_ns is not None and 0 <= self._last_ns - part.t_ns < AGAIN_NS

    def _is_foreign(self, payload: bytes) -> bool:
        """Whether another station than the one whose place is known measured it."""
        return self._place is not None and rtcm.station_of(payload) != self._place[0]

    def _whole(self) -> GnssEpoch:
        parts, self._parts = self._parts, []
        self._last_ns = self.near_ns = parts[0].t_ns
        return replace(_joined(parts), p_ecef=None if self._place is None else self._place[1])


def _joined(parts: list[GnssEpoch]) -> GnssEpoch:
    """Epochs of the same instant as one."""
    columns: dict[str, list[Any]] = {f.name: [getattr(part, f.name) for part in parts] for f in fields(GnssEpoch)}
    changed: dict[str, Any] = {n: np.concatenate(c) for n, c in columns.items() if isinstance(c[0], np.ndarray)}
    changed |= {name: sum(columns[name], ()) for name in ("satellites", "signals")}
    return replace(parts[0], **changed)
