"""The settings of the odometry, with defaults that work for a multirotor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from air.odometry.gnss_settings import GnssSettings
from air.odometry.mounting import MountingSettings
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
class ImuSettings:
    """Noise of the IMU as it flies, with what vibration adds; densities per √Hz in m/s² and rad/s.

    `*_walk` are the random walks of the biases (m/s³, rad/s² per √Hz), `*_sigma` what they may be at the start, and
    `*_step` how far they may move before measurements are integrated anew. After `max_gap_s` without a sample, and
    out of range, the noise is `doubtful_*`. `gravity` m/s².
    """

    accel_noise: Annotated[float, Range(1e-6, 10.0)] = 0.003
    gyro_noise: Annotated[float, Range(1e-7, 1.0)] = 0.0003
    accel_bias_walk: Annotated[float, Range(1e-8, 1.0)] = 0.0005
    gyro_bias_walk: Annotated[float, Range(1e-9, 0.1)] = 2e-5
    accel_bias_sigma: Annotated[float, Range(1e-4, 10.0)] = 0.1
    gyro_bias_sigma: Annotated[float, Range(1e-5, 1.0)] = 0.05
    accel_bias_step: Annotated[float, Range(1e-4, 10.0)] = 0.05
    gyro_bias_step: Annotated[float, Range(1e-5, 1.0)] = 0.002
    max_gap_s: Annotated[float, Range(0.001, 1.0)] = 0.03
    doubtful_accel: Annotated[float, Range(0.01, 100.0)] = 0.5
    doubtful_gyro: Annotated[float, Range(0.001, 10.0)] = 0.05
    gravity: Annotated[float, Range(9.7, 9.9)] = 9.80665


@dataclass(frozen=True)
class WindowSettings:
    """Settings of the sliding window; px of the full image.

    A frame becomes a keyframe once points moved by `parallax_deg` beyond what turning does since the last one, fewer
    than `overlap` of them are left, or after `longest_s`, and every `blind_s` while nothing is seen. A point needs
    `min_angle_deg` between its rays. Observations that miss by more than `max_residual_px` are outliers. `pixel_sigma`
    is larger than their scatter, as what a track drifts stays with it from frame to frame. Up to `anchored` points
    outlive the keyframes that saw them.
    """

    keyframes: Annotated[int, Range(3, 50)] = 10
    parallax_deg: Annotated[float, Range(0.01, 45.0)] = 2.0
    overlap: Annotated[float, Range(0.0, 1.0)] = 0.6
    longest_s: Annotated[float, Range(0.1, 100.0)] = 3.0
    blind_s: Annotated[float, Range(0.1, 100.0)] = 0.9
    pixel_sigma: Annotated[float, Range(0.05, 10.0)] = 2.0
    min_angle_deg: Annotated[float, Range(0.05, 45.0)] = 1.0
    max_residual_px: Annotated[float, Range(0.1, 100.0)] = 4.0
    anchored: Annotated[int, Range(0, 200)] = 30
    iterations: Annotated[int, Range(1, 50)] = 4


@dataclass(frozen=True)
class InitializationSettings:
    """When the odometry may begin.

    At rest: after `still_s` in which the image moves by less than `still_px`; where it shows nothing, accelerations and
    rates must have standard deviations below `still_accel` m/s² and `still_gyro` rad/s. In motion: from `frames` of the
    last `span_s` at most, between which points moved by `parallax_deg`, when the adjustment knows the scale within
    `scale_sigma`; tried every `try_every_s`.
    """

    still_s: Annotated[float, Range(0.2, 60.0)] = 1.0
    still_accel: Annotated[float, Range(0.001, 10.0)] = 0.15
    still_gyro: Annotated[float, Range(0.0001, 1.0)] = 0.01
    still_px: Annotated[float, Range(0.1, 20.0)] = 1.2
    frames: Annotated[int, Range(5, 40)] = 12
    span_s: Annotated[float, Range(0.5, 20.0)] = 6.0
    parallax_deg: Annotated[float, Range(0.1, 45.0)] = 3.0
    scale_sigma: Annotated[float, Range(0.001, 1.0)] = 0.2
    try_every_s: Annotated[float, Range(0.0, 10.0)] = 0.5


@dataclass(frozen=True)
class DegradationSettings:
    """When a part of the estimate counts as lost and as back, and what cannot be true.

    The camera is lost after `lost_s` with fewer than `few_points`, and back after `back_s` with `enough_points`; GNSS
    likewise. After `alone_s` without a frame the IMU alone is no longer believed. A jump of the velocity against the
    IMU by `velocity_jump` m/s from one frame to the next, and biases of more than `bias_sigmas`, are impossible.
    """

    few_points: Annotated[int, Range(0, 1000)] = 8
    enough_points: Annotated[int, Range(1, 1000)] = 15
    few_satellites: Annotated[int, Range(0, 100)] = 4
    enough_satellites: Annotated[int, Range(1, 100)] = 6
    lost_s: Annotated[float, Range(0.0, 60.0)] = 1.0
    back_s: Annotated[float, Range(0.0, 60.0)] = 0.5
    alone_s: Annotated[float, Range(0.1, 600.0)] = 5.0
    velocity_jump: Annotated[float, Range(0.1, 100.0)] = 2.0
    bias_sigmas: Annotated[float, Range(1.0, 100.0)] = 6.0


@dataclass(frozen=True)
class OdometrySettings:
    """Settings of the odometry. `rate_hz` is how often at most the window is solved; every frame is tracked."""

    rate_hz: Annotated[float, Range(1.0, 100.0)] = 10.0

    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    imu: ImuSettings = field(default_factory=ImuSettings)
    initialization: InitializationSettings = field(default_factory=InitializationSettings)
    window: WindowSettings = field(default_factory=WindowSettings)
    gnss: GnssSettings = field(default_factory=GnssSettings)
    mounting: MountingSettings = field(default_factory=MountingSettings)
    degradation: DegradationSettings = field(default_factory=DegradationSettings)
