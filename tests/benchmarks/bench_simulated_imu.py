"""The simulated flight and its IMU: Allan deviations, what a perfect IMU integrates to, what wind does, and CPU time.

python tests/benchmarks/bench_simulated_imu.py [--seconds 3600]
"""

import argparse
import time
from dataclasses import replace

import numpy as np
from figures import Figure, print_table

from air.sensors.imu_xsens import RATE_HZ, XsensImu
from air.sources.simulated.clocks import ClockOptions, Device, DeviceClock
from air.sources.simulated.imu import G, ImuOptions, SimulatedImu
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.simulated.motion.multirotor import fly
from air.sources.simulated.telemetry import MavlinkOptions, SimulatedTelemetry
from common.gravity import normal_gravity
from common.messages import Datum
from common.se3 import rotation_angle, rotation_vector_to_matrix

DATUM = Datum("2024-06-01T09-00-00-bench", 30.5355, 114.3655, 62.0)
FLIGHT_S = 300.0
FLOWN = slice(120 * RATE_HZ, 180 * RATE_HZ)


def imu_of(trajectory, seed, options, clocks):
    """The IMU of a flight."""
    clock = DeviceClock.draw(clocks, seed, Device.IMU, trajectory.duration_s)
    return SimulatedImu(trajectory, DATUM, options, seed, clock)


def allan(values, steps):
    """Overlapping Allan deviation over so many samples, the root mean square of three axes."""
    total = np.cumsum(values, axis=0)
    second = total[2 * steps :] - 2 * total[steps:-steps] + total[: -2 * steps]
    return np.sqrt(np.mean(second**2) / 2) / steps


def at_rest(seed, seconds):
    """Noise densities µg/√Hz and °/s/√Hz at 1 s, and Allan deviations µg and °/h at 100 s."""
    trajectory = fly(FlightOptions(mission="stand"), seed, seconds, np.zeros(3))[0]
    batches = list(imu_of(trajectory, seed, ImuOptions(), ClockOptions()).batches())
    accel = np.concatenate([b.accel for b in batches]) / G * 1e6
    gyro = np.degrees(np.concatenate([b.gyro for b in batches]))
    long = 100 * RATE_HZ
    return allan(accel, RATE_HZ), allan(gyro, RATE_HZ), allan(accel, long), 3600 * allan(gyro, long)


def strapdown(trajectory, seed):
    """How far a perfect IMU is from the truth after a minute of lines and turns: m and rad."""
    batches = list(imu_of(trajectory, seed, replace(ImuOptions.perfect(), earth_rate=0), ClockOptions()).batches())
    t_s, accel, gyro = (np.concatenate([getattr(b, n) for b in batches])[FLOWN] for n in ("t_s", "accel", "gyro"))
    step_s = np.gradient(t_s)
    ends = trajectory.at(np.array([t_s[0] - step_s[0] / 2, t_s[-1] + step_s[-1] / 2]))
    p, v, R = ends.p_world[0], ends.v_world[0], ends.R_world_body[0]
    gravity = np.array([0.0, 0.0, -normal_gravity(DATUM.latitude_deg, DATUM.height)])
    for force, omega, dt in zip(accel, gyro, step_s, strict=True):
        v_new = v + dt * (R @ rotation_vector_to_matrix(omega * dt / 2) @ force + gravity)
        p, v, R = p + dt / 2 * (v + v_new), v_new, R @ rotation_vector_to_matrix(omega * dt)
    return np.linalg.norm(p - ends.p_world[1]), rotation_angle(R.T @ ends.R_world_body[1])


def blown(trajectory, mission):
    """Excursion by wind, root mean square and largest, m; largest lean, °."""
    t_s = np.arange(40, 220, 0.02)
    motion = trajectory.at(t_s)
    away = np.linalg.norm(motion.p_world - mission.reference(40.0, 0.02, len(t_s)).p, axis=1)
    return np.sqrt(np.mean(away**2)), away.max(), np.degrees(np.arccos(motion.R_world_body[:, 2, 2])).max()


def cpu_ms(work):
    """CPU time of some work for a second of flight, ms."""
    begun = time.process_time()
    work()
    return 1000 * (time.process_time() - begun) / FLIGHT_S


def main():
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    seconds = parser.parse_args().seconds
    columns = {}
    for seed in (1, 2):
        trajectory, mission = fly(FlightOptions(), seed, FLIGHT_S, np.zeros(3))
        imu, driver = imu_of(trajectory, seed, ImuOptions(), ClockOptions()), XsensImu()
        clock = DeviceClock.draw(ClockOptions(), seed, Device.VEHICLE, FLIGHT_S)
        bridge = SimulatedTelemetry(trajectory, mission, DATUM, MavlinkOptions(), seed, clock)
        error_m, error_rad = strapdown(trajectory, seed)
        columns[f"seed {seed}"] = (
            *at_rest(seed, seconds),
            1000 * error_m,
            1e9 * error_rad,
            *blown(trajectory, mission),
            cpu_ms(lambda seed=seed: fly(FlightOptions(), seed, FLIGHT_S, np.zeros(3))),
            cpu_ms(lambda imu=imu, driver=driver: [driver.feed(data, 0) for _, data in imu.packets()]),
            cpu_ms(lambda bridge=bridge: list(bridge.packets())),
        )
    figures = (
        Figure("accelerometer noise (data sheet: 60)", "µg/√Hz", 2),
        Figure("gyroscope noise (data sheet: 0.01)", "°/s/√Hz", 5),
        Figure("accelerometer, Allan deviation at 100 s", "µg", 2),
        Figure("gyroscope, Allan deviation at 100 s", "°/h", 2),
        Figure("perfect IMU integrated for 60 s, position", "mm", 4, most=1.0),
        Figure("perfect IMU integrated for 60 s, attitude", "nrad", 3),
        Figure("excursion by wind, root mean square", "m", 2),
        Figure("excursion by wind, largest", "m", 2),
        Figure("lean, largest", "°", 1),
        Figure("CPU time for a second of trajectory", "ms", 2),
        Figure("CPU time for a second of IMU, driver included", "ms", 1),
        Figure("CPU time for a second of telemetry", "ms", 1),
    )
    print_table(figures, columns)


if __name__ == "__main__":
    main()
