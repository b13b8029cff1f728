"""Mapping alone, with true poses: time per photo and error of the map against the simulated surface.

python tests/benchmarks/bench_mapping.py [--url sim:survey?seed=1&photos=12] [--method block] [--threads 1]
"""

import argparse
import resource
import time

import cv2
import numpy as np

from air.mapping.mapper import Mapper
from air.mapping.settings import MappingSettings
from air.sources.source import open_photos
from common.messages import Keyframe

WALL_STEP, WALL_DISTANCE = 0.5, 0.5
"""A cell is near a wall where the true surface rises by so much within so far, m."""


def keyframes_of(source):
    """Keyframes at their true poses and the decoded photos of a simulated survey."""
    truth, frames, images = source.truth, [], []
    for i, photo in enumerate(source):
        bgr = cv2.imdecode(np.frombuffer(photo.jpeg, np.uint8), cv2.IMREAD_COLOR)
        images.append(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))
        pose = truth.T_world_cam[i]
        frames.append(Keyframe("bench", i, 1, photo.t_ns, photo.name, pose, truth.camera, np.full(3, 0.01), b""))
    return frames, images


def truth_of(tile, world):
    """True heights (N, N) m of a tile's cells, and whether a cell is near a wall."""
    n, margin = tile.height.shape[0], round(WALL_DISTANCE / tile.cell)
    x, y = ((i * n + np.arange(-margin, n + margin) + 0.5) * tile.cell for i in (tile.id.x, tile.id.y))
    height = world.height(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)).reshape(len(y), len(x))
    size = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    wall = cv2.dilate(height, size) - cv2.erode(height, size) > WALL_STEP
    inner = np.s_[margin:-margin, margin:-margin]
    return height[inner], wall[inner]


def inside_of(tile, footprint):
    """Cells (N, N) of a tile that at least three photos see."""
    west, south, mask = footprint
    n = tile.height.shape[0]
    column, row = (
        np.floor(((i * n + np.arange(n) + 0.5) * tile.cell - start) / 0.5).astype(int)
        for i, start in ((tile.id.x, west), (tile.id.y, south))
    )
    padded = np.pad(mask, 1)
    return padded[np.ix_((row + 1).clip(0, padded.shape[0] - 1), (column + 1).clip(0, padded.shape[1] - 1))]


def print_errors(tiles, truth):
    """Prints the errors of cells that at least three photos agree on, and of the others."""
    footprint = truth.footprint()
    columns = [[], [], [], [], [], []]
    for tile in tiles:
        height, wall = truth_of(tile, truth.world)
        shown = (tile.views >= 3) & ~tile.disputed
        values = (tile.height - height, tile.sigma, wall, shown, np.isfinite(tile.height), inside_of(tile, footprint))
        for column, value in zip(columns, values, strict=True):
            column.append(value.ravel())
    error, sigma, wall, shown, known, inside = (np.concatenate(c) for c in columns)
    print(
        f"{'cells':34}{'number':>9}{'bias':>8}{'median':>8}{'mean':>8}{'95 %':>8}{'99.5 %':>8}{'max':>7}{'complete':>9}"
    )
    for name, cells, place in (
        ("3 views or more, away from walls", shown, ~wall),
        ("3 views or more, near walls", shown, wall),
        ("2 views or disputed, no walls", known & ~shown, ~wall),
        ("all known", known, known | ~known),
    ):
        e = error[cells & place]
        if len(e):
            a = np.abs(e)
            complete = np.mean(cells[inside & place])
            print(
                f"{name:34}{len(e):9d}{e.mean():8.3f}{np.median(a):8.3f}{a.mean():8.3f}{np.quantile(a, 0.95):8.3f}"
                f"{np.quantile(a, 0.995):8.3f}{a.max():7.2f}{complete:9.3f}"
            )
    ratio = np.abs(error / sigma)[shown & ~wall]
    print(f"error / sigma: median {np.median(ratio):.2f} (normal: 0.67), beyond 3: {np.mean(ratio > 3):.4f}")


def main():
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", default="sim:survey?seed=1&photos=12")
    parser.add_argument("--method", default="block", choices=["block", "semi-global"])
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    source = open_photos(options.url)
    frames, images = keyframes_of(source)
    settings = MappingSettings(method=options.method, threads=options.threads)
    for run in ("compile", "measured"):
        mapper = Mapper(settings)
        for frame, image in zip(frames, images, strict=True):
            mapper.add_image(frame.index, image)
        wall, cpu = time.perf_counter(), time.process_time()
        tiles = mapper.update("bench", frames[:3] if run == "compile" else frames)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{options.url}, {options.method}, {options.threads} thread(s): {len(frames)} photos, {len(tiles)} tiles")
    print(f"{cpu / len(frames):.3f} s CPU a photo, {wall / len(frames):.3f} s wall, peak {memory:.0f} MiB in all\n")
    print_errors(tiles, source.truth)


if __name__ == "__main__":
    main()
