"""Simulated clocks: a host, a GNSS receiver and a device whose messages arrive late, and how well they are mapped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.sensors import ubx
from air.sensors.driver import TimeScale
from air.sensors.gnss_ublox import UbloxReceiver
from air.sensors.imu_xsens import XsensImu
from air.sensors.mtdata2 import DataId, pack
from air.sensors.ubx_messages import NAV_PVT, RXM_RAWX
from air.sensors.ubx_pvt import pack_pvt
from air.sensors.ubx_rawx import pack_rawx
from air.sensors.xbus import MessageId, frame
from air.timing import Timebase
from common.arrays import F64
from common.measurements import CameraFrame, ClockState, Encoding, FixKind, GnssEpoch, ImuSample, ReceiverSolution

START_NS = 1_400_000_000_000_000_000
HOST_NS = 77_000_000_000_000
TICK_S = 1e-4


@dataclass(frozen=True)
class Scene:
    """What happens to the clocks of a flight.

    `device` is imu (200 Hz, its 32-bit counter wraps on the way) or camera (30 Hz, ns). Delays are uniform between 0
    and `jitter_s`, and every hundredth message is `outlier_s` late. `read_s` is how often, on average, a port is
    read (0: at once). `baud` is that of the receiver's serial line (0: none), on which epochs of 90 signals, or of 40
    in every second half minute, come before its solutions. At `reset_s` the device starts anew, at `suspend_s` the
    host's clock stood still for a while.
    """

    seed: int
    device: str = "imu"
    seconds: float = 180.0
    jitter_s: float = 8e-3
    outlier_s: float = 0.1
    read_s: float = 0.0
    drift: float = 20e-6
    host_drift: float = -15e-6
    delay_s: float = 2e-3
    reset_s: float | None = 70.0
    suspend_s: float | None = 110.0
    gnss_hz: float = 10.0
    baud: int = 0


@dataclass(frozen=True, eq=False)
class Result:
    """True time s, error s and claimed sigma s (N,) of the stamps that came; the states that were told."""

    t: F64
    error: F64
    sigma: F64
    states: list[ClockState]


def run(scene: Scene) -> Result:
    """All that arrives at the host goes through the drivers and the time base, in order of arrival."""
    rng = np.random.default_rng(scene.seed)
    rate = 200.0 if scene.device == "imu" else 30.0
    t_device = np.arange(0.0, scene.seconds, 1 / rate) + rng.uniform(0, 1 / rate)
    t_gnss = np.arange(0.0, scene.seconds, 1 / scene.gnss_hz)
    messages = [(a, t, False) for a, t in zip(arrivals(rng, scene, t_device), t_device, strict=True)]
    told = [message(t, scene.baud) for t in t_gnss]
    on_line_s = np.array([10 * len(data) / scene.baud if scene.baud else 0.0 for data in told])
    gnss = dict(zip(t_gnss, told, strict=True))
    messages += [(a, t, True) for a, t in zip(arrivals(rng, scene, t_gnss, on_line_s), t_gnss, strict=True)]
    timebase = Timebase({"gnss": scene.delay_s, scene.device: scene.delay_s})
    receiver = UbloxReceiver(baud=scene.baud or None)
    imu, index, states = XsensImu(), 0, []
    rows = []
    sigma = np.nan
    for arrival, t, is_gnss in sorted(messages):
        arrival_ns = host_ns(scene, arrival)
        if is_gnss:
            for sent in receiver.feed(gnss[t], arrival_ns):
                timebase.restamp(sent, "gnss", TimeScale.GNSS, receiver.sent_ns)
        else:
            sampled, t = sample(scene, imu, t, index)
            index += 1
            stamped = timebase.restamp(sampled, scene.device, TimeScale.DEVICE, arrival_ns)
            if stamped is not None:
                rows.append((t, (stamped.t_ns - START_NS) / 1e9 - t, sigma))
        told = timebase.states(arrival_ns)
        states += told
        sigma = next((s.sigma_s for s in told if s.device == scene.device), sigma)
    t_out, error, sigmas = np.array(rows).T
    return Result(t_out, error, sigmas, states)


def arrivals(rng: np.random.Generator, scene: Scene, t: F64, on_line_s: F64 | float = 0.0) -> F64:
    """When messages arrive, true time s: in order, as on any link. They took so long to be sent, s."""
    late = rng.uniform(0.0, scene.jitter_s, len(t)) + scene.outlier_s * (rng.random(len(t)) < 0.01)
    arrival = np.maximum.accumulate(t + scene.delay_s + on_line_s + late)
    if scene.read_s == 0:
        return arrival
    reads = np.cumsum(rng.uniform(0, 2 * scene.read_s, round(1.2 * scene.seconds / scene.read_s)))
    return reads[np.searchsorted(reads, arrival)]


def host_ns(scene: Scene, t: float) -> int:
    suspended = 3.21 if scene.suspend_s is not None and t >= scene.suspend_s else 0.0
    return HOST_NS + round(((1 + scene.host_drift) * t - suspended) * 1e9)


def sample(scene: Scene, imu: XsensImu, t: float, index: int) -> tuple[ImuSample | CameraFrame, float]:
    """What the device says of its sample at a true time, and that time at the resolution of its counter."""
    since = t - scene.reset_s if scene.reset_s is not None and t >= scene.reset_s else t + 429_496.7296 - 40.0
    if scene.device == "camera":
        t_ns = round(since * (1 + scene.drift) * 1e9)
        return CameraFrame(t_ns, "camera", index, 1, 1, Encoding.MONO8, b""), t
    ticks = int(since * (1 + scene.drift) / TICK_S)
    packets = {
        DataId.PACKET_COUNTER: (index % 2**16,),
        DataId.SAMPLE_TIME_FINE: (ticks % 2**32,),
        DataId.ACCELERATION: (0.0, 0.0, 9.8),
        DataId.RATE_OF_TURN: (0.0, 0.0, 0.0),
    }
    (read,) = imu.feed(frame(MessageId.MT_DATA2, pack(packets)), 0)
    assert isinstance(read, ImuSample)
    return read, t - since + ticks * TICK_S / (1 + scene.drift)


def message(t: float, baud: int) -> bytes:
    """What the receiver sends: its solution, and on a line its raw measurements before it."""
    own = ubx.frame(NAV_PVT, pack_pvt(solution(t), 18))
    if not baud:
        return own
    n = 40 if t % 60 >= 30 else 90
    one = np.ones(n)
    epoch = GnssEpoch(
        *(START_NS + round(t * 1e9) + 300_000, "gnss", ("G05",) * n, ("1C",) * n, 2e7 * one, 1e8 * one, one),
        *(40 * one, one, one == 0, one, one, one, np.zeros(n, np.int32), 18),
    )
    return ubx.frame(RXM_RAWX, pack_rawx(epoch)) + own


def solution(t: float) -> ReceiverSolution:
    place = (47.0, 8.0, 500.0, 1.0, 2.0, np.zeros(3), 0.1, 1e-8, 12)
    return ReceiverSolution(START_NS + round(t * 1e9), "gnss", FixKind.FIX_3D, *place)
