"""A log of ArduPilot, opened as `ardupilot:F.bin`: IMU, GPS and the state of the vehicle.

Source: ArduPilot, "Onboard message log messages" (IMU, GPS, GPA, ATT, POS, BAT, MSG).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from air.gnss.gnss_time import from_week
from air.sources.dataflash import LogMessage, LogScanner
from air.sources.imported import GEOID_SIGMA, Faults, Imported, find_file, reordered
from air.sources.source import Sensed
from common import ned
from common.counts import Counts
from common.errors import SourceError
from common.measurements import FixKind, ImuSample, ReceiverSolution, VehicleState

RECEIVER, SYSTEM = "gps", 1
WANTED = frozenset(("IMU", "GPS", "GPA", "ATT", "POS", "BAT", "MSG", "ARM"))
CHUNK_BYTES = 65_536
_KINDS = {
    2: FixKind.FIX_2D,
    3: FixKind.FIX_3D,
    4: FixKind.DIFFERENTIAL,
    5: FixKind.RTK_FLOAT,
    6: FixKind.RTK_FIXED,
}
_MS_PER_WEEK = 604_800_000


def open_ardupilot(url: str, rest: str) -> Imported:
    """IMU samples in `body` (at the autopilot), solutions of the first receiver, states with every attitude, by time.

    Of several IMUs and receivers the first is read. Stamps are on GNSS time where the log has a GPS with time, late
    by the receiver's latency of some tenths of a second, and else count from the autopilot's start. Heights of the
    receiver are above mean sea level. Raises SourceError for a file that is no such log.
    """
    path = find_file(url, rest)
    with path.open("rb") as file:
        if file.read(3) != b"\xa3\x95\x80":
            raise SourceError(
                f"source {url!r}: {path.name} is no DataFlash log (.bin); it does not begin with a format"
            )
    return Imported(url, partial(_read, path))


def _read(path: Path, faults: Faults) -> Iterator[Sensed]:
    boot_ns = boot_time(messages(path, frozenset(("GPS",)), Faults()))
    if boot_ns is None:
        faults.add(path.name, "has no GNSS time; stamps count from the autopilot's start")
    return reordered(sensed(messages(path, WANTED, faults), boot_ns or 0))


def messages(path: Path, wanted: frozenset[str], faults: Faults) -> Iterator[LogMessage]:
    """The wanted messages of a log, in the order in which they were written."""
    counts = Counts()
    scanner = LogScanner(wanted, counts)
    try:
        with path.open("rb") as file:
            while chunk := file.read(CHUNK_BYTES):
                yield from scanner.feed(chunk)
    except OSError as error:
        faults.add(path.name, f"cannot be read to its end: {error.strerror}")
    scanner.close()
    if counts.dropped_bytes:
        faults.add(path.name, f"{counts.dropped_bytes} bytes in {counts.bursts} bursts are no messages")
    if counts.refused:
        faults.add(path.name, f"{counts.refused} formats contradict themselves")


def boot_time(gps: Iterable[LogMessage]) -> int | None:
    """GPST of the autopilot's start, ns, or None where no GPS tells."""
    starts_ns = []
    for message in gps:
        week, ms, time_us = (message.number(name) for name in ("GWk", "GMS", "TimeUS"))
        if week and ms is not None and time_us is not None and week < 10_000 and ms < _MS_PER_WEEK and time_us < 1e15:
            starts_ns.append(from_week(int(week), ms * 1e-3) - int(time_us) * 1000)
    return int(np.median(starts_ns)) if starts_ns else None


def sensed(log: Iterable[LogMessage], boot_ns: int) -> Iterator[Sensed]:
    """What the messages of a log tell, in their order; `boot_ns` is the GPST of the autopilot's start."""
    vehicle = _Vehicle(boot_ns)
    for message in log:
        time_us = message.values.get("TimeUS")
        if not isinstance(time_us, int) or (message.number("I") or message.number("Inst") or 0) != 0:
            continue
        t_ns = boot_ns + time_us * 1000
        match message.name:
            case "IMU":
                yield from imu_sample(message, t_ns)
            case "GPS":
                yield solution(message, vehicle.accuracy, t_ns)
            case "ATT":
                yield vehicle.state(message, t_ns)
            case _:
                vehicle.take_in(message)


def imu_sample(m: LogMessage, t_ns: int) -> Iterator[ImuSample]:
    """The sample of an IMU message, none where a value is missing or not finite."""
    gyro, accel = ([m.number(f"{kind}{axis}") for axis in "XYZ"] for kind in ("Gyr", "Acc"))
    values = np.array([*accel, *gyro], float)  # None becomes NaN
    if np.isfinite(values).all():
        yield ImuSample(t_ns, accel=ned.flu(values[:3]), gyro=ned.flu(values[3:]), temperature_c=m.number("T"))


def solution(m: LogMessage, accuracy: LogMessage | None, t_ns: int) -> ReceiverSolution:
    """What the receiver said in a GPS message, with the accuracy of the latest GPA message."""

    def number(name: str, of: LogMessage | None = m) -> float:
        value = None if of is None else of.number(name)
        return math.nan if value is None else value

    course, speed = math.radians(number("GCrs")), number("Spd")
    status, satellites = m.number("Status"), m.number("NSats")
    return ReceiverSolution(
        t_ns=t_ns,
        receiver=RECEIVER,
        kind=_KINDS.get(int(status or 0), FixKind.NONE),
        latitude_deg=number("Lat"),
        longitude_deg=number("Lng"),
        height=number("Alt"),
        sigma_horizontal=number("HAcc", accuracy),
        sigma_vertical=math.hypot(number("VAcc", accuracy), GEOID_SIGMA),
        v_enu=np.array([speed * math.sin(course), speed * math.cos(course), -number("VZ")]),
        sigma_velocity=number("SAcc", accuracy),
        sigma_time=math.nan,
        satellites=int(satellites or 0),
    )


@dataclass
class _Vehicle:
    """The latest of what the log said of the vehicle."""

    boot_ns: int
    latest: dict[str, LogMessage] = field(default_factory=dict)

    @property
    def accuracy(self) -> LogMessage | None:
        return self.latest.get("GPA")

    def take_in(self, message: LogMessage) -> None:
        self.latest[message.name] = message

    def state(self, attitude: LogMessage, t_ns: int) -> VehicleState:
        """The state at an attitude message."""
        angles = [attitude.number(name) for name in ("Roll", "Pitch", "Yaw")]
        armed, remaining = self._number("ARM", "ArmState"), self._number("BAT", "RemPct")
        text = self.latest["MSG"].values.get("Message") if "MSG" in self.latest else None
        return VehicleState(
            t_ns=t_ns,
            system=SYSTEM,
            armed=None if armed is None else armed > 0,
            q_enu_body=ned.attitude_of_angles(*np.radians(np.array(angles, float))),
            latitude_deg=self._number("POS", "Lat"),
            longitude_deg=self._number("POS", "Lng"),
            height_msl=self._number("POS", "Alt"),
            height_home=self._number("POS", "RelHomeAlt"),
            battery=None if remaining is None else remaining / 100,
            voltage_v=self._number("BAT", "Volt"),
            current_a=self._number("BAT", "Curr"),
            text=text.split(b"\0")[0].decode("latin-1") if isinstance(text, bytes) else None,
        )

    def _number(self, name: str, column: str) -> float | None:
        message = self.latest.get(name)
        return None if message is None else message.number(column)
