"""A simulated Xsens MTi-300: what it feels on a trajectory, with its errors, as XBus bytes.

Source: Xsens, MTi 100-series product data (noise, bias, ranges, non-orthogonality, g-sensitivity); MT0605P, MTi User
Manual, on its strapdown integration.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from air.sensors.imu_xsens import RATE_HZ, SELF_TEST, TICK_NS
from air.sensors.mtdata2 import DataId, Precision, pack
from air.sensors.xbus import MessageId, frame
from air.sources.simulated.clocks import DeviceClock
from air.sources.simulated.motion.gauss_markov import GaussMarkov
from air.sources.simulated.motion.rotations import exponential, logarithm
from air.sources.simulated.motion.trajectory import Trajectory
from air.sources.simulated.motion.vibration import Vibration
from common.arrays import F64, I64, Bool
from common.config import Range
from common.gravity import earth_rate_enu, normal_gravity
from common.messages import Datum
from common.se3 import matrix_to_quaternion

G = 9.80665
TICK_S = TICK_NS * 1e-9
SAMPLE_TICKS = round(1 / (RATE_HZ * TICK_S))
_CLIPPED_ANY, _CLIPPED_FIRST, _FILTER_VALID = 1 << 19, 8, 1 << 1
_TEMPERATURE_C = 35.0
_HEADING_TIME_S = 120.0
_PRECISIONS = {"float32": Precision.FLOAT32, "fp16.32": Precision.FP16_32, "float64": Precision.FLOAT64}
_TURN_ON, _IN_RUN, _FRAME, _WHITE, _VIBRATION, _ATTITUDE, _MAGNETIC, _LOST = range(40, 48)


@dataclass(frozen=True)
class ImuOptions:
    """The errors of the device; 0 turns one off.

    Noise densities in µg/√Hz and °/s/√Hz; `*_bias*` wander in run (one sigma, correlated over `bias_time_s`),
    `*_turn_on*` stay through a flight (one sigma); scales are relative, one sigma; `g_sensitivity_deg_s` per g.
    `bits` of the converter over twice the range, ranges in g and °/s. `vibration` m/s² and `vibration_deg_s` are the
    root mean squares of what the rotors make in hover, turning at `rotor_hz`. `earth_rate` 1 lets the earth turn.
    `delay_s` is how long before its stamp the middle of a sample's averaging lies: half a sample or more, as it ends
    when it is stamped. `tilt_deg`, `heading_deg` and `magnetic` are errors of what comes besides: the device's own
    attitude and the magnetic field. `lost` is the share of messages that never leave.
    """

    accel_noise_ug: Annotated[float, Range(0, 1e4)] = 60.0
    gyro_noise_deg_s: Annotated[float, Range(0, 10)] = 0.01
    accel_bias_mg: Annotated[float, Range(0, 100)] = 0.015
    gyro_bias_deg_h: Annotated[float, Range(0, 1e4)] = 10.0
    bias_time_s: Annotated[float, Range(1, 1e5)] = 300.0
    accel_turn_on_mg: Annotated[float, Range(0, 1000)] = 3.0
    gyro_turn_on_deg_s: Annotated[float, Range(0, 10)] = 0.2
    accel_scale: Annotated[float, Range(0, 0.1)] = 0.0005
    gyro_scale: Annotated[float, Range(0, 0.1)] = 0.0005
    misalignment_deg: Annotated[float, Range(0, 5)] = 0.05
    g_sensitivity_deg_s: Annotated[float, Range(0, 1)] = 0.003
    bits: Annotated[int, Range(0, 32)] = 20
    accel_range_g: Annotated[float, Range(0, 1000)] = 5.0
    gyro_range_deg_s: Annotated[float, Range(0, 1e5)] = 450.0
    vibration: Annotated[float, Range(0, 100)] = 1.0
    vibration_deg_s: Annotated[float, Range(0, 100)] = 0.6
    rotor_hz: Annotated[float, Range(1, 500)] = 62.0
    earth_rate: Annotated[int, Range(0, 1)] = 1
    delay_s: Annotated[float, Range(0, 0.02)] = 0.0025
    tilt_deg: Annotated[float, Range(0, 45)] = 0.3
    heading_deg: Annotated[float, Range(0, 180)] = 2.0
    magnetic: Annotated[float, Range(0, 1)] = 0.003
    lost: Annotated[float, Range(0, 1)] = 0.0
    precision: Literal["float32", "fp16.32", "float64"] = "float32"
    baud: Annotated[int, Range(230_400, 4_000_000)] = 921_600

    @classmethod
    def perfect(cls) -> ImuOptions:
        """A device without errors, on an earth that turns."""
        return cls(**dict.fromkeys(_ERRORS, 0.0), bits=0, precision="float64")  # type: ignore[arg-type]


_ERRORS = (
    *("accel_noise_ug", "gyro_noise_deg_s", "accel_bias_mg", "gyro_bias_deg_h", "accel_turn_on_mg"),
    *("gyro_turn_on_deg_s", "accel_scale", "gyro_scale", "misalignment_deg", "g_sensitivity_deg_s"),
    *("accel_range_g", "gyro_range_deg_s", "vibration", "vibration_deg_s"),
    *("tilt_deg", "heading_deg", "magnetic", "lost"),
)
"""What is 0 in a perfect device."""


@dataclass(frozen=True, eq=False)
class ImuBatch:
    """Samples of about a second, (N,) or (N, 3): the true time s and the device's ticks of their stamps, specific force
    m/s² and rate of turn rad/s in body axes, and whether an axis of either (N, 6) was out of range."""

    t_s: F64
    ticks: I64
    accel: F64
    gyro: F64
    clipped: Bool


class SimulatedImu:
    """The IMU of a flight.

    A sample is what the strapdown integration of the device gives: the increments of velocity and attitude over one
    sample, free of coning and sculling, divided by its length. So `gyro` is the mean rotation vector per second, and
    `accel` the mean specific force in the axes that the body has in the middle. Gravity is that at the datum.
    `scale_accel` and `scale_gyro` (3, 3) are the true matrices of scale and misalignment.
    """

    def __init__(self, trajectory: Trajectory, datum: Datum, options: ImuOptions, seed: int, clock: DeviceClock):
        self._trajectory = trajectory
        self._options = options
        self._seed = seed
        self._clock = clock
        self._gravity = np.array([0.0, 0.0, normal_gravity(datum.latitude_deg, datum.height)])
        self._earth_rate = earth_rate_enu(datum.latitude_deg) * options.earth_rate
        dip = np.arctan(2 * np.tan(np.radians(datum.latitude_deg)))
        self._magnetic_world = np.array([0.0, np.cos(dip), -np.sin(dip)])  # of a dipole along the earth's axis
        self._draw_errors(trajectory.duration_s)

    def _draw_errors(self, duration_s: float) -> None:
        o, noise = self._options, self._rng(_FRAME).standard_normal((3, 3, 3))
        skew = np.radians(o.misalignment_deg) * (1 - np.eye(3))
        self.scale_accel = np.eye(3) + (o.accel_scale * np.eye(3) + skew) * noise[0]
        self.scale_gyro = np.eye(3) + (o.gyro_scale * np.eye(3) + skew) * noise[1]
        self._g_sensitivity = np.radians(o.g_sensitivity_deg_s) / G * noise[2]
        turn_on = self._rng(_TURN_ON).standard_normal(6)
        self._turn_on = turn_on * np.repeat([o.accel_turn_on_mg * 1e-3 * G, np.radians(o.gyro_turn_on_deg_s)], 3)
        self._in_run = GaussMarkov(self._rng(_IN_RUN), 1.0, o.bias_time_s, duration_s, 6)
        self._in_run_sigma = np.repeat([o.accel_bias_mg * 1e-3 * G, np.radians(o.gyro_bias_deg_h) / 3600], 3)
        self._vibration = Vibration(self._rng(_VIBRATION), o.vibration, np.radians(o.vibration_deg_s), o.rotor_hz)
        self._attitude = GaussMarkov(self._rng(_ATTITUDE), 1.0, _HEADING_TIME_S, duration_s, 3)

    def biases(self, t_s: F64) -> tuple[F64, F64]:
        """True biases (N, 3) m/s² of the accelerometer and (N, 3) rad/s of the gyroscope at times (N,) s."""
        bias = self._turn_on + self._in_run_sigma * self._in_run.at(t_s)
        return bias[:, :3], bias[:, 3:]

    def packets(self) -> Iterator[tuple[float, bytes]]:
        """True time s at which the last byte leaves, and the bytes of a message; for each sample one."""
        precision = _PRECISIONS[self._options.precision]
        lost, line_s, counter = self._rng(_LOST), -np.inf, 0
        for batch in self.batches():
            for i, packets in enumerate(self._messages(batch)):
                ready_s = batch.t_s[i] + max(0.0, 0.5 / RATE_HZ - self._options.delay_s)
                data = frame(MessageId.MT_DATA2, pack({DataId.PACKET_COUNTER: (counter % 2**16,)} | packets, precision))
                line_s = max(line_s, ready_s) + 10 * len(data) / self._options.baud
                counter += 1
                if lost.random() >= self._options.lost:
                    yield float(line_s), data

    def batches(self) -> Iterator[ImuBatch]:
        """The samples of the flight in order, those of about a second at a time."""
        ends_s = self._clock.device_s(np.array([0.0, self._trajectory.duration_s]))
        first, last = np.ceil(ends_s * RATE_HZ - 1e-9).astype(int).tolist()
        for number, begin in enumerate(range(first, last, RATE_HZ)):
            index = np.arange(begin, min(begin + RATE_HZ, last))
            middles = (np.append(index, index[-1] + 1) - 0.5) / RATE_HZ - self._options.delay_s
            accel, gyro = self._felt(self._clock.true_s(middles))
            t_s = self._clock.true_s(index / RATE_HZ)
            accel, gyro = self._measured(number, t_s, accel, gyro)
            accel, accel_clipped = _converted(accel, self._options.accel_range_g * G, self._options.bits)
            gyro, gyro_clipped = _converted(gyro, np.radians(self._options.gyro_range_deg_s), self._options.bits)
            yield ImuBatch(t_s, index * SAMPLE_TICKS, accel, gyro, np.hstack([accel_clipped, gyro_clipped]))

    def _felt(self, edges_s: F64) -> tuple[F64, F64]:
        """Mean specific force and rate of turn (N, 3) between true times (N + 1,) s, in inertial space."""
        motion, dt = self._trajectory.at(edges_s), np.diff(edges_s)[:, None]
        R = motion.R_world_body
        turned = logarithm(np.swapaxes(R[:-1], 1, 2) @ exponential(dt * self._earth_rate) @ R[1:])
        R_middle = exponential(-dt / 2 * self._earth_rate) @ R[:-1] @ exponential(turned / 2)
        coriolis = 2 * np.cross(self._earth_rate, np.diff(motion.p_world, axis=0))
        force = (np.diff(motion.v_world, axis=0) + coriolis) / dt + self._gravity
        return np.einsum("nji,nj->ni", R_middle, force), turned / dt

    def _measured(self, number: int, t_s: F64, accel: F64, gyro: F64) -> tuple[F64, F64]:
        """What the sensing elements make of it."""
        o = self._options
        shaken, turned = self._vibration.shake(self._trajectory.thrust(t_s) / G, 1 / RATE_HZ)
        accel, gyro = accel + shaken, gyro + turned
        accel_bias, gyro_bias = self.biases(t_s)
        white = np.random.default_rng([self._seed, _WHITE, number]).standard_normal((2, RATE_HZ, 3))[:, : len(t_s)]
        accel_noise = o.accel_noise_ug * 1e-6 * G * np.sqrt(RATE_HZ) * white[0]
        gyro_noise = np.radians(o.gyro_noise_deg_s) * np.sqrt(RATE_HZ) * white[1]
        measured_gyro = gyro @ self.scale_gyro.T + accel @ self._g_sensitivity.T + gyro_bias + gyro_noise
        return accel @ self.scale_accel.T + accel_bias + accel_noise, measured_gyro

    def _messages(self, batch: ImuBatch) -> Iterator[dict[int, tuple[float, ...]]]:
        """What each message holds, of a device that its driver has set up."""
        o, R = self._options, self._trajectory.at(batch.t_s).R_world_body
        error = np.radians([o.tilt_deg, o.tilt_deg, o.heading_deg]) * self._attitude.at(batch.t_s)
        R_claimed = exponential(error) @ R
        white = np.random.default_rng([self._seed, _MAGNETIC, int(batch.ticks[0])]).standard_normal(batch.accel.shape)
        magnetic = np.einsum("nji,j->ni", R, self._magnetic_world) + o.magnetic * white
        flags = batch.clipped @ (1 << np.arange(_CLIPPED_FIRST, _CLIPPED_FIRST + 6))
        for i, ticks in enumerate(batch.ticks.tolist()):
            sample = ticks // SAMPLE_TICKS
            packets: dict[int, tuple[float, ...]] = {DataId.SAMPLE_TIME_FINE: (ticks % 2**32,)}
            if sample % RATE_HZ == 0:
                packets[DataId.TEMPERATURE] = (_TEMPERATURE_C,)
            packets[DataId.QUATERNION] = tuple(matrix_to_quaternion(R_claimed[i]).tolist())
            packets[DataId.ACCELERATION] = tuple(batch.accel[i].tolist())
            packets[DataId.RATE_OF_TURN] = tuple(batch.gyro[i].tolist())
            if sample % 2 == 0:
                packets[DataId.MAGNETIC_FIELD] = tuple(magnetic[i].tolist())
            clipped = int(flags[i]) | (_CLIPPED_ANY if flags[i] else 0)
            packets[DataId.STATUS_WORD] = (SELF_TEST | _FILTER_VALID | clipped,)
            yield packets

    def _rng(self, part: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, part])


def _converted(values: F64, limit: float, bits: int) -> tuple[F64, Bool]:
    """Values (N, 3) within ±limit (0: none), in the steps of a converter (0 bits: none); which were beyond it."""
    if limit == 0:
        return values, np.zeros(values.shape, bool)
    clipped = np.abs(values) > limit
    values = np.clip(values, -limit, limit)
    if bits:
        step = 2 * limit / 2**bits
        values = np.rint(values / step) * step
    return values, clipped
