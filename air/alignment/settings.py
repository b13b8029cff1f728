"""The settings of the photo alignment, with defaults that work for drone photos."""

from dataclasses import dataclass


@dataclass(frozen=True)
class AlignmentSettings:
    """Settings of features, matching, resection and adjustment; lengths in metres, image lengths in px.

    Pixel thresholds refer to an image whose longer side is `working_px`; larger photos are reduced to it for features.
    `threads` pairs of photos are matched at once; the result does not depend on it.
    """

    working_px: int = 960
    features: int = 6000
    quick_features: int = 2500
    promising_matches: int = 8
    enough_matches: int = 200
    neighbours: int = 8
    ratio: float = 0.85
    verify_px: float = 2.0
    min_matches: int = 25
    min_resection: int = 20
    resection_px: float = 8.0
    min_angle_deg: float = 1.5
    pixel_sigma: float = 0.4
    max_residual_px: float = 1.0
    observations_per_photo: int = 350
    focal_sigma: float = 0.2
    principal_sigma: float = 0.01
    radial_sigma: float = 0.1
    nadir_sigma_deg: float = 15.0
    growth: float = 1.5
    moved: float = 0.03
    threads: int = 2
