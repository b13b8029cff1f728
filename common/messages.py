"""What flows between the stages: frozen dataclasses in SI units and the frames of the design.

`Message` names those that travel on streams; `Photo` is what a source gives to the aircraft's own cores.

`world` is local ENU at the datum of the flight. `t_ns` is integer nanoseconds of GNSS time at the moment of
sampling (mid-exposure for an image). Arrays are read-only by convention: whoever changes one copies it first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from common.arrays import F32, F64, I32, U8, Bool
from common.camera import CameraModel
from common.measurements import Measurement
from common.se3 import SE3


@dataclass(frozen=True)
class GnssFix:
    """A position: degrees, metres above the WGS84 ellipsoid, one-sigma metres."""

    latitude_deg: float
    longitude_deg: float
    height: float
    sigma_horizontal: float
    sigma_vertical: float


@dataclass(frozen=True, eq=False)
class Photo:
    """One still image of a camera, as its source gave it.

    `jpeg` is the encoded file, maybe damaged. `camera` is a first guess or None when nothing is known.
    `R_enu_cam` (3, 3) is the camera's attitude in local ENU with `attitude_sigma` rad, or None. `revision` is that of
    the odometry's world where the odometry placed the photo, None where it did not.
    """

    t_ns: int
    name: str
    jpeg: bytes
    camera: CameraModel | None
    fix: GnssFix | None
    R_enu_cam: F64 | None = None
    attitude_sigma: float = 0.0
    revision: int | None = None


@dataclass(frozen=True)
class Datum:
    """Origin of the world frame of one flight: degrees, metres above the WGS84 ellipsoid.

    `flight` names the flight (start time as text, so it sorts); every map message carries it.
    """

    flight: str
    latitude_deg: float
    longitude_deg: float
    height: float


class Mode(StrEnum):
    """How the aircraft's pose is known at the moment."""

    INITIALIZING = "initializing"
    GNSS_VISUAL_INERTIAL = "gnss-visual-inertial"
    VISUAL_INERTIAL = "visual-inertial"
    GNSS_INERTIAL = "gnss-inertial"
    INERTIAL = "inertial"
    PHOTOGRAMMETRIC = "photogrammetric"


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of the aircraft: `T_world_body`, velocity (3,) m/s in world or None, position sigma (3,) m."""

    flight: str
    t_ns: int
    revision: int
    T_world_body: SE3
    v_world: F64 | None
    sigma: F64
    mode: Mode


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A camera pose that the map is built from; a higher `revision` of the same `index` replaces it.

    `T_world_cam` with position sigma (3,) m; `camera` as estimated at this revision; `thumbnail` is a small JPEG.
    """

    flight: str
    index: int
    revision: int
    t_ns: int
    name: str
    T_world_cam: SE3
    camera: CameraModel
    sigma: F64
    thumbnail: bytes


def _unknown() -> F64:
    return np.full(3, np.nan)


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """What the odometry believes besides the pose.

    `accel_bias` (3,) m/s² and `gyro_bias` (3,) rad/s; `T_body_cam` and `time_offset_s` (IMU time minus frame time) as
    calibrated or estimated; how many `points` and `satellites` are in use, and the root mean square of the reprojection
    errors.

    NaN is what is unknown of the rest. `clock_s` is the receiver's clock minus GPST by satellite system (RINEX letter),
    and `clock_drift` how fast it grows, s/s; `lever_arm` (3,) m is the antenna in body. `code_rms_m`, `doppler_rms_mps`
    and `carrier_rms_m` are the root mean squares of the residuals of what is in use. One sigma is known of the
    extrinsics: `rotation_sigma` (3,) rad in the camera's axes, `translation_sigma` (3,) m in the body's,
    `time_offset_sigma_s`, `lever_arm_sigma` (3,) m; and of `lens` (3,) px, which is the focal length and the principal
    point of the camera, `lens_sigma` (3,) px.
    """

    flight: str
    t_ns: int
    revision: int
    mode: Mode
    accel_bias: F64
    gyro_bias: F64
    T_body_cam: SE3
    time_offset_s: float
    points: int
    satellites: int
    reprojection_rms_px: float
    clock_s: dict[str, float] = field(default_factory=dict)
    clock_drift: float = math.nan
    lever_arm: F64 = field(default_factory=_unknown)
    code_rms_m: float = math.nan
    doppler_rms_mps: float = math.nan
    carrier_rms_m: float = math.nan
    rotation_sigma: F64 = field(default_factory=_unknown)
    translation_sigma: F64 = field(default_factory=_unknown)
    time_offset_sigma_s: float = math.nan
    lever_arm_sigma: F64 = field(default_factory=_unknown)
    lens: F64 = field(default_factory=_unknown)
    lens_sigma: F64 = field(default_factory=_unknown)


@dataclass(frozen=True, order=True)
class TileId:
    """Place of a tile: cell size doubles per `level`; (x, y) counts tiles east and north of the datum."""

    level: int
    x: int
    y: int


@dataclass(frozen=True, eq=False)
class MapTile:
    """A square of N × N cells of the surface, row 0 at the south edge, column 0 at the west edge.

    Cell (row, col) has its centre at east `(x·N + col + 0.5)·cell`, north `(y·N + row + 0.5)·cell`, both in world.
    `height` (N, N) float32 m in world, NaN where unknown; `sigma` (N, N) float32 m; `colour` (N, N, 3) uint8 RGB;
    `views` (N, N) uint8, how many photos agree on the height; `disputed` (N, N) bool, true where photos disagree.
    """

    flight: str
    id: TileId
    revision: int
    t_ns: int
    cell: float
    height: F32
    sigma: F32
    colour: U8
    views: U8
    disputed: Bool


@dataclass(frozen=True, eq=False)
class MapDigest:
    """Which tiles the sender holds: `tiles` (M, 4) int32, one row `level, x, y, revision` per tile, sorted."""

    flight: str
    t_ns: int
    tiles: I32


@dataclass(frozen=True, eq=False)
class TileRequest:
    """Asks the aircraft to send tiles again: `tiles` (M, 3) int32, one row `level, x, y` per tile."""

    flight: str
    tiles: I32


class Level(StrEnum):
    """How well a part of the system works."""

    OK = "ok"
    DEGRADED = "degraded"
    FAILED = "failed"


@dataclass(frozen=True)
class Health:
    """State of one process: its role, how well it works, one line for the operator, and named counts."""

    t_ns: int
    role: str
    level: Level
    text: str
    counts: dict[str, int] = field(default_factory=dict)


Message = Datum | Pose | Keyframe | EstimatorState | MapTile | MapDigest | TileRequest | Health | Measurement
