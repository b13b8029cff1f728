"""A synthetic piece of ground with relief, houses and a known transformation."""

import numpy as np

from common.se3 import rotation_vector_to_matrix
from ground.evaluation.similarity import Similarity


def ground(count: int, seed: int = 0, side: float = 160.0) -> np.ndarray:
    """Points (N, 3) m on hills, ditches and flat roofs, walls included."""
    rng = np.random.default_rng(seed)
    east, north = rng.uniform(-side / 2, side / 2, (2, count))
    up = 4 * np.sin(east / 23) + 3 * np.cos(north / 17 + 1) + 0.8 * np.sin(east / 5) * np.sin(north / 6)
    house = (np.floor(east / 14) % 4 == 1) & (np.floor(north / 14) % 3 == 1)
    on_wall = house & ((east % 14 < 0.4) | (north % 14 < 0.4))
    up += np.where(house, 5.0, 0.0) * np.where(on_wall, rng.random(count), 1.0)
    return np.column_stack([east, north, up])


def distortion(seed: int, scale: float = 1.0, about: np.ndarray | None = None) -> Similarity:
    """A tilt of 3°, an offset of up to 5 m sideways and 10 m in height, and a scale, about a point."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3) * [1.0, 1.0, 0.3]
    R = rotation_vector_to_matrix(np.radians(3.0) * axis / np.linalg.norm(axis))
    centre = np.zeros(3) if about is None else about
    turn = Similarity(scale, R, rng.uniform(-1, 1, 3) * [5.0, 5.0, 10.0])
    return Similarity.translation(centre) @ turn @ Similarity.translation(-centre)


def degraded(points: np.ndarray, seed: int, noise: float = 0.03, outliers: float = 0.2) -> np.ndarray:
    """The points with Gaussian noise, a share of them flung up to 8 m into the air or 3 m under the ground."""
    rng = np.random.default_rng(seed)
    noisy = points + rng.normal(scale=noise, size=points.shape)
    flung = rng.random(len(points)) < outliers
    noisy[flung, 2] += rng.uniform(-3.0, 8.0, np.count_nonzero(flung))
    return noisy
