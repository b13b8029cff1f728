"""A synthetic block of nadir photos over a rough or flat ground, with exact truth, for tests of the alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.alignment.bundle import CameraPrior, PosePrior
from common.camera import CameraModel
from common.se3 import SE3, rotation_vector_to_matrix

CAMERA = CameraModel(1280, 960, 1000.0, 1000.0, 642.0, 475.0, k1=-0.05, k2=0.03)
DOWN_CAM = np.array([0.0, 0.0, 1.0])
NADIR = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Scene:
    """Poses (N), points (P, 3) and observations: photo, point (M,), uv (M, 2)."""

    poses: list[SE3]
    points: np.ndarray
    photo: np.ndarray
    point: np.ndarray
    uv: np.ndarray


def scene(lines: int = 3, per_line: int = 5, relief: float = 8.0, pixel_noise: float = 0.3, seed: int = 0) -> Scene:
    """A block of `lines` strips, every second one flown back, 40 m above the ground."""
    rng = np.random.default_rng(seed)
    poses = []
    for line in range(lines):
        for step in range(per_line):
            east = 9.0 * (step if line % 2 == 0 else per_line - 1 - step)
            yaw = rotation_vector_to_matrix(np.array([0, 0, np.pi * (line % 2)]))
            tilt = rotation_vector_to_matrix(rng.normal(0, 0.03, 3))
            poses.append(SE3(yaw @ NADIR @ tilt, np.array([east, 14.0 * line, 40.0]) + rng.normal(0, 0.5, 3)))
    n = 1500
    xy = rng.uniform([-25, -20], [9 * per_line + 20, 14 * lines + 15], (n, 2))
    points = np.column_stack([xy, relief * rng.random(n)])
    rows = []
    for i, T in enumerate(poses):
        uv = CAMERA.project(T.inverse().apply(points))
        seen = np.flatnonzero(((uv > 0) & (uv < [1279, 959])).all(axis=1))
        rows += [(i, j, *(uv[j] + rng.normal(0, pixel_noise, 2))) for j in seen]
    table = np.array(rows)
    often = np.bincount(table[:, 1].astype(int), minlength=n) >= 2
    table = table[often[table[:, 1].astype(int)]]
    return Scene(poses, points, table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])


def pose_prior(p_world: np.ndarray | None, sigma: float = 1.5) -> PosePrior:
    """A prior of a camera that looks down, with a position if one is given."""
    return PosePrior(p_world, np.full(3, sigma), DOWN_CAM, np.radians(15.0))


def camera_prior(guess: CameraModel) -> CameraPrior:
    """The default prior of a first guess."""
    return CameraPrior(guess, 0.2, 0.01, 0.1)
