"""GNSS and IMU without a camera: simulated flights with all errors on, what each error costs, and a car.

Position errors are those of the causal poses once the world is anchored, as they are and after a rigid alignment.
NEES is that of the position, divided by its three dimensions: 1 is consistent, and for five flights 95 % lie between
0.4 and 1.8. The car's reference is stamped by a phone whose clock is off; by how much, the Doppler velocity tells.

python tests/benchmarks/bench_gnss_inertial.py [seconds]
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from error_sources import GNSS
from figures import recording

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gnss_flight import BASE_ECEF, DATUM, errors, estimates, flight
from tqdm import tqdm

from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS, to_week
from air.gnss.positioning import PointPosition, find_position
from air.gnss.settings import PositioningSettings
from air.odometry.estimator import Estimator
from air.odometry.gnss_settings import GnssNoise, GnssSelection, GnssSettings
from air.odometry.settings import ImuSettings, OdometrySettings
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.source import open_source
from common.geo import T_ecef_enu, T_world_other, ecef_to_geodetic
from common.gravity import normal_gravity
from common.measurements import GnssEpoch, ImuSample
from common.messages import Datum
from ground.evaluation.similarity import umeyama

SEEDS = range(1, 6)
IN_THE_AIR = FlightOptions(start="air")
IMU = ImuSettings(gravity=normal_gravity(DATUM.latitude_deg, DATUM.height))


def main():
    """Print the tables."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 180.0
    flights(seconds)
    budget(seconds)
    car()


def flights(seconds):
    """Five flights, three ways."""
    print("| | seed | from | RMSE | after alignment | most | NEES | CPU s per s |\n|---|---|---|---|---|---|---|---|")
    ways = {"code and Doppler": (False, None), "with carrier": (True, None), "with base station": (True, BASE_ECEF)}
    nees = {}
    for seed in tqdm(SEEDS, "flights", disable=None):
        flown = flight(seed, seconds, IN_THE_AIR, base=GnssOptions.base())
        for name, (carrier, base) in ways.items():
            row, consistency = figures_of(flown, carrier, base, seconds)
            nees.setdefault(name, []).append(consistency)
            print(f"| {name} | {seed} | {' | '.join(row)} |", flush=True)
    means = ", ".join(f"{name} {np.mean(values):.2f}" for name, values in nees.items())
    print(f"\nNEES, mean of all flights: {means}\n", flush=True)


def budget(seconds):
    """What is left when each error of the simulated GNSS is turned off in turn."""
    print("| turned off | code and Doppler | after alignment | with carrier | after alignment |\n|---|---|---|---|---|")
    for name, off in tqdm(({"nothing": {}} | GNSS).items(), "errors", disable=None):
        flown = flight(2, seconds, IN_THE_AIR, gnss=GnssOptions(**off))
        cells = [cell for carrier in (False, True) for cell in figures_of(flown, carrier, None, seconds)[0][1:3]]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    print(flush=True)


def figures_of(flown, carrier, base, seconds):
    """Cells of a row, and the NEES."""
    gnss = GnssSettings(p_body_antenna=flown.p_body_antenna, selection=GnssSelection(carrier=carrier))
    estimator = Estimator(settings=OdometrySettings(gnss=gnss, imu=IMU), base=base)
    begun = time.process_time()
    poses = estimates(estimator, flown.messages)
    spent_s = time.process_time() - begun
    datum = estimator.gnss.datum
    if datum is None or not poses:
        return (["never"] + ["–"] * 5), np.nan
    off, squares = errors(flown, poses, datum)
    ours = np.array([(T_world_other(DATUM, datum) @ pose.state.T_world_body).t for pose in poses])
    left = np.linalg.norm(umeyama(ours, ours - off, with_scale=False).apply(ours) - (ours - off), axis=1)
    since_s = (poses[0].state.t_ns - flown.start_ns) / SECOND_NS
    rmse, aligned, most = rms(np.linalg.norm(off, axis=1)), rms(left), left.max()
    cells = [f"{since_s:.0f} s", *(f"{value:.3f} m" for value in (rmse, aligned, most)), f"{np.mean(squares) / 3:.2f}"]
    return [*cells, f"{spent_s / seconds:.2f}"], float(np.mean(squares) / 3)


def car():
    """comma2k19: single points, and GNSS with the IMU, against the reference."""
    folder = recording("comma2k19") / "segment"
    items = list(open_source(f"comma2k19:{folder}"))
    pose = folder / "global_pose"
    seconds, places, speeds = (np.load(pose / f"frame_{n}") for n in ("gps_times", "positions", "velocities"))
    R = T_ecef_enu(Datum("car", *ecef_to_geodetic(places[0]).tolist())).R

    def reference(values, t_s):
        return np.stack([np.interp(t_s, seconds[:, 1], column) for column in values.T], axis=1)

    broadcast = Ephemerides(items)
    epochs = [item for item in items if isinstance(item, GnssEpoch)]
    fixes = [find_position(epoch, broadcast, PositioningSettings()) for epoch in epochs]
    fixes = [fix for fix in fixes if isinstance(fix, PointPosition) and np.isfinite(fix.velocity).all()]
    t_s = np.array([to_week(fix.t_ns)[1] - fix.clocks["G"] for fix in fixes])
    velocity = np.array([fix.velocity for fix in fixes])
    late_s = min(np.arange(-0.3, 0.3, 0.01), key=lambda s: np.std((velocity - reference(speeds, t_s + s)) @ R[:, :2]))
    shift_ns = round(late_s * SECOND_NS)
    moved = [replace(item, t_ns=item.t_ns - shift_ns) if isinstance(item, ImuSample) else item for item in items]
    moved = sorted(moved, key=lambda item: item.t_ns if isinstance(item, ImuSample | GnssEpoch) else 0)
    imu = ImuSettings(accel_noise=0.05, gyro_noise=0.002, accel_bias_sigma=0.3, gyro_bias_sigma=0.1)
    gnss = GnssSettings(noise=GnssNoise(rate=0.15, multipath=1.5))
    estimator = Estimator(settings=OdometrySettings(gnss=gnss, imu=imu))
    poses, datum = estimates(estimator, moved), estimator.gnss.datum
    own_s = np.array([to_week(pose.state.t_ns)[1] for pose in poses])
    own = T_ecef_enu(datum).apply(np.array([pose.state.T_world_body.t for pose in poses]))
    points = np.array([fix.position for fix in fixes])
    print(f"The reference's clock is {late_s:.2f} s ahead by its velocity.\n")
    print("| car | horizontal RMSE, stamps as they are | most | stamps corrected | most |\n|---|---|---|---|---|")
    for name, t, p in (("single points", t_s, points), ("GNSS and IMU", own_s, own)):
        cells = []
        for shift in (0.0, late_s):
            off = np.linalg.norm((p - reference(places, t + shift)) @ R[:, :2], axis=1)
            cells += [f"{rms(off):.2f} m", f"{off.max():.2f} m"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def rms(values):
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
