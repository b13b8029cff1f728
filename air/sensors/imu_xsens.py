"""Xsens MTi-300 (and other MTi): XBus bytes → `ImuSample`, and the bytes that set the device up.

The housing's frame is x forward, y left, z up, which is `body`. Stamps are the device's 10 kHz counter, unwrapped, at
the middle of the time over which a sample is the mean.
Source: Xsens MT0101P, MT Low Level Communication Protocol; MT0605P, MTi User Manual.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from air.sensors.driver import Counts, TimeScale
from air.sensors.mtdata2 import ENU, NED, NWU, DataId, Packets, unpack
from air.sensors.xbus import FrameScanner, MessageId, frame
from common.arrays import F64
from common.measurements import ImuSample, Measurement

RATE_HZ = 200
TICK_NS = 100_000
USUAL_PERIOD_NS = 1_000_000_000 // RATE_HZ
CLIPPED = 0x1FF << 8 | 1 << 19
"""Bits of the status word: an axis of accelerometer, gyroscope or magnetometer is out of range; any of them is."""
SELF_TEST = 1
"""Bit of the status word and byte: the self test at power-up was passed."""

_EVERY_SAMPLE = 0xFFFF
_MAGNETIC_HZ = 100
_OUTPUTS = (
    (DataId.PACKET_COUNTER, _EVERY_SAMPLE),
    (DataId.SAMPLE_TIME_FINE, _EVERY_SAMPLE),
    (DataId.TEMPERATURE, 1),
    (DataId.QUATERNION, RATE_HZ),
    (DataId.ACCELERATION, RATE_HZ),
    (DataId.RATE_OF_TURN, RATE_HZ),
    (DataId.MAGNETIC_FIELD, _MAGNETIC_HZ),
    (DataId.STATUS_WORD, _EVERY_SAMPLE),
)
_ERRORS = {3: "period", 4: "message", 30: "timer overflow", 32: "baud rate", 33: "parameter", 40: "device error"}


class XsensImu:
    """The driver of an MTi: feeds on the bytes of its port, whatever they are.

    At 200 Hz it sends 17 kB/s, for which a serial line takes 230400 baud or more. What is wrong with the device
    stands in `faults`.
    """

    def __init__(self, device: str = "imu") -> None:
        self._device = device
        self._counts = Counts()
        self._scanner = FrameScanner(self._counts)
        self._clock = _SampleClock()
        self._sent_ns = 0
        self._counter: int | None = None
        self._configured: bool | None = None
        self._error: str | None = None
        self._self_test: bool | None = None
        self._temperature_c: float | None = None

    @property
    def device(self) -> str:
        """Name of the device."""
        return self._device

    @property
    def scale(self) -> TimeScale:
        """The device's own counter."""
        return TimeScale.DEVICE

    @property
    def counts(self) -> Counts:
        """Bytes and frames so far; frames of what is left aside are named after it."""
        return self._counts

    @property
    def faults(self) -> tuple[str, ...]:
        """What the device says is wrong with it or with its configuration."""
        found = []
        if self._error is not None:
            found.append(f"the device refuses a command: {self._error}")
        if self._configured is False:
            found.append(f"the device cannot give acceleration and rate of turn at {RATE_HZ} Hz")
        if self._self_test is False:
            found.append("the self test at power-up failed")
        return tuple(found)

    def start(self) -> bytes:
        """Commands that make the device measure at 200 Hz; its acknowledgements come with the data."""
        outputs = b"".join(struct.pack(">HH", identifier, hz) for identifier, hz in _OUTPUTS)
        return (
            frame(MessageId.GO_TO_CONFIG)
            + frame(MessageId.SET_OUTPUT_CONFIGURATION, outputs)
            + frame(MessageId.GO_TO_MEASUREMENT)
        )

    @property
    def sent_ns(self) -> int:
        """The arrival of the latest bytes."""
        return self._sent_ns

    def feed(self, data: bytes, t_ns: int) -> list[Measurement]:
        """Samples that these bytes complete, stamped by the device; `t_ns` tells only when they arrived."""
        self._sent_ns = t_ns
        samples: list[Measurement] = []
        for message, payload in self._scanner.feed(data):
            if message != MessageId.MT_DATA2:
                self._note(message, payload)
                continue
            unpacked = unpack(payload)
            if unpacked is None:
                self._counts.refused += 1
                continue
            packets, skipped = unpacked
            self._count(packets)
            if sample := self._sample(packets):
                samples.append(sample)
                self._counts.frames["MTData2"] += 1
            else:
                self._counts.frames[" ".join(["MTData2", *skipped])] += 1
        return samples

    def _note(self, message: int, payload: bytes) -> None:
        """Take in an answer or an announcement of the device."""
        known = message in MessageId.__members__.values()
        self._counts.frames[MessageId(message).name if known else f"0x{message:02X}"] += 1
        if message == MessageId.ERROR:
            code = payload[0] if payload else 0
            self._error = f"{_ERRORS.get(code, 'code')} ({code})"
        elif message == MessageId.SET_OUTPUT_CONFIGURATION_ACK:
            given = dict(struct.iter_unpack(">HH", payload[: len(payload) // 4 * 4]))  # what it will do
            rates_hz = [given.get(output, 0) for output in (DataId.ACCELERATION, DataId.RATE_OF_TURN)]
            self._configured = min(rates_hz) >= RATE_HZ

    def _count(self, packets: Packets) -> None:
        """Note gaps of the packet counter, which counts messages with and without samples."""
        if DataId.PACKET_COUNTER in packets:
            counter = int(packets[DataId.PACKET_COUNTER][0])
            if self._counter is not None:
                gap = (counter - self._counter - 1) % 0x10000
                self._counts.missing += gap if gap < 0x8000 else 0  # a step back is a device that started anew
            self._counter = counter

    def _sample(self, packets: Packets) -> ImuSample | None:
        """The sample of a message; None for a message without one, or a sample without time or with nonsense."""
        if DataId.TEMPERATURE in packets:
            self._temperature_c = packets[DataId.TEMPERATURE][0]
        status = packets.get(DataId.STATUS_WORD) or packets.get(DataId.STATUS_BYTE)
        if status is not None:
            self._self_test = bool(int(status[0]) & SELF_TEST)
        motion = packets.get(DataId.ACCELERATION), packets.get(DataId.RATE_OF_TURN)
        increments = packets.get(DataId.DELTA_V), packets.get(DataId.DELTA_Q)
        if None in motion and None in increments:
            return None
        ticks = _ticks(packets)
        if ticks is None:
            self._counts.refused += 1
            return None
        t_ns, period_ns = self._clock.stamp(ticks)
        accel, gyro = motion
        if accel is None or gyro is None:
            if period_ns is None:
                return None
            accel, gyro = _rates(increments[0] or (), increments[1] or (), period_ns * 1e-9)
        # Whatever it gives is the mean over the period that ends at the sample time.
        t_ns -= (period_ns or USUAL_PERIOD_NS) // 2
        if not all(map(math.isfinite, (*accel, *gyro))):
            self._counts.refused += 1
            return None
        return ImuSample(
            t_ns,
            np.array(accel),
            np.array(gyro),
            _finite(packets.get(DataId.MAGNETIC_FIELD)),
            _orientation(packets),
            self._temperature_c,
            status is not None and bool(int(status[0]) & CLIPPED),
        )


class _SampleClock:
    """Unwraps the 32-bit counter of a device and knows the shortest interval between its samples."""

    def __init__(self) -> None:
        self._ticks: int | None = None
        self._period: int | None = None

    def stamp(self, ticks: int) -> tuple[int, int | None]:
        """Device time ns, and the period of the samples ns or None while it is unknown."""
        if self._ticks is None:
            self._ticks = ticks
        else:
            step = (ticks - self._ticks + 2**31) % 2**32 - 2**31
            self._ticks += step
            if step > 0:
                self._period = step if self._period is None else min(step, self._period)
        return self._ticks * TICK_NS, None if self._period is None else self._period * TICK_NS


def _ticks(packets: Packets) -> int | None:
    """Sample time in ticks of 0.1 ms, modulo 2³²; with coarse seconds, fine ticks count within the second."""
    fine, coarse = packets.get(DataId.SAMPLE_TIME_FINE), packets.get(DataId.SAMPLE_TIME_COARSE)
    if coarse is not None and fine is not None:
        return int(coarse[0] * 10_000 + fine[0] % 10_000) % 2**32
    return None if fine is None else int(fine[0])


def _rates(delta_v: tuple[float, ...], delta_q: tuple[float, ...], period_s: float) -> tuple[tuple[float, ...], ...]:
    """Mean specific force m/s² and rate of turn rad/s over a period, from the increments of velocity and attitude."""
    w, *v = delta_q if delta_q[0] >= 0 else [-c for c in delta_q]
    sine = math.hypot(*v)
    per_component = (2 * math.atan2(sine, w) / sine if sine > 0 else 2.0) / period_s
    return tuple(c / period_s for c in delta_v), tuple(c * per_component for c in v)


def _orientation(packets: Packets) -> F64 | None:
    """Attitude wxyz (4,) in ENU, w ≥ 0, from a quaternion in any of the device's three reference systems."""
    root = math.sqrt(0.5)
    for system, (a, x, y, z) in ((ENU, (1.0, 0.0, 0.0, 0.0)), (NED, (0.0, root, root, 0.0)), (NWU, (root, 0, 0, root))):
        q = packets.get(DataId.QUATERNION | system)
        if q is None:
            continue
        if system != ENU:
            w, i, j, k = q
            q = (
                a * w - x * i - y * j - z * k,
                a * i + x * w + y * k - z * j,
                a * j - x * k + y * w + z * i,
                a * k + x * j - y * i + z * w,
            )
        length = math.hypot(*q)
        if not 0.9 < length < 1.1:
            return None
        return np.array(q) * (math.copysign(1.0, q[0]) / length)
    return None


def _finite(values: tuple[float, ...] | None) -> F64 | None:
    return None if values is None or not all(map(math.isfinite, values)) else np.array(values)
