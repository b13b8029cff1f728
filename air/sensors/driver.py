"""What every driver looks like: bytes in, measurements out."""

from __future__ import annotations

from enum import Enum, auto
from typing import Protocol

from common.counts import Counts as Counts
from common.measurements import Measurement


class TimeScale(Enum):
    """Which clock the time stamps of a driver's measurements come from."""

    GNSS = auto()
    """GPST, as the receiver knows it."""
    DEVICE = auto()
    """The device's own counter, unwrapped, in ns from any start."""
    ARRIVAL = auto()
    """The arrival of the bytes at the host: the protocol has no time stamps."""


class Driver(Protocol):
    """Turns the bytes of one device into measurements. Never raises for any bytes, never holds more than a frame."""

    @property
    def device(self) -> str:
        """Short name of the device, e.g. gnss or imu."""
        ...

    @property
    def scale(self) -> TimeScale:
        """Where the time stamps of its measurements come from."""
        ...

    @property
    def counts(self) -> Counts:
        """What it has seen so far."""
        ...

    @property
    def faults(self) -> tuple[str, ...]:
        """What is wrong with the device or its set-up, as far as it says so itself: a line each."""
        ...

    @property
    def sent_ns(self) -> int:
        """When what `feed` gave last was sent, in the host's time, at the latest: as it arrived, or sooner."""
        ...

    def feed(self, data: bytes, t_ns: int) -> list[Measurement]:
        """Measurements that these bytes complete. `t_ns` is when they arrived, in the host's time."""
        ...

    def start(self) -> bytes:
        """Bytes that set the device up, to be sent when it is opened; empty when it needs none."""
        ...
