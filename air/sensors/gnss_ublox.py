"""u-blox F9P (and other receivers that speak UBX): bytes → raw epochs, ephemerides and the receiver's own solution."""

from __future__ import annotations

from collections.abc import Iterable

from air.gnss.navigation_message import NavigationMessages
from air.sensors import ubx
from air.sensors.driver import Counts, TimeScale
from air.sensors.ublox_settings import Port, settings_frame
from air.sensors.ubx_messages import ACK_ACK, ACK_NAK, CFG_VALSET, NAV_PVT, RXM_RAWX, RXM_SFRBX, parse_sfrbx
from air.sensors.ubx_pvt import parse_pvt
from air.sensors.ubx_rawx import parse_rawx
from common import rtcm
from common.clock import GPST_MINUS_UTC_NS
from common.framing import FrameScanner
from common.measurements import GnssEpoch, Measurement, ReceiverSolution

_NMEA, _UBX = b"$"[0], ubx.SYNC[0]
_SAME_EPOCH_NS = 20_000_000
"""A solution's time is that of its epoch but for the receiver's clock error."""
_PROBES = {_UBX: ubx.probe, _NMEA: ubx.probe_nmea, rtcm.PREAMBLE: rtcm.probe}


class UbloxReceiver:
    """The driver of a u-blox receiver, which gives GnssEpoch, ephemerides, Ionosphere and ReceiverSolution.

    NMEA and RTCM between UBX frames are counted and left aside. What satellites broadcast waits for the receiver to
    know the time, which takes a second or two. At 10 Hz it sends 17 kB/s: a serial line takes 230400 baud or more,
    and that the settings of `start` leave as it is.

    On a line of `baud` an epoch arrives the later the more signals it holds, 0.35 ms for each at 921600, and so does
    the solution after it. So what counts for `sent_ns` is the first byte of the epoch, for its solution too.
    Without `baud` messages arrive whole, as over USB.
    """

    def __init__(self, device: str = "gnss", port: Port = Port.USB, rate_hz: int = 10, baud: int | None = None) -> None:
        self._device = device
        self._port = port
        self._rate_hz = rate_hz
        self._counts = Counts()
        self._scanner = FrameScanner(self._counts, _PROBES)
        self._navigation = NavigationMessages()
        self._ns_per_byte = 0.0 if baud is None else 10e9 / baud
        self._sent_ns = self._epoch_ns = 0
        self._t_ns: int | None = None
        self._leap_s = GPST_MINUS_UTC_NS // 1_000_000_000
        self._configured: bool | None = None

    @property
    def device(self) -> str:
        """Name of the device, which is the receiver's in its measurements."""
        return self._device

    @property
    def scale(self) -> TimeScale:
        """GNSS time."""
        return TimeScale.GNSS

    @property
    def counts(self) -> Counts:
        """Bytes and frames so far; UBX frames by u-blox's names, NMEA together, RTCM by number."""
        return self._counts

    @property
    def configured(self) -> bool | None:
        """Whether the receiver took the bytes of `start`; None while it has not answered."""
        return self._configured

    @property
    def faults(self) -> tuple[str, ...]:
        """What is wrong with the device or its configuration."""
        refused = "the receiver refuses its settings; is it a ZED-F9P with firmware HPG 1.12 or later?"
        return (refused,) if self._configured is False else ()

    def start(self) -> bytes:
        """The message that sets measurements and messages, in the receiver's memory until it loses power."""
        return settings_frame(self._port, self._rate_hz)

    @property
    def sent_ns(self) -> int:
        """When the first byte of the latest epoch, or of a solution without one, left the receiver."""
        return self._sent_ns

    def feed(self, data: bytes, t_ns: int) -> list[Measurement]:
        """Measurements that these bytes complete, stamped by the receiver; `t_ns` tells only when they were sent."""
        found: list[Measurement] = []
        frames = self._scanner.feed(data)
        left = sum(map(len, frames)) + self._scanner.held
        for frame in frames:
            begun_ns = t_ns - round(left * self._ns_per_byte)
            left -= len(frame)
            for measurement in self._measurements(frame):
                self._note_sent(measurement, begun_ns)
                found.append(measurement)
        return found

    def _note_sent(self, measurement: Measurement, begun_ns: int) -> None:
        """Take note of a message that tells the time, and of when its first byte left."""
        if isinstance(measurement, GnssEpoch):
            self._epoch_ns, self._sent_ns = measurement.t_ns, begun_ns
        elif isinstance(measurement, ReceiverSolution) and abs(measurement.t_ns - self._epoch_ns) > _SAME_EPOCH_NS:
            self._sent_ns = begun_ns

    def _measurements(self, frame: bytes) -> Iterable[Measurement]:
        if frame[0] != _UBX:
            name = "NMEA" if frame[0] == _NMEA else f"RTCM-{rtcm.message_number(frame)}"
            self._counts.frames[name] += 1
            return ()
        message, payload = ubx.message_of(frame), ubx.payload_of(frame)
        self._counts.frames[ubx.name_of(message)] += 1
        if message == RXM_RAWX:
            return self._epoch(payload)
        if message == RXM_SFRBX:
            return self._broadcast(payload)
        if message == NAV_PVT:
            return self._solution(payload)
        if message in (ACK_ACK, ACK_NAK) and payload == CFG_VALSET.to_bytes(2, "big"):
            self._configured = message == ACK_ACK
        return ()

    def _epoch(self, payload: bytes) -> Iterable[Measurement]:
        epoch = parse_rawx(payload, self._device)
        if epoch is None:
            self._counts.refused += 1
            return ()
        self._t_ns = epoch.t_ns
        self._leap_s = self._leap_s if epoch.leap_s is None else epoch.leap_s
        return (epoch,)

    def _broadcast(self, payload: bytes) -> Iterable[Measurement]:
        bits = parse_sfrbx(payload)
        if bits is None:
            self._counts.refused += 1
            return ()
        if self._t_ns is None:
            return ()
        before = self._navigation.refused
        found = self._navigation.add(bits.satellite, bits.signal, bits.words, bits.channel, self._t_ns, self._leap_s)
        self._counts.refused += self._navigation.refused - before
        return found

    def _solution(self, payload: bytes) -> Iterable[Measurement]:
        solution = parse_pvt(payload, self._device)
        if solution is None:
            self._counts.refused += 1
            return ()
        self._t_ns = solution.t_ns
        return (solution,)
