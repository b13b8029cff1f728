"""The devices on board as a source: read in threads, stamped in GNSS time, watched."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from air.devices.camera import CameraReader
from air.devices.port import Arrival, Port
from air.devices.settings import DevicesConfig, PortConfig
from air.devices.status import DeviceStatus
from air.sensors.calibration import Calibration
from air.sensors.driver import Driver, TimeScale
from air.sources.known import Known
from air.sources.source import Problem, Truth
from air.timing import Timebase
from common.clock import Clock, SystemClock
from common.errors import SourceError
from common.measurements import FixKind, Measurement, RawBytes, ReceiverSolution
from common.rtcm import RtcmFilter

QUEUE = 2000
"""Arrivals that may wait: more are dropped, for whoever reads is too slow, and memory is finite."""
WAIT_S = 0.1
HOST_TELLS_S = 0.2


class Live:
    """What the devices measure, for ever, until it is closed; opened as `live:FILE.toml`.

    Measurements are held back until GNSS time is known; `RawBytes` never, and carry the computer's time until then.
    Without a GNSS receiver in the settings the computer's clock stands in for it. Iterate once.
    """

    def __init__(self, url: str, devices: DevicesConfig, clock: Clock | None = None) -> None:
        """Raises SourceError when no device is configured, ConfigError for a calibration that cannot be read."""
        if not devices.places:
            raise SourceError(f"source {url!r}: no device is configured; set devices.gnss.port, devices.imu.port, …")
        self._url = url
        self._clock = clock or SystemClock()
        self._arrivals: queue.Queue[Arrival] = queue.Queue(QUEUE)
        self._corrections = RtcmFilter()
        self._dropped = 0
        self._closed = False
        self._timebase = Timebase(
            {"gnss": devices.gnss.delay_s, "imu": devices.imu.delay_s, "mavlink": devices.mavlink.delay_s}
        )
        self._host_tells = "gnss" not in devices.places
        self._host_told_ns = 0
        self._readers: list[Port | CameraReader] = [
            Port(driver, config, self._put) for driver, config in _ports(devices)
        ]
        self._cameras: Mapping[str, Calibration] = {}
        if devices.camera.device:
            camera = CameraReader(devices.camera, self._put)
            self._cameras = camera.calibrations
            self._readers.append(camera)

    @property
    def url(self) -> str:
        """The URL that opened it."""
        return self._url

    @property
    def truth(self) -> Truth | None:
        """None: nobody knows the truth of a real flight."""
        return None

    @property
    def problems(self) -> Sequence[Problem]:
        """What is wrong now: one for each device that is not well."""
        found = [Problem(status.device, status.fault or str(status.state)) for status in self.statuses()]
        well = {status.device for status in self.statuses() if status.well}
        if self._dropped:
            found.append(Problem("live", f"{self._dropped} arrivals were dropped: nobody read them in time"))
        return [problem for problem in found if problem.name not in well]

    @property
    def known(self) -> Known:
        """The calibration of the camera, when there is one."""
        return Known(self._cameras)

    def statuses(self) -> list[DeviceStatus]:
        """How each device is doing now."""
        return [reader.status() for reader in self._readers]

    def correct(self, data: bytes) -> None:
        """Pass the whole RTCM frames among corrections from the ground on to the receiver."""
        frames = self._corrections.feed(data)
        for reader in self._readers:
            if isinstance(reader, Port) and reader.device == "gnss":
                for frame in frames:
                    reader.send(frame)

    def start(self) -> None:
        """Begin to read the devices."""
        for reader in self._readers:
            reader.start()

    def close(self) -> None:
        """Let go of the devices; the iteration ends."""
        self._closed = True
        for reader in self._readers:
            reader.close()

    def __iter__(self) -> Iterator[Measurement]:
        self.start()
        while not self._closed:
            now_ns = time.monotonic_ns()
            self._tell_time_of_day(now_ns)
            try:
                arrival = self._arrivals.get(timeout=WAIT_S)
            except queue.Empty:
                continue
            yield from self._stamped(arrival)
            yield from self._timebase.states(arrival.arrival_ns)

    def _put(self, arrival: Arrival) -> None:
        try:
            self._arrivals.put_nowait(arrival)
        except queue.Full:
            self._dropped += 1

    def _stamped(self, arrival: Arrival) -> Iterator[Measurement]:
        for measurement in arrival.measurements:
            if isinstance(measurement, RawBytes):
                yield replace(measurement, t_ns=self._host_to_gnss(arrival.arrival_ns))
                continue
            stamped = self._timebase.restamp(measurement, arrival.device, arrival.scale, arrival.sent_ns)
            if stamped is not None:
                yield stamped

    def _host_to_gnss(self, host_ns: int) -> int:
        known_ns = self._timebase.gnss_ns(host_ns)
        return self._clock.now_ns() - time.monotonic_ns() + host_ns if known_ns is None else known_ns

    def _tell_time_of_day(self, now_ns: int) -> None:
        if self._host_tells and now_ns - self._host_told_ns > HOST_TELLS_S * 1e9:
            self._host_told_ns = now_ns
            told = time_only(self._clock.now_ns())
            self._timebase.restamp(told, "host", TimeScale.GNSS, time.monotonic_ns())


def open_live(url: str, rest: str) -> Live:
    """The devices that a TOML file of the aircraft's settings names. Raises SourceError and ConfigError."""
    from air.config import AirConfig
    from common.config import load

    if not rest:
        raise SourceError(
            f"source {url!r} needs the settings of the devices: live:FILE.toml, or luojia-air run --config"
        )
    return Live(url, load(Path(rest).expanduser(), AirConfig).devices)


def _ports(devices: DevicesConfig) -> Iterator[tuple[Driver, PortConfig]]:
    """The drivers of the configured ports."""
    # Imported when needed: a driver brings its protocol's library along.
    if devices.gnss.port:
        from air.sensors.gnss_ublox import UbloxReceiver
        from air.sensors.ublox_settings import Port as Connector

        connector = Connector(devices.gnss.connector)
        baud = None if connector is Connector.USB else devices.gnss.baud
        yield UbloxReceiver(port=connector, baud=baud), devices.gnss
    if devices.imu.port:
        from air.sensors.imu_xsens import XsensImu

        yield XsensImu(), devices.imu
    if devices.mavlink.port:
        from air.sensors.mavlink import MavlinkVehicle

        yield MavlinkVehicle("mavlink"), devices.mavlink


def time_only(t_ns: int) -> ReceiverSolution:
    """What a computer tells that stands in for a receiver: GPST ns, and nothing else."""
    nan = float("nan")
    unknown = np.full(3, nan)
    return ReceiverSolution(t_ns, "host", FixKind.TIME_ONLY, nan, nan, nan, nan, nan, unknown, nan, nan, 0)
