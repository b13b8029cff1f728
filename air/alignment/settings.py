"""The settings of the photo alignment, with defaults that work for drone photos."""

from dataclasses import dataclass
from typing import Annotated

from common.config import Range

Count = Annotated[int, Range(1, 100_000)]
Pixels = Annotated[float, Range(0.01, 100.0)]


@dataclass(frozen=True)
class AlignmentSettings:
    """Settings of features, matching, resection and adjustment; lengths in metres, image lengths in px.

    Pixel thresholds refer to an image whose longer side is `working_px`; larger photos are reduced to it for features.
    `threads` pairs of photos are matched at once; the result does not depend on it.
    """

    working_px: Annotated[int, Range(64, 100_000)] = 960
    features: Count = 6000
    quick_features: Count = 2500
    promising_matches: Count = 8
    enough_matches: Count = 200
    neighbours: Count = 8
    ratio: Annotated[float, Range(0.1, 1.0)] = 0.85
    verify_px: Pixels = 2.0
    min_matches: Annotated[int, Range(8, 100_000)] = 25
    min_resection: Annotated[int, Range(6, 100_000)] = 20
    resection_px: Pixels = 8.0
    min_angle_deg: Annotated[float, Range(0.0, 45.0)] = 1.5
    pixel_sigma: Pixels = 0.4
    max_residual_px: Pixels = 1.0
    observations_per_photo: Count = 350
    focal_sigma: Annotated[float, Range(1e-6, 1.0)] = 0.2
    principal_sigma: Annotated[float, Range(1e-6, 1.0)] = 0.01
    radial_sigma: Annotated[float, Range(1e-6, 1.0)] = 0.1
    nadir_sigma_deg: Annotated[float, Range(0.1, 180.0)] = 15.0
    growth: Annotated[float, Range(1.0, 100.0)] = 1.5
    moved: Annotated[float, Range(0.0, 100.0)] = 0.03
    threads: Annotated[int, Range(1, 64)] = 2
