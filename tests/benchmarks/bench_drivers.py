"""Drivers: how many messages of a device they read in a second, and how many times faster than they come.

One thread. A stream is played through a new driver in pieces of 4096 bytes; the best of three times counts.

python tests/benchmarks/bench_drivers.py
"""

import io
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import pyubx2
from figures import Figure, recording

from air.sensors import ubx
from air.sensors.gnss_ublox import UbloxReceiver
from air.sensors.imu_xsens import XsensImu
from air.sensors.mavlink import MavlinkVehicle
from air.sensors.ubx_messages import NAV_PVT, RXM_RAWX
from common.mavlink import Stamps

CHUNK = 4096
RATE_HZ = 10
REPEATS = 3


@dataclass(frozen=True)
class Stream:
    """Bytes of a device, how long it took to send them, and how its driver is made."""

    name: str
    data: bytes
    duration_s: float
    driver: Callable


def ubx_stream():
    """The ZED-F9P of the recordings, which measured once a second, with each epoch and solution ten times."""
    frames = pyubx2.UBXReader(io.BytesIO((recording("gnss") / "nhm.ubx").read_bytes()), protfilter=7, parsing=False)
    out, seconds = [], 0
    for raw, _ in frames:
        fast = raw[:2] == ubx.SYNC and ubx.message_of(raw) in (RXM_RAWX, NAV_PVT)
        out.append(raw * (RATE_HZ if fast else 1))
        seconds += raw[:2] == ubx.SYNC and ubx.message_of(raw) == RXM_RAWX
    return Stream("u-blox F9P, 10 Hz, 40 signals", b"".join(out), seconds, UbloxReceiver)


def xbus_stream():
    """The MTi of the recordings: 47.5 s at 100 Hz, taken as half as long at 200 Hz."""
    (path,) = recording("xsens").glob("*.bin")
    return Stream("Xsens MTi, 200 Hz", path.read_bytes(), 47.46 / 2, XsensImu)


def mavlink_stream():
    """The telemetry log of the recordings: 185 s of 104 messages/s from an ArduPilot."""
    path = recording("cuav") / "testimgs" / "flight.tlog"
    return Stream("MAVLink, 100 messages/s", path.read_bytes(), 185.0, partial(MavlinkVehicle, stamps=Stamps.TLOG))


def play(stream):
    """CPU time, s, and the frames that the driver counted."""
    driver = stream.driver()
    begun = time.process_time()
    for at in range(0, len(stream.data), CHUNK):
        driver.feed(stream.data[at : at + CHUNK], 0)
    return time.process_time() - begun, sum(driver.counts.frames.values())


def peer(data):
    """CPU time, s, of pyubx2 for the same bytes, without making measurements of them."""
    begun = time.process_time()
    for _ in pyubx2.UBXReader(io.BytesIO(data), protfilter=7, quitonerror=0):
        pass
    return time.process_time() - begun


def main():
    """Runs the benchmark."""
    print("| device | messages/s | MB/s | × real time | target |\n| --- | --- | --- | --- | --- |")
    times = Figure("", "×", 0, least=20)
    gnss = ubx_stream()
    for stream in (gnss, xbus_stream(), mavlink_stream()):
        taken, messages = min(play(stream) for _ in range(REPEATS))
        speed = (
            f"{messages / taken:.0f} | {len(stream.data) / taken / 1e6:.1f} | {times.cell(stream.duration_s / taken)}"
        )
        print(f"| {stream.name} | {speed} | {times.target} |")
    taken = peer(gnss.data)
    print(f"\npyubx2 alone reads the bytes of the F9P {gnss.duration_s / taken:.0f} times faster than they come.\n")


if __name__ == "__main__":
    main()
