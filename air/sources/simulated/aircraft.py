"""The simulated aircraft with all its devices and the base station: what truly happens, and what arrives when.

Bytes arrive as a serial port hands them out: in order, late, and cut without regard to frames.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from typing import Protocol

import numpy as np

from air.sensors.driver import Driver
from air.sensors.gnss_rtcm import RtcmReceiver
from air.sensors.gnss_ublox import UbloxReceiver
from air.sensors.imu_xsens import XsensImu
from air.sensors.mavlink import MavlinkVehicle
from air.sources.simulated.camera.video import SimulatedCamera, draw_lens
from air.sources.simulated.clocks import Device, DeviceClock, TransportDelay
from air.sources.simulated.extrinsics import draw_extrinsics
from air.sources.simulated.gnss.antenna import carried_antenna, fixed_antenna
from air.sources.simulated.gnss.base import SimulatedBase
from air.sources.simulated.gnss.constellation import constellation
from air.sources.simulated.gnss.gnss import BASE_STATION, SimulatedReceiver
from air.sources.simulated.gnss.sky import Sky
from air.sources.simulated.imu import SimulatedImu
from air.sources.simulated.motion.multirotor import fly
from air.sources.simulated.options import SimulationOptions
from air.sources.simulated.sites.ground import Ground
from air.sources.simulated.sites.site import Site
from air.sources.simulated.survey import START_NS
from air.sources.simulated.telemetry import SimulatedTelemetry
from common.arrays import F64
from common.errors import SourceError
from common.geo import T_ecef_enu
from common.measurements import CameraFrame
from common.messages import Datum

READ_BYTES = 512
"""A serial port's bridge to USB hands over blocks of so many bytes, whatever messages they cut, and what it holds when
a message ends."""
BASE_OFFSET = np.array([25.0, -40.0])
BASE_MAST = 2.0
IMU_HEIGHT = 0.25
"""Where the base station stands, from home, and how high its antenna and the standing aircraft's IMU are, m."""

CAMERA = "down"
"""Name of the camera."""


class _Sender(Protocol):
    def packets(self) -> Iterator[tuple[float, bytes]]: ...


@dataclass(frozen=True)
class Arrival:
    """What arrived at the host at the true time `t_s`: bytes of a device, or a frame of a camera in its own time."""

    t_s: float
    device: str
    data: bytes | CameraFrame


