"""The visual–inertial odometry: drift over simulated points and simulated video, EuRoC at rest, CPU time and latency.

python tests/benchmarks/bench_odometry.py [--seconds 120] [--seeds 1 2 3] [--video]
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from figures import Figure, print_table, recording

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from odometry_scene import CAMERA, START_NS, T_BODY_CAM, Scene, aligned_rmse

from air.odometry.estimator import Estimate, Estimator
from air.sources.simulated.imu import ImuOptions
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.source import open_source
from common.export.trajectory import read_tum
from common.measurements import ImuSample
from ground.evaluation.trajectories import compare_trajectories, read_trajectories

LOWEST = 25.0
"""m above take-off: what is flown above counts; few of the random points are seen from below."""


def fly(seed, seconds):
    """Estimates of a flight from take-off, their truth (N, 3), and the CPU time s of each frame."""
    scene = Scene(seed, seconds, FlightOptions(), ImuOptions())
    estimator, waiting, estimates, cpu_s = Estimator(CAMERA.fx, T_BODY_CAM), [], [], []
    for message in scene.sensed():
        if isinstance(message, ImuSample):
            estimator.add_imu(message)
        else:
            waiting.append(message)
        while waiting and waiting[0].t_ns <= (estimator.buffer.last_ns or 0):
            begun = time.process_time()
            outcome = estimator.add_frame(waiting.pop(0))
            if isinstance(outcome, Estimate):
                cpu_s.append(time.process_time() - begun)
                estimates.append(outcome)
    truth = np.array([scene.trajectory.at(np.array([(e.state.t_ns - START_NS) * 1e-9])).p_world[0] for e in estimates])
    return estimates, truth, cpu_s


def from_take_off(seed, seconds):
    """The figures of a flight."""
    estimates, truth, cpu_s = fly(seed, seconds)
    high = np.flatnonzero(truth[:, 2] - truth[0, 2] > LOWEST)
    kept = slice(0, high[-1] + 1)
    p = np.array([e.state.T_world_body.t for e in estimates])[kept]
    rmse, scale = aligned_rmse(p, truth[kept])
    travelled = np.linalg.norm(np.diff(truth[kept], axis=0), axis=1).sum()
    errors = p - _turned(truth[kept], p)
    nees = np.mean([_square(e, error) for e, error in zip(estimates[kept], errors, strict=True)])
    end = np.linalg.norm(errors[-1]) / travelled
    return [travelled, rmse, end, scale, nees, np.median(cpu_s), np.quantile(cpu_s, 0.99)]


def _square(estimate, error):
    """The square of an error (3,) m in the odometry's world, in its own sigmas."""
    in_body = estimate.state.T_world_body.R.T @ error
    return in_body @ np.linalg.solve(estimate.covariance[3:, 3:], in_body)


def _turned(p, other):
    """Positions from the first on, turned about the vertical so that they fit others best: the heading is not known."""
    a, b = p - p[0], other - other[0]
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a[:, :2] * b[:, :2]))
    c, s = np.cos(angle), np.sin(angle)
    return a @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + other[0]


def command(source, out):
    """Run `luojia-air odometry` as a program of its own; its report."""
    arguments = [sys.executable, "-m", "air", "odometry", source, "--out", str(out), "--quiet"]
    subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL)
    return json.loads((out / "report.json").read_text())


def at_rest():
    """RMSE m after alignment while EuRoC's frames last: the drone stands, shaken by its rotors."""
    folder = recording("euroc_v101_micro")
    with tempfile.TemporaryDirectory() as out:
        command(f"euroc:{folder}", Path(out))
        last_s = 1403715277.96
        lines = (Path(out) / "trajectory.tum").read_text().splitlines(keepends=True)
        (Path(out) / "excerpt.tum").write_text("".join(x for x in lines if float(x.split()[0]) <= last_s))
        ours, truth = read_trajectories(Path(out) / "excerpt.tum", folder / "V1_01_easy_original_gt_openvins.txt")
        return {row.alignment: row.error.rmse for row in compare_trajectories(ours, truth).rows}["rigid"]


def video(seed, seconds):
    """RMSE m after alignment, scale, and seconds of frames for a second of flight, of simulated video."""
    url = f"sim:playground?seed={seed}&duration={seconds}&base=off&mavlink=off"
    with tempfile.TemporaryDirectory() as out:
        report = command(url, Path(out))
        ours, aircraft = read_tum(Path(out) / "trajectory.tum"), open_source(url).aircraft
    truth = aircraft.trajectory.at((ours.t_ns[::20] - aircraft.start_ns) * 1e-9).p_world
    rmse, scale = aligned_rmse(ours.positions[::20], truth)
    return [rmse, scale, (report["stages_s"]["tracker"] + report["stages_s"]["window"]) / seconds]


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--video", action="store_true", help="also simulated video: minutes for each seed")
    args = parser.parse_args()
    figures = [
        Figure("travelled", "m", 0),
        Figure("RMSE after alignment", "m", 2),
        Figure("error at the end, of the distance", "%", 2, most=0.005),
        Figure("scale", "", 4),
        Figure("NEES of position, 3 expected", "", 1),
        Figure("CPU time of a frame, median", "s", 3, most=0.06),
        Figure("CPU time of a frame, 99 %", "s", 3, most=0.06),
    ]
    flights = {f"seed {seed}": from_take_off(seed, args.seconds) for seed in args.seeds}
    print(f"From take-off to 40 m and along survey lines at 3 m/s, {args.seconds:g} s, without GNSS, 10 frames/s:\n")
    print_table(figures, flights)
    print_table([Figure("EuRoC V1_01, at rest: RMSE", "m", 4, most=0.05)], {"excerpt": [at_rest()]})
    if args.video:
        figures = [
            Figure("RMSE after alignment", "m", 2),
            Figure("scale", "", 4),
            Figure("seconds for a second of 30 frames", "s", 2),
        ]
        print_table(figures, {f"seed {seed}": video(seed, args.seconds) for seed in args.seeds})


if __name__ == "__main__":
    main()
