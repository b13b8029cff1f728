"""What is known of where photos were taken before anything is matched."""

from __future__ import annotations

import numpy as np

from air.alignment.bundle import DOWN, PosePrior
from air.alignment.geometry import PairPrior
from common.arrays import F64
from common.geo import geodetic_to_ecef, geodetic_to_enu
from common.messages import Datum, Photo


def position(photo: Photo) -> F64 | None:
    """Where a photo was taken (3,) m, ECEF; None where nothing says."""
    fix = photo.fix
    return None if fix is None else geodetic_to_ecef(fix.latitude_deg, fix.longitude_deg, fix.height)


def pose_prior(photo: Photo, datum: Datum | None, nadir_sigma_deg: float) -> PosePrior:
    """What a photo says of its pose; one that says nothing of its attitude looks down, with a sigma."""
    p_world, p_sigma, fix = None, np.zeros(3), photo.fix
    if fix is not None and datum is not None:
        p_world = geodetic_to_enu(datum, fix.latitude_deg, fix.longitude_deg, fix.height)
        p_sigma = np.array([fix.sigma_horizontal, fix.sigma_horizontal, fix.sigma_vertical])
    down, sigma = -DOWN, float(np.radians(nadir_sigma_deg))
    if photo.R_enu_cam is not None:
        down, sigma = photo.R_enu_cam.T @ DOWN, photo.attitude_sigma
    return PosePrior(p_world, p_sigma, down, sigma)


def step(a: Photo, b: Photo) -> float | None:
    """Distance of two photos by GPS, m; None without fixes."""
    p_a, p_b = position(a), position(b)
    return None if p_a is None or p_b is None else float(np.linalg.norm(p_b - p_a))


def pair_prior(a: Photo, b: Photo, nadir_sigma_deg: float) -> PairPrior:
    """What two photos say of their relative pose."""
    prior_a, prior_b = (pose_prior(photo, None, nadir_sigma_deg) for photo in (a, b))
    sigma, length = float(np.hypot(prior_a.down_sigma, prior_b.down_sigma)), step(a, b)
    if a.fix is None or b.fix is None or not length:
        return PairPrior(prior_a.down_cam, prior_b.down_cam, sigma, 0.0, 1.0)
    height_sigma = float(np.hypot(a.fix.sigma_vertical, b.fix.sigma_vertical)) / length
    descent = (a.fix.height - b.fix.height) / length
    return PairPrior(prior_a.down_cam, prior_b.down_cam, sigma, descent, float(np.hypot(height_sigma, sigma)))
