"""A simulated flight with raw GNSS and an IMU, without a camera, for tests and benchmarks of the odometry."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from heapq import merge

import numpy as np
from gnss_scene import BASE_WORLD, broadcast
from odometry_scene import HOME, Scene

from air.gnss.gnss_time import SECOND_NS
from air.odometry.estimator import Estimate, Estimator
from air.odometry.tracker import TrackedFrame
from air.sources.simulated.clocks import ClockOptions, Device, DeviceClock
from air.sources.simulated.extrinsics import ExtrinsicsOptions, draw_extrinsics
from air.sources.simulated.gnss.antenna import carried_antenna, fixed_antenna
from air.sources.simulated.gnss.constellation import constellation
from air.sources.simulated.gnss.gnss import BASE_STATION, SimulatedReceiver
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.gnss.sky import Sky
from air.sources.simulated.imu import ImuOptions, SimulatedImu
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.simulated.motion.multirotor import fly
from air.sources.simulated.motion.trajectory import Trajectory
from air.sources.simulated.survey import START_NS
from common.arrays import F64
from common.geo import T_ecef_enu, T_world_other
from common.measurements import GnssEpoch, ImuSample
from common.messages import Datum

DATUM = Datum("gnss-flight", 30.5355, 114.3655, 62.0)
BASE_ECEF = T_ecef_enu(DATUM).apply(BASE_WORLD)


@dataclass(frozen=True, eq=False)
class GnssFlight:
    """The truth of a flight, and all that is measured on it in order of time."""

    trajectory: Trajectory
    p_body_antenna: tuple[float, ...]
    messages: list[object]
    start_ns: int = START_NS

    def truth(self, t_ns: int) -> tuple[F64, F64, F64]:
        """Position, velocity in world and attitude at a time."""
        motion = self.trajectory.at(np.array([(t_ns - START_NS) / SECOND_NS]))
        return motion.p_world[0], motion.v_world[0], motion.R_world_body[0]


def flight(
    seed: int = 1,
    duration_s: float = 120.0,
    options: FlightOptions | None = None,
    gnss: GnssOptions | None = None,
    imu: ImuOptions | None = None,
    base: GnssOptions | None = None,
) -> GnssFlight:
    """A flight with all errors on unless options say otherwise; the stamps of the IMU are right."""
    options, gnss, imu = options or FlightOptions(), gnss or GnssOptions(), imu or ImuOptions()
    trajectory, _ = fly(options, seed, duration_s, HOME)
    true, nominal = draw_extrinsics(ExtrinsicsOptions(), seed)
    above = Sky(constellation(gnss, START_NS, seed), gnss, DATUM, START_NS, seed)
    antenna = carried_antenna(trajectory, true.p_body_antenna, DATUM)
    receiver = SimulatedReceiver("gnss", antenna, above, gnss, seed, duration_s)
    streams = [((START_NS + round(o.t_s * SECOND_NS), o.epoch) for o in receiver.observations())]
    if base is not None:
        standing = SimulatedReceiver(
            "base", fixed_antenna(BASE_WORLD, DATUM), above, base, seed, duration_s, BASE_STATION
        )
        streams.append((START_NS + round(o.t_s * SECOND_NS), o.epoch) for o in standing.observations())
    clock = DeviceClock.draw(ClockOptions.perfect(), seed, Device.IMU, duration_s)
    felt = SimulatedImu(trajectory, DATUM, imu, seed, clock)
    streams.append(_samples(felt, imu.delay_s))
    timed = merge(*streams, key=lambda pair: pair[0])
    return GnssFlight(
        trajectory,
        tuple(nominal.p_body_antenna.tolist()),
        [*broadcast(above, duration_s), *(message for _, message in timed)],
    )


def _samples(imu: SimulatedImu, delay_s: float) -> Iterator[tuple[int, ImuSample]]:
    for batch in imu.batches():
        for i, t_s in enumerate((batch.t_s - delay_s).tolist()):
            t_ns = START_NS + round(t_s * SECOND_NS)
            yield t_ns, ImuSample(t_ns, batch.accel[i], batch.gyro[i])


def with_frames(flown: GnssFlight, scene: Scene) -> list[object]:
    """The measurements of a flight, and what a tracker saw on the same one, in order of time."""
    frames = [(m.t_ns, m) for m in scene.sensed() if isinstance(m, TrackedFrame)]
    heard = [m for m in flown.messages if isinstance(m, ImuSample | GnssEpoch)]
    told = [m for m in flown.messages if not isinstance(m, ImuSample | GnssEpoch)]
    return [*told, *(m for _, m in merge(((m.t_ns, m) for m in heard), frames, key=lambda pair: pair[0]))]


def estimates(estimator: Estimator, messages: Iterable[object]) -> list[Estimate]:
    """What an estimator says of a flight."""
    out, waiting = [], list[TrackedFrame]()
    for message in messages:
        if isinstance(message, ImuSample):
            estimator.add_imu(message)
            while waiting and waiting[0].t_ns <= message.t_ns:
                outcome = estimator.add_frame(waiting.pop(0))
                out += [outcome] if isinstance(outcome, Estimate) else []
            out += estimator.take_epochs()
        elif isinstance(message, TrackedFrame):
            waiting.append(message)
        elif isinstance(message, GnssEpoch):
            (estimator.gnss.add_base if message.receiver == "base" else estimator.gnss.add_epoch)(message)
        else:
            estimator.gnss.add(message)
    return out


def errors(flown: GnssFlight, poses: list[Estimate], datum: Datum) -> tuple[F64, F64]:
    """Errors (N, 3) m, east, north, up, of poses in the world of a datum, and their normalised squares (N,)."""
    off, squares = [], []
    for pose in poses:
        T = T_world_other(DATUM, datum) @ pose.state.T_world_body
        error = T.t - flown.truth(pose.state.t_ns)[0]
        off.append(error)
        in_body = T.R.T @ error
        squares.append(in_body @ np.linalg.solve(pose.covariance[3:6, 3:6], in_body))
    return np.array(off), np.array(squares)
