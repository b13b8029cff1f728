"""What devices measure: frozen dataclasses in SI units, one per kind of measurement.

`t_ns` is integer nanoseconds of GNSS time (GPST) at the moment of sampling, as well as it is known. Arrays are
read-only by convention: whoever changes one copies it first. Unknown is None, or NaN within an array.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from common.arrays import F64, I32, Bool

BASE = "base"
"""Name of the receiver of a base station."""


@dataclass(frozen=True)
class RawBytes:
    """Bytes of a device as they came; `t_ns` is when the last of them arrived at the host."""

    t_ns: int
    device: str
    data: bytes


@dataclass(frozen=True, eq=False)
class ImuSample:
    """One sample of the IMU in its own frame, which is `body` (forward-left-up).

    `accel` (3,) m/s², specific force (+9.81 upwards at rest); `gyro` (3,) rad/s; `magnetic` (3,) in units of the
    local field, or None; `q_enu_body` (4,) wxyz, the device's own attitude, or None; `saturated` when any axis was
    out of range.
    """

    t_ns: int
    accel: F64
    gyro: F64
    magnetic: F64 | None = None
    q_enu_body: F64 | None = None
    temperature_c: float | None = None
    saturated: bool = False


class Encoding(StrEnum):
    """How the pixels of a camera frame are written."""

    MONO8 = "mono8"
    BGR8 = "bgr8"
    JPEG = "jpeg"
    PNG = "png"
    H264 = "h264"


@dataclass(frozen=True)
class CameraFrame:
    """One frame of a video camera; `t_ns` is the middle of the exposure of its middle row.

    `line_time_s` is the time from one row to the next (0: global shutter). `data` is H·W or H·W·3 bytes, row by row,
    an image file, or one H.264 access unit that needs those before it since the last key frame.
    """

    t_ns: int
    camera: str
    index: int
    width: int
    height: int
    encoding: Encoding
    data: bytes
    exposure_s: float | None = None
    gain: float | None = None
    line_time_s: float = 0.0


@dataclass(frozen=True, eq=False)
class GnssEpoch:
    """Raw measurements of one receiver at one instant, one row per signal.

    `t_ns` is the receiver's own time tag, off by its clock error. `receiver` tells the aircraft's from a base's.
    `satellites` are named as in RINEX 3 (G05, R12, E31, C06), `signals` by the last two letters of its observation
    codes (1C, 2L, 7Q). All arrays (N,): `pseudorange` m; `carrier_phase` cycles; `doppler` Hz, positive when the
    satellite comes closer; `cn0` dBHz; `lock_s` s of unbroken carrier tracking; `half_cycle`, true where the phase
    may be off by half a cycle; `sigma_*`, the receiver's own one-sigma in the unit of the measurement; `channel`,
    the GLONASS frequency number (0 for others). `leap_s` is GPST minus UTC in s, None when unknown. `clock_reset`
    says that the receiver's clock jumped since the epoch before. `p_ecef` (3,) m is where the antenna of a base stands,
    as far as the base says so.
    """

    t_ns: int
    receiver: str
    satellites: tuple[str, ...]
    signals: tuple[str, ...]
    pseudorange: F64
    carrier_phase: F64
    doppler: F64
    cn0: F64
    lock_s: F64
    half_cycle: Bool
    sigma_pseudorange: F64
    sigma_carrier_phase: F64
    sigma_doppler: F64
    channel: I32
    leap_s: int | None = None
    clock_reset: bool = False
    p_ecef: F64 | None = None


@dataclass(frozen=True)
class KeplerEphemeris:
    """Broadcast orbit and clock of a GPS, Galileo, BeiDou or QZSS satellite, in SI units, radians and seconds.

    `t_ns` is when it was received (RINEX: transmission time). `source` is LNAV, INAV, FNAV, D1 or D2. `toe_ns` and
    `toc_ns` are GPST (BeiDou's time plus 14 s). `iode` and `iodc` identify the issue (Galileo: IODnav in both;
    BeiDou: AODE, AODC). `group_delay` is TGD and 0 (GPS), BGD E5a/E1 and BGD E5b/E1 (Galileo), TGD1 and TGD2 (BeiDou).
    `health` is 0 when the satellite is usable. Field names follow IS-GPS-200, table 20-III.
    """

    t_ns: int
    satellite: str
    source: str
    toe_ns: int
    toc_ns: int
    iode: int
    iodc: int
    af0: float
    af1: float
    af2: float
    sqrt_a: float
    e: float
    i0: float
    omega0: float
    omega: float
    m0: float
    delta_n: float
    idot: float
    omega_dot: float
    cuc: float
    cus: float
    crc: float
    crs: float
    cic: float
    cis: float
    group_delay: tuple[float, float]
    accuracy: float
    health: int


@dataclass(frozen=True)
class GlonassEphemeris:
    """Broadcast state and clock of a GLONASS satellite at `toe_ns` (GPST), in PZ-90 (earth-fixed).

    `position` m, `velocity` m/s, `acceleration` m/s² (sun and moon alone); `tau` is the clock's bias −τn in s as in
    RINEX, `gamma` its relative frequency offset γn, `channel` the frequency number; `health` is 0 when usable.
    """

    t_ns: int
    satellite: str
    toe_ns: int
    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    acceleration: tuple[float, float, float]
    tau: float
    gamma: float
    channel: int
    age_days: int
    health: int


@dataclass(frozen=True)
class Ionosphere:
    """Klobuchar's broadcast model of a constellation ('G', 'C', 'J'): `alpha` s, `beta` s, per semicircle powers."""

    t_ns: int
    system: str
    alpha: tuple[float, float, float, float]
    beta: tuple[float, float, float, float]


