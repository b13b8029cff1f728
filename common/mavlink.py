"""MAVLink bytes → `VehicleState`, for aircraft and ground; the only file that knows pymavlink.

Source: the MAVLink guide, packet serialization; telemetry logs (tlog) put 8 bytes before each frame, its arrival in
µs since 1970 (UTC), most significant byte first.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from common.clock import GPST_MINUS_UTC_NS
from common.counts import Counts
from common.measurements import VehicleState
from common.vehicle import LONGEST_TEXT, READERS, Values, values_of, yaw_of

INTERVAL_NS = 100_000_000
"""A vehicle's state is told ten times a second at most."""
CLOCK_JUMP_NS = 1_000_000_000

_V1, _V2 = 0xFE, 0xFD
_MARKER = re.compile(b"[\xfd\xfe]")
_SIGNED = 1
_OVERHEAD = {_V1: 8, _V2: 12}
_SIGNATURE = 13
_STAMP = 8
_YEAR_2000_US, _YEAR_2100_US = 946_684_800_000_000, 4_102_444_800_000_000
_NO_AUTOPILOT = 8
_ARMED = 128


class Stamps(Enum):
    """Where the time stamps of a vehicle's states come from."""

    ARRIVAL = auto()
    """When the bytes arrived, as the caller says."""
    TLOG = auto()
    """The stamps in a telemetry log."""
    BOOT = auto()
    """The messages themselves: time since the autopilot's start, which few of them tell."""


@dataclass(frozen=True)
class Packet:
    """A message that arrived whole: pymavlink's `message`, and its stamp in a telemetry log as GPST ns, or None."""

    t_ns: int | None
    message: Any

    @property
    def name(self) -> str:
        """Name of the message, e.g. ATTITUDE."""
        return str(self.message.get_type())

    @property
    def system(self) -> int:
        """The sender's system id."""
        return int(self.message.get_srcSystem())


class PacketScanner:
    """Finds MAVLink 1 and 2 messages in bytes that may begin anywhere and be damaged; `tlog` for telemetry logs."""

    def __init__(self, counts: Counts, tlog: bool = False) -> None:
        self._counts = counts
        self._lead = _STAMP if tlog else 0
        self._held = b""
        self._in_burst = False
        self._mavlink = dialect.MAVLink(None)

    def feed(self, data: bytes) -> list[Packet]:
        """The messages that these bytes complete."""
        self._counts.received_bytes += len(data)
        held, at, packets = self._held + data, 0, []
        while True:
            marker = _MARKER.search(held, at + self._lead)
            begin = marker.start() - self._lead if marker else max(at, len(held) - self._lead)
            self._drop(begin - at)
            at = begin
            if marker is None:
                break
            end = _end(held, at + self._lead)
            if end is None or end > len(held):
                break
            packet = self._packet(held[at:end])
            if packet is None:
                self._drop(1)
                at += 1
            else:
                packets.append(packet)
                self._counts.frames[packet.name] += 1
                self._in_burst = False
                at = end
        self._held = held[at:]
        return packets

    def _packet(self, record: bytes) -> Packet | None:
        """The packet in exactly these bytes; None when they are none, or of a kind whose checksum nobody knows."""
        t_ns = None
        if self._lead:
            t_us = int.from_bytes(record[:_STAMP], "big")
            if not _YEAR_2000_US <= t_us <= _YEAR_2100_US:
                return None
            t_ns = t_us * 1000 + GPST_MINUS_UTC_NS
        try:
            message = self._mavlink.decode(bytearray(record[self._lead :]))
        except dialect.MAVError:
            return None
        return None if isinstance(message, dialect.MAVLink_unknown) else Packet(t_ns, message)

    def _drop(self, count: int) -> None:
        if count:
            self._counts.dropped_bytes += count
            self._counts.bursts += not self._in_burst
            self._in_burst = True


def _end(held: bytes, marker: int) -> int | None:
    """Where the frame that begins at a marker ends, or None while its length is unknown."""
    if len(held) < marker + 3:
        return None
    signature = _SIGNATURE if held[marker] == _V2 and held[marker + 2] & _SIGNED else 0
    return marker + _OVERHEAD[held[marker]] + held[marker + 1] + signature


