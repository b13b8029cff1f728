"""Simulated surveys through `process`, against the truth: cameras, focal length, cloud, and whether it is bowed.

python tests/benchmarks/bench_survey.py [--seeds 1 2 3] [--noises 1.5 0.02] [--photos 60]
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from figures import Figure, print_table, process

from air.sources.source import open_photos
from common.export.projection import UtmProjection
from ground.evaluation.clouds import compare_clouds, read_cloud
from ground.evaluation.similarity import umeyama
from ground.evaluation.trajectories import associate, compare_trajectories, read_trajectories

BOWL_LIMIT = 0.5
"""Larger height errors are those of walls and crowns that stand a cell aside, m."""


def figures(noise):
    """The rows of the table for a noise of the fixes, m."""
    good = noise < 0.1
    return (
        Figure("photos placed", "", 0),
        Figure("cameras after similarity alignment, RMSE", most=None if good else 0.05),
        Figure("cameras after rigid alignment, RMSE", most=0.03 if good else 0.35),
        Figure("focal length, relative error", "%", 2, most=0.01),
        Figure("cloud after rigid alignment, mean", most=0.05 if good else 0.12),
        Figure("cloud after similarity alignment, mean", most=None if good else 0.06),
        Figure("cloud after similarity alignment, median"),
        Figure("completeness after similarity alignment", "%", 1),
        Figure("bowl: mean height error, outer less inner third", most=0.10),
        Figure("scale error of the cameras", "%", 3),
        Figure("… one sigma that the fixes allow", "%", 3),
        Figure("… and the rigid RMSE that it alone gives", digits=3),
        Figure("process, wall time", "s", 0),
    )


def measure(url, noise):
    """The figures of one survey."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        report = process(url, out)
        ours, truth = read_trajectories(out / "trajectory.tum", out / "truth" / "trajectory.tum")
        cameras = {row.alignment: row for row in compare_trajectories(ours, truth).rows}
        cloud, surface = (read_cloud(path) for path in (out / "map.laz", out / "truth" / "surface.laz"))
        clouds = {row.alignment: row for row in compare_clouds(cloud, surface).rows}
    survey = open_photos(url).truth
    spread = np.sqrt(((truth.positions - truth.positions.mean(axis=0)) ** 2).sum())
    return (
        report["photos"]["placed"],
        cameras["similarity"].error.rmse,
        cameras["rigid"].error.rmse,
        abs(report["cameras"][0]["fx"] / survey.camera.fx - 1),
        clouds["rigid"].to_reference.mean,
        clouds["similarity"].to_reference.mean,
        clouds["similarity"].to_reference.median,
        clouds["similarity"].completeness,
        bowl_of(UtmProjection(survey.datum).to_world(cloud.points), ours, truth, survey.world),
        abs(cameras["similarity"].scale - 1),
        noise / spread,
        noise / np.sqrt(len(truth.t_ns)),
        report["wall_s"],
    )


def bowl_of(p_world, ours, truth, world):
    """Mean height error of the third of the points furthest out less that of the third furthest in, m, unsigned.

    The cameras lay the cloud on the world, so that no bowl can be turned or scaled away to fit the surface.
    """
    k, truth_k = associate(ours.t_ns, truth.t_ns)
    p = umeyama(ours.positions[k], truth.positions[truth_k], with_scale=True).apply(p_world)
    error = p[:, 2] - world.height(p[:, :2])
    middle = np.median(error)
    near = np.abs(error - middle) < BOWL_LIMIT
    radius = np.linalg.norm(p[:, :2] - p[:, :2].mean(axis=0), axis=1)
    inner, outer = np.quantile(radius, [1 / 3, 2 / 3])
    return abs(error[near & (radius > outer)].mean() - error[near & (radius < inner)].mean())


def main():
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--noises", type=float, nargs="+", default=[1.5, 0.02])
    parser.add_argument("--photos", type=int, default=60)
    options = parser.parse_args()
    for noise in options.noises:
        print(f"\n{options.photos} photos, fixes of {noise:g} m\n", flush=True)
        columns = {}
        for seed in options.seeds:
            url = f"sim:survey?seed={seed}&photos={options.photos}&gps_noise={noise:g}"
            columns[f"seed {seed}"] = measure(url, noise)
        print_table(figures(noise), columns)


if __name__ == "__main__":
    main()
