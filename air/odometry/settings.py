"""The settings of the odometry, with defaults that work for a multirotor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from common.config import Range


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the feature tracker; lengths in px of the full image.

    About `features` points are kept, at most one within `spacing`; a point must return to where it came from within
    `forward_backward` when it is tracked back, and agree with the motion of the others within `epipolar`. `quality` is
    the least strength of a new corner as a share of the strongest.
    """

    features: Annotated[int, Range(8, 5000)] = 160
    spacing: Annotated[float, Range(2.0, 500.0)] = 40.0
    quality: Annotated[float, Range(1e-5, 1.0)] = 0.005
    window: Annotated[int, Range(5, 101)] = 21
    levels: Annotated[int, Range(0, 8)] = 3
    forward_backward: Annotated[float, Range(0.05, 10.0)] = 0.5
    epipolar: Annotated[float, Range(0.1, 20.0)] = 1.5
    border: Annotated[int, Range(0, 200)] = 12


@dataclass(frozen=True)
class OdometrySettings:
    """Settings of the odometry."""

    tracker: TrackerSettings = field(default_factory=TrackerSettings)
