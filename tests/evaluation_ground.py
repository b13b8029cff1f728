"""A synthetic piece of ground with relief, houses and a known transformation."""

import numpy as np
from scipy.ndimage import map_coordinates

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


def meadow(count: int, seed: int, trees: bool = True) -> np.ndarray:
    """Points (N, 3) m of a site of 110 × 80 m that slopes gently, with clods, kerbs and some trees."""
    rng = np.random.default_rng(seed)
    east, north = rng.uniform(-55, 55, count), rng.uniform(-40, 40, count)
    up = 0.05 * east - 0.02 * north + 1.2 * np.sin(north / 30 + 0.5) * np.cos(east / 38)
    clods = np.random.default_rng(76).normal(0, 0.07, (120, 120))
    up += map_coordinates(clods, [east + 60, north + 60], order=1) + 0.12 * (np.sin(east / 9) > 0.8)
    if trees:
        place = np.random.default_rng(77).uniform(-1, 1, (25, 2)) * [55, 40]
        away = np.linalg.norm(np.column_stack([east, north])[:, None] - place, axis=2).min(axis=1)
        up += np.where(away < 2.5, 6.0 - away**2 / 2 + rng.normal(0, 0.3, count), 0.0)
    return np.column_stack([east, north, up])


def bent(points: np.ndarray, amplitude: float = 0.3) -> np.ndarray:
    """The points lifted and lowered by up to `amplitude` m: a bowl and a wave of 60 m, as a block of photos is bent."""
    east, north = points[:, 0], points[:, 1]
    bowl = ((east / 55) ** 2 + (north / 40) ** 2) - 0.8
    bend = amplitude * (0.6 * bowl + 0.4 * np.sin(east / 10 + 1) * np.cos(north / 12))
    return points + np.column_stack([0 * east, 0 * east, bend])
