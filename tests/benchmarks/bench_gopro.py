"""A drone's video without any calibration: `luojia-air calibrate flight`, then the odometry, against the drone's own
local velocity.

python tests/benchmarks/bench_gopro.py
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from figures import Figure, print_table, recording

from air.odometry.odometry import Odometry
from air.sensors.calibration import read_calibration
from air.sources.source import open_source
from common.measurements import CameraFrame, ImuSample, ReceiverSolution, VehicleState
from common.messages import Pose


def command(*arguments):
    """Run a command of `luojia-air` as a program of its own; the seconds it took."""
    begun = time.monotonic()
    subprocess.run([sys.executable, "-m", "air", *arguments, "--quiet"], check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - begun


def fly(url, calibration):
    """GPST ns of the first frame, and the poses, of a flight."""
    odometry, first_ns, poses = Odometry(read_calibration(calibration), "bench"), None, []
    for message in open_source(url):
        if isinstance(message, CameraFrame):
            first_ns = first_ns or message.t_ns
        if isinstance(message, CameraFrame | ImuSample | ReceiverSolution):
            poses += [output for output in odometry.feed(message) if isinstance(output, Pose)]
    return first_ns, poses


def compared(url, poses):
    """Rms and median relative difference of the speeds, and their mean ratio.

    The drone's samples reach the camera late by some tenths of a second, which counts as our error here.
    """
    first_ns = poses[0].t_ns
    at_s = np.array([(pose.t_ns - first_ns) * 1e-9 for pose in poses])
    ours = np.array([np.linalg.norm(pose.v_world) for pose in poses])
    told = [m for m in open_source(url) if isinstance(m, VehicleState) and m.v_enu is not None]
    t_s = np.array([(m.t_ns - first_ns) * 1e-9 for m in told])
    drone = np.array([np.linalg.norm(m.v_enu) for m in told])
    inside = (at_s > t_s[0]) & (at_s < t_s[-1])
    ratio = ours[inside] / np.interp(at_s[inside], t_s, drone)
    return [np.sqrt(np.mean((ratio - 1) ** 2)), np.median(np.abs(ratio - 1)), ratio.mean()]


def main():
    """Print the table."""
    url = f"gopro:{recording('karma') / 'karma.mp4'}"
    with tempfile.TemporaryDirectory() as out:
        calibration = Path(out) / "gopro.toml"
        calibrating_s = command("calibrate", "flight", url, "--out", str(calibration))
        first_ns, poses = fly(url, calibration)
    if not poses:
        sys.exit("the odometry did not begin")
    begin_s, end_s = ((poses[i].t_ns - first_ns) * 1e-9 for i in (0, -1))
    figures = [
        Figure("time to calibrate", "s", 0),
        Figure("begins after", "s", 1, most=4.0),
        Figure("last pose at", "s", 1, least=11.9),
        Figure("speed against the drone's: rms difference", "%", 1, most=0.15),
        Figure("speed against the drone's: median difference", "%", 1, most=0.15),
        Figure("speed, ours over the drone's: mean", "", 3),
    ]
    values = [calibrating_s, begin_s, end_s, *compared(url, poses)]
    print("GoPro Karma, 12 s forward along a cliff, nothing calibrated beforehand:\n")
    print_table(figures, {"karma.mp4": values})


if __name__ == "__main__":
    main()