class PacketWriter:
    """Writes the messages of one sender, MAVLink 2, numbered as they come."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self._mavlink = dialect.MAVLink(None, srcSystem=system, srcComponent=component)

    def pack(self, name: str, **values: Any) -> bytes:
        """The bytes of a message by its name, e.g. ATTITUDE; values that are not given are zero.

        Raises AttributeError for an unknown message, TypeError for an unknown value.
        """
        kind = getattr(dialect, f"MAVLink_{name.lower()}_message")
        lengths = zip(kind.ordered_fieldnames, kind.array_lengths, strict=True)
        zeros = {field: [0] * length if length else 0 for field, length in lengths}
        data = bytes(kind(**(zeros | values)).pack(self._mavlink))
        self._mavlink.seq = (self._mavlink.seq + 1) % 256
        return data


class Telemetry:
    """The newest state of one vehicle, from the bytes of a link or a log.

    It follows `system`, or the first autopilot that sends a heartbeat. A message that calls a value unknown clears
    what messages of its kind said before, not what others say.
    """

    def __init__(self, system: int | None = None, stamps: Stamps = Stamps.ARRIVAL) -> None:
        self.counts = Counts()
        self.system = system
        self._stamps = stamps
        self._scanner = PacketScanner(self.counts, stamps is Stamps.TLOG)
        self._values: Values = {}
        self._sources: dict[str, str] = {}
        self._yaw: float | None = None
        self._text_id = 0
        self._boot_ns = 0
        self._told_ns: int | None = None

    def feed(self, data: bytes, t_ns: int) -> list[VehicleState]:
        """States that follow from these bytes, ten a second at most; `t_ns` is when they arrived."""
        states = []
        for packet in self._scanner.feed(data):
            if not self._follows(packet):
                continue
            at_ns = self._stamp(packet, t_ns)
            if self._take_in(packet) and self._due(at_ns):
                self._told_ns = at_ns
                states.append(VehicleState(at_ns, packet.system, **self._values))
        return states

    def _follows(self, packet: Packet) -> bool:
        """Whether a packet is from the vehicle; the first heartbeat of an autopilot says who that is."""
        heartbeat = packet.name == "HEARTBEAT" and packet.message.autopilot != _NO_AUTOPILOT
        if self.system is None and heartbeat:
            self.system = packet.system
        return packet.system == self.system and (heartbeat or packet.name in READERS)

    def _stamp(self, packet: Packet, t_ns: int) -> int:
        if self._stamps is Stamps.BOOT:
            boot_ms = getattr(packet.message, "time_boot_ms", 0)
            self._boot_ns = boot_ms * 1_000_000 or self._boot_ns
            return self._boot_ns
        return t_ns if packet.t_ns is None else packet.t_ns

    def _due(self, t_ns: int) -> bool:
        """Whether it is time to tell again: also when the clock jumped back."""
        return self._told_ns is None or not -CLOCK_JUMP_NS < t_ns - self._told_ns < INTERVAL_NS

    def _take_in(self, packet: Packet) -> bool:
        """Whether the message changed what is known."""
        message, name = packet.message, packet.name
        if name in ("ATTITUDE", "ATTITUDE_QUATERNION"):
            self._yaw = yaw_of(message)
        values = _heartbeat(message) if name == "HEARTBEAT" else values_of(message, self._yaw)
        if name == "STATUSTEXT":
            values["text"] = self._joined(message, values["text"])
        for field, value in values.items():
            if value is not None:
                self._values[field], self._sources[field] = value, name
            elif self._sources.get(field) == name:
                self._values[field] = None
        return bool(values)

    def _joined(self, message: Any, text: str) -> str:
        """The text of a message together with the pieces of it that came before."""
        continued = message.id != 0 and message.chunk_seq > 0 and message.id == self._text_id
        self._text_id = message.id
        return ((self._values.get("text") or "") + text)[:LONGEST_TEXT] if continued else text


def _heartbeat(message: Any) -> Values:
    mode = mavutil.mode_string_v10(message)
    named = not mode.startswith("Mode(")
    return {"armed": bool(message.base_mode & _ARMED), "mode": mode if named else None}


def is_tlog(beginning: bytes) -> bool:
    """Whether the first kilobytes of a file are those of a telemetry log, rather than the bytes of a link."""
    dropped = {}
    for tlog in (True, False):
        counts = Counts()
        PacketScanner(counts, tlog).feed(beginning)
        dropped[tlog] = counts.dropped_bytes
    return dropped[True] < dropped[False]