class Aircraft:
    """A flight as it truly is. Devices are made anew whenever they are asked for, the same every time."""

    def __init__(self, options: SimulationOptions, ground: Ground, datum: Datum):
        """Raises SourceError and ConfigError for options that are impossible together."""
        self.options, self.ground, self.datum = options, ground, datum
        self.start_ns = START_NS
        self.home = np.array([0.0, 0.0, float(ground.height(np.zeros((1, 2)))[0]) + IMU_HEIGHT])
        self.trajectory, self.mission = fly(options.flight, options.seed, options.duration, self.home)
        self.lens, self.nominal_lens = draw_lens(options.camera, options.seed)
        self.extrinsics, self.nominal_extrinsics = draw_extrinsics(options.extrinsics, options.seed)
        self.clocks = {
            device: DeviceClock.draw(options.clock, options.seed, device, options.duration)
            for device in (Device.HOST, Device.IMU, Device.CAMERA, Device.VEHICLE)
        }
        self.sky = Sky(constellation(options.gnss, START_NS, options.seed), options.gnss, datum, START_NS, options.seed)
        if "camera" not in options.off and self.site is None:
            raise SourceError("option 'camera': this site has nothing to see; allowed: camera=off")
        self.receiver()  # an impossible option of theirs is told at once
        self.base()

    @cached_property
    def p_base(self) -> F64:
        """The base station's antenna (3,) m in world."""
        height = float(self.ground.height(self.home[None, :2] + BASE_OFFSET)[0]) + BASE_MAST
        return np.array([*(self.home[:2] + BASE_OFFSET), height])

    @property
    def p_base_ecef(self) -> F64:
        """The base station's antenna (3,) m in ECEF."""
        return T_ecef_enu(self.datum).apply(self.p_base)

    def host_ns(self, t_s: float) -> int:
        """What the clock of the computer on board shows at a true time, ns."""
        return round(float(self.clocks[Device.HOST].device_s(np.array(t_s))) * 1e9)

    def imu(self) -> SimulatedImu:
        """The IMU, at the start of the flight."""
        options = self.options
        return SimulatedImu(self.trajectory, self.datum, options.imu, options.seed, self.clocks[Device.IMU])

    def receiver(self) -> SimulatedReceiver:
        """The GNSS receiver on board, at the start of the flight."""
        antenna = carried_antenna(self.trajectory, self.extrinsics.p_body_antenna, self.datum)
        options, blocked = self.options, self.ground.blocked
        return SimulatedReceiver(
            "gnss", antenna, self.sky, options.gnss, options.seed, options.duration, blocked=blocked
        )

    def base(self) -> SimulatedReceiver:
        """The base station's receiver, at the start of the flight."""
        antenna, options = fixed_antenna(self.p_base, self.datum), self.options
        return SimulatedReceiver(
            "base", antenna, self.sky, options.base, options.seed, options.duration, BASE_STATION, self.ground.blocked
        )

    def telemetry(self) -> SimulatedTelemetry:
        """The drone's telemetry, at the start of the flight."""
        options, clock = self.options, self.clocks[Device.VEHICLE]
        return SimulatedTelemetry(self.trajectory, self.mission, self.datum, options.mavlink, options.seed, clock)

    @property
    def site(self) -> Site | None:
        """The ground, where there is something to see."""
        return self.ground if isinstance(self.ground, Site) else None

    def camera(self) -> SimulatedCamera:
        """The video camera, at the start of the flight, of an aircraft that has one."""
        assert self.site is not None
        options, T_body_cam = self.options, self.extrinsics.T_body_cam
        clock = self.clocks[Device.CAMERA]
        return SimulatedCamera(
            self.site, self.trajectory, T_body_cam, self.lens, options.camera, options.seed, clock, CAMERA
        )

    def drivers(self) -> dict[str, Driver]:
        """New drivers of the devices that are there, by name."""
        options = self.options
        drivers = (
            XsensImu("imu"),
            UbloxReceiver("gnss", baud=options.gnss.baud),
            RtcmReceiver("base", near_ns=self.start_ns),
            MavlinkVehicle("mavlink"),
        )
        return {driver.device: driver for driver in drivers if driver.device not in options.off}

    def arrivals(self) -> Iterator[Arrival]:
        """All that arrives at the host until the end of the flight, in order."""
        merged = heapq.merge(*self._lines(), key=lambda arrival: arrival.t_s)
        return takewhile(lambda arrival: arrival.t_s <= self.options.duration, merged)

    def sent(self, device: str) -> Iterator[tuple[float, bytes]]:
        """What a device sends: the true time s at which the last byte leaves, and the bytes of a message."""
        makers: dict[str, Callable[[], _Sender]] = {
            "imu": self.imu,
            "gnss": self.receiver,
            "base": lambda: SimulatedBase(self.base(), self.p_base_ecef),
            "mavlink": self.telemetry,
        }
        return makers[device]().packets()

    def _lines(self) -> Iterator[Iterator[Arrival]]:
        options = self.options
        lines = (
            ("imu", Device.IMU, options.imu.baud),
            ("gnss", Device.GNSS, options.gnss.baud),
            ("base", Device.BASE, options.base.baud),
            ("mavlink", Device.VEHICLE, None),
        )
        for name, device, baud in lines:
            if name not in options.off:
                packets = self.sent(name)
                delay = TransportDelay(options.clock, options.seed, device)
                yield _arriving(name, packets if baud is None else _read(packets, baud), delay)
        if "camera" not in options.off:
            delay = TransportDelay(options.clock, options.seed, Device.CAMERA)
            yield _arriving(CAMERA, self.camera().frames(), delay)


def _arriving(
    name: str, packets: Iterable[tuple[float, bytes | CameraFrame]], delay: TransportDelay
) -> Iterator[Arrival]:
    for t_s, data in packets:
        yield Arrival(delay.arrival_s(t_s), name, data)


def _read(packets: Iterable[tuple[float, bytes]], baud: int) -> Iterator[tuple[float, bytes]]:
    """What a serial port's bridge hands over when, of messages that follow each other on a line."""
    filled = 0
    for t_s, data in packets:
        begin = 0
        while begin < len(data):
            end = min(len(data), begin + READ_BYTES - filled)
            filled = (filled + end - begin) % READ_BYTES
            yield t_s - 10 * (len(data) - end) / baud, data[begin:end]
            begin = end