class FixKind(StrEnum):
    """What a receiver's own solution is made of."""

    NONE = "none"
    DEAD_RECKONING = "dead-reckoning"
    FIX_2D = "2d"
    FIX_3D = "3d"
    DIFFERENTIAL = "differential"
    RTK_FLOAT = "rtk-float"
    RTK_FIXED = "rtk-fixed"
    TIME_ONLY = "time-only"


@dataclass(frozen=True, eq=False)
class ReceiverSolution:
    """A GNSS receiver's own solution: degrees, m above the WGS84 ellipsoid; one-sigma in m, m/s, s.

    `v_enu` (3,) m/s, east, north, up.
    """

    t_ns: int
    receiver: str
    kind: FixKind
    latitude_deg: float
    longitude_deg: float
    height: float
    sigma_horizontal: float
    sigma_vertical: float
    v_enu: F64
    sigma_velocity: float
    sigma_time: float
    satellites: int


class ClockPhase(StrEnum):
    """How far the clock of a device is known in GNSS time."""

    UNSET = "unset"
    CONVERGING = "converging"
    LOCKED = "locked"
    HOLDOVER = "holdover"


@dataclass(frozen=True)
class ClockState:
    """Where the clock of a device stands: GNSS time = device time + `offset_ns`, at `t_ns` (GPST).

    `drift_ppm` is how fast the offset grows; `sigma_s` one sigma of the mapped time. `samples`, `outliers` and
    `resets` count what was used, refused, and how often the clock was found to have jumped.
    """

    t_ns: int
    device: str
    phase: ClockPhase
    offset_ns: int
    drift_ppm: float
    sigma_s: float
    samples: int
    outliers: int
    resets: int


class Severity(StrEnum):
    """How grave a text of the vehicle is (MAVLink's scale, from the gravest)."""

    EMERGENCY = "emergency"
    ALERT = "alert"
    CRITICAL = "critical"
    ERROR = "error"
    WARNING = "warning"
    NOTICE = "notice"
    INFO = "info"
    DEBUG = "debug"


@dataclass(frozen=True, eq=False)
class VehicleState:
    """The drone's own telemetry, newest value of each kind; None is unknown.

    `q_enu_body` (4,) wxyz of the airframe (forward-left-up); `v_enu` (3,) m/s; heights in m: `height_msl` above mean
    sea level, `height_home` above the take-off point. `gimbal` (roll, pitch, yaw) rad, yaw clockwise from north,
    pitch −π/2 looking down. `battery` and `load` are fractions; `radio_rssi` a fraction of the best. `text` is the
    latest status text.
    """

    t_ns: int
    system: int
    armed: bool | None = None
    mode: str | None = None
    q_enu_body: F64 | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    height_msl: float | None = None
    height_home: float | None = None
    v_enu: F64 | None = None
    fix: FixKind | None = None
    satellites: int | None = None
    sigma_horizontal: float | None = None
    battery: float | None = None
    voltage_v: float | None = None
    current_a: float | None = None
    load: float | None = None
    gimbal: tuple[float, float, float] | None = None
    home: tuple[float, float, float] | None = None
    radio_rssi: float | None = None
    severity: Severity | None = None
    text: str | None = None


Ephemeris = KeplerEphemeris | GlonassEphemeris
Measurement = (
    RawBytes
    | ImuSample
    | CameraFrame
    | GnssEpoch
    | KeplerEphemeris
    | GlonassEphemeris
    | Ionosphere
    | ReceiverSolution
    | ClockState
    | VehicleState
)
