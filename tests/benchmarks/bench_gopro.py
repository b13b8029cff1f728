"""A drone's video without any calibration: `luojia-air calibrate flight`, then `luojia-air odometry`, against the
drone's own local velocity.

python tests/benchmarks/bench_gopro.py
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from figures import Figure, print_table, recording

from air.sources.source import open_source
from common.export.trajectory import read_tum
from common.measurements import VehicleState

LAGS_S = np.arange(-1.0, 1.01, 0.05)
"""The drone's samples reach the camera late by an unknown time."""
OVER_S = 0.2


def command(*arguments):
    """Run a command of `luojia-air` as a program of its own; the seconds it took."""
    begun = time.monotonic()
    subprocess.run([sys.executable, "-m", "air", *arguments, "--quiet"], check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - begun


def speeds(folder):
    """Times (N,) s and speeds (N,) m/s of a trajectory, each over 0.2 s, as GPST."""
    ours = read_tum(folder / "trajectory.tum")
    t_s = (ours.t_ns - ours.t_ns[0]) * 1e-9
    at_s = np.arange(0.0, t_s[-1] - OVER_S, OVER_S / 2)
    begin, end = (np.stack([np.interp(at_s + d, t_s, p) for p in ours.positions.T], axis=1) for d in (0.0, OVER_S))
    return ours.t_ns[0], at_s + OVER_S / 2, np.linalg.norm(end - begin, axis=1) / OVER_S


def compared(url, folder):
    """Lag s of the drone's telemetry, rms and median relative difference of speed, and the ratio of the means."""
    first_ns, at_s, ours = speeds(folder)
    told = [m for m in open_source(url) if isinstance(m, VehicleState) and m.v_enu is not None]
    t_s = np.array([(m.t_ns - first_ns) * 1e-9 for m in told])
    drone = np.array([np.linalg.norm(m.v_enu) for m in told])

    def differences(lag_s):
        inside = (at_s + lag_s > t_s[0]) & (at_s + lag_s < t_s[-1])
        return ours[inside], np.interp(at_s[inside] + lag_s, t_s, drone)

    lag_s = min(LAGS_S, key=lambda lag: np.sqrt(np.mean(np.square(np.subtract(*differences(lag))))))
    a, b = differences(lag_s)
    return [lag_s, np.sqrt(np.mean((a / b - 1) ** 2)), np.median(np.abs(a / b - 1)), a.mean() / b.mean()]


def main():
    """Print the table."""
    url = f"gopro:{recording('karma') / 'karma.mp4'}"
    with tempfile.TemporaryDirectory() as out:
        calibration = Path(out) / "gopro.toml"
        calibrating_s = command("calibrate", "flight", url, "--out", str(calibration))
        command("odometry", url, "--calibration", str(calibration), "--out", out)
        report = json.loads((Path(out) / "report.json").read_text())
        if report["first_pose_s"] is None:
            sys.exit("the odometry did not begin")
        compared_speeds = compared(url, Path(out))
        last_s = (read_tum(Path(out) / "trajectory.tum").t_ns[-1] - next(iter(open_source(url))).t_ns) * 1e-9
    figures = [
        Figure("time to calibrate", "s", 0),
        Figure("begins after", "s", 1, most=4.0),
        Figure("last pose at", "s", 1, least=11.9),
        Figure("between points and images", "px", 2),
        Figure("the drone's telemetry is late by", "s", 2),
        Figure("speed against the drone's: rms difference", "%", 1, most=0.15),
        Figure("speed against the drone's: median difference", "%", 1, most=0.15),
        Figure("mean speed, ours over the drone's", "", 3),
    ]
    values = [calibrating_s, report["first_pose_s"], last_s, report["reprojection_rms_px"], *compared_speeds]
    print("GoPro Karma, 12 s forward along a cliff, nothing calibrated beforehand:\n")
    print_table(figures, {"karma.mp4": values})


if __name__ == "__main__":
    main()
