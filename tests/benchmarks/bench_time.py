"""How well samples are stamped in GNSS time, from arrivals alone: error against the true time of every sample.

python tests/benchmarks/bench_time.py [--seeds 8]
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from figures import Figure, print_table

sys.path.append(str(Path(__file__).resolve().parents[1]))

from clock_scene import Scene, run

VARIANTS = {
    "IMU, USB": {},
    "camera, USB": {"device": "camera"},
    "IMU, serial": {"jitter_s": 1e-3, "read_s": 3.5e-3},
    "IMU, GNSS at 5 Hz": {"gnss_hz": 5.0},
    "IMU, GNSS on a line": {"baud": 921_600},
    "IMU, no steps": {"reset_s": None, "suspend_s": None},
}
FIGURES = (
    Figure("error, median", "ms"),
    Figure("error, 95 %", "ms", most=0.5),
    Figure("error, 95 %, worst seed", "ms"),
    Figure("error, worst sample", "ms"),
    Figure("sigma, median", "ms"),
    Figure("error / sigma, RMS", "", 2),
    Figure("within two sigma", "%", 1),
    Figure("longest time without stamps", "s", 1),
)


def figures(variant, seeds):
    """The figures of a variant, from 30 s on, over all seeds."""
    errors, sigmas, gaps = [], [], []
    for seed in range(seeds):
        result = run(Scene(seed, **variant))
        late = result.t >= 30
        errors.append(1e3 * np.abs(result.error[late]))
        sigmas.append(1e3 * result.sigma[late])
        gaps.append(np.diff(result.t[late]).max())
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    ratio = error / sigma
    worst = max(np.quantile(e, 0.95) for e in errors)
    return [
        *(np.median(error), np.quantile(error, 0.95), worst, error.max()),
        *(np.median(sigma), np.sqrt(np.mean(ratio**2)), np.mean(ratio < 2), max(gaps)),
    ]


def main():
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=8)
    seeds = parser.parse_args().seeds
    print("180 s; jitter 0–8 ms, one message in 100 late by 100 ms, drifts of +20 and −15 ppm, a wrap of the counter;")
    print("a reset of the device and a suspended host, except in the last column. From 30 s on.\n")
    print_table(FIGURES, {name: figures(variant, seeds) for name, variant in VARIANTS.items()})


if __name__ == "__main__":
    main()
