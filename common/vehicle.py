"""MAVLink messages as values of a `VehicleState`: SI units, ENU and forward-left-up, None for every "unknown".

Source: the MAVLink message sets common and ardupilotmega. What RosettaDrone, the bridge of DJI drones, leaves at zero
or fills with something else is taken for unknown where it can be told.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from common import ned
from common.arrays import F64
from common.measurements import FixKind, Severity

Values = dict[str, Any]
"""Fields of a `VehicleState` that a message tells; None where it says that it does not know."""

U8_MAX, U16_MAX, I16_MAX, I32_MAX = 0xFF, 0xFFFF, 0x7FFF, 0x7FFFFFFF
LONGEST_TEXT = 200

_FIXES = (
    FixKind.NONE,  # no receiver
    FixKind.NONE,
    FixKind.FIX_2D,
    FixKind.FIX_3D,
    FixKind.DIFFERENTIAL,
    FixKind.RTK_FLOAT,
    FixKind.RTK_FIXED,
    FixKind.FIX_3D,  # static
    FixKind.FIX_3D,  # precise point positioning
)
_YAW_LOCK, _YAW_IN_VEHICLE_FRAME, _YAW_IN_EARTH_FRAME = 16, 32, 64


def values_of(message: Any, yaw: float | None) -> Values:
    """What a decoded message tells; `yaw` rad clockwise from north is the airframe's, for gimbals that turn with it."""
    reader = READERS.get(message.get_type())
    return {} if reader is None else reader(message, yaw)


def yaw_of(message: Any) -> float | None:
    """The airframe's yaw rad, clockwise from north, of an attitude message; None when it does not tell."""
    if message.get_type() == "ATTITUDE":
        return _finite(message.yaw)
    q = _unit((message.q1, message.q2, message.q3, message.q4))
    return None if q is None else _euler(q)[2]


def _attitude(m: Any, yaw: float | None) -> Values:
    return {"q_enu_body": ned.attitude_of_angles(m.roll, m.pitch, m.yaw)}


def _attitude_quaternion(m: Any, yaw: float | None) -> Values:
    return {"q_enu_body": ned.attitude((m.q1, m.q2, m.q3, m.q4))}


def _global_position(m: Any, yaw: float | None) -> Values:
    """Without a position the bridge sends zeros; without a height above the sea it repeats that above home."""
    latitude_deg, longitude_deg = _place(m.lat, m.lon)
    velocity = (m.vy, m.vx, -m.vz)
    known = I16_MAX not in (m.vx, m.vy, m.vz)
    return {
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "height_msl": None if m.alt == m.relative_alt else _scaled(m.alt, 1e-3, I32_MAX),
        "height_home": _scaled(m.relative_alt, 1e-3, I32_MAX),
        "v_enu": np.array(velocity) / 100.0 if known else None,
    }


def _gps_raw(m: Any, yaw: float | None) -> Values:
    """The accuracy is a later extension of the message: zero where the sender does not know it."""
    return {
        "fix": _FIXES[m.fix_type] if m.fix_type < len(_FIXES) else None,
        "satellites": None if m.satellites_visible == U8_MAX else m.satellites_visible,
        "sigma_horizontal": _scaled(m.h_acc, 1e-3, 0, 0xFFFFFFFF),
    }


def _battery_status(m: Any, yaw: float | None) -> Values:
    """The first battery alone; the others are no vehicle's own everywhere."""
    if m.id != 0:
        return {}
    cells = [mv for mv in (*m.voltages, *m.voltages_ext) if mv not in (0, U16_MAX)]
    return {
        "battery": _share(m.battery_remaining, 100),
        "voltage_v": sum(cells) / 1000.0 if cells else None,
        "current_a": _scaled(m.current_battery, 0.01, -1),
    }


def _sys_status(m: Any, yaw: float | None) -> Values:
    return {
        "load": _share(m.load, 1000),
        "battery": _share(m.battery_remaining, 100),
        "voltage_v": _scaled(m.voltage_battery, 1e-3, U16_MAX, 0),
        "current_a": _scaled(m.current_battery, 0.01, -1),
    }


def _mount_status(m: Any, yaw: float | None) -> Values:
    return {"gimbal": _gimbal(m.pointing_b / 100.0, m.pointing_a / 100.0, m.pointing_c / 100.0, yaw)}


def _mount_orientation(m: Any, yaw: float | None) -> Values:
    return {"gimbal": _gimbal(m.roll, m.pitch, m.yaw, yaw)}


def _gimbal_device(m: Any, yaw: float | None) -> Values:
    q = _unit(tuple(m.q))
    if q is None:
        return {"gimbal": None}
    earth = bool(m.flags & _YAW_IN_EARTH_FRAME)
    if not m.flags & (_YAW_IN_EARTH_FRAME | _YAW_IN_VEHICLE_FRAME):
        earth = bool(m.flags & _YAW_LOCK)
    roll, pitch, own_yaw = map(math.degrees, _euler(q))
    return {"gimbal": _gimbal(roll, pitch, own_yaw, 0.0 if earth else yaw)}


def _home(m: Any, yaw: float | None) -> Values:
    (latitude_deg, longitude_deg), height = _place(m.latitude, m.longitude), _scaled(m.altitude, 1e-3, I32_MAX)
    if latitude_deg is None or longitude_deg is None or height is None:
        return {"home": None}
    return {"home": (latitude_deg, longitude_deg, height)}


def _radio_status(m: Any, yaw: float | None) -> Values:
    """The bridge fills in nothing at all, which no radio does."""
    silent = not (m.rssi or m.remrssi or m.noise or m.remnoise)
    return {"radio_rssi": None if silent else _share(m.rssi, 254)}


def _rc_channels(m: Any, yaw: float | None) -> Values:
    return {"radio_rssi": _share(m.rssi, 254)}


def _altitude(m: Any, yaw: float | None) -> Values:
    """The bridge fills in the relative height alone."""
    return {"height_msl": _finite(m.altitude_amsl) or None, "height_home": _finite(m.altitude_relative)}


def _status_text(m: Any, yaw: float | None) -> Values:
    severities = tuple(Severity)
    text = "".join(c for c in m.text if c.isprintable())[:LONGEST_TEXT]
    return {"severity": severities[m.severity] if m.severity < len(severities) else None, "text": text}


READERS: dict[str, Callable[[Any, float | None], Values]] = {
    "ALTITUDE": _altitude,
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "BATTERY_STATUS": _battery_status,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": _gimbal_device,
    "GLOBAL_POSITION_INT": _global_position,
    "GPS_RAW_INT": _gps_raw,
    "HOME_POSITION": _home,
    "MOUNT_ORIENTATION": _mount_orientation,
    "MOUNT_STATUS": _mount_status,
    "RADIO_STATUS": _radio_status,
    "RC_CHANNELS": _rc_channels,
    "STATUSTEXT": _status_text,
    "SYS_STATUS": _sys_status,
}
"""The messages that tell something about the vehicle. VFR_HUD is none: its height is above the sea or above home,
and nobody can tell which; the rest of it stands in others."""


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _scaled(value: int, unit: float, *unknown: int) -> float | None:
    return None if value in unknown else value * unit


def _share(value: int, whole: int) -> float | None:
    return value / whole if 0 <= value <= whole else None


def _place(latitude: int, longitude: int) -> tuple[float | None, float | None]:
    """Degrees; nobody flies at exactly 0° N 0° E, but many senders are there before their first fix."""
    if (latitude, longitude) == (0, 0) or abs(latitude) > 900_000_000 or abs(longitude) > 1_800_000_000:
        return None, None
    return latitude / 1e7, longitude / 1e7


def _unit(q: tuple[float, ...]) -> F64 | None:
    """The quaternion at unit length; None for zeros, NaN and nonsense."""
    length = math.hypot(*q)
    return np.array(q) / length if 0.9 < length < 1.1 else None


def _euler(q: F64) -> tuple[float, float, float]:
    """Roll, pitch, yaw rad of a quaternion wxyz, turned in the order yaw, pitch, roll."""
    w, x, y, z = map(float, q)
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _gimbal(
    roll_deg: float, pitch_deg: float, yaw_deg: float, yaw_of_zero: float | None
) -> tuple[float, float, float] | None:
    """Roll, pitch, yaw rad, yaw clockwise from north in [−π, π)."""
    if yaw_of_zero is None or not all(map(math.isfinite, (roll_deg, pitch_deg, yaw_deg))):
        return None
    yaw = math.radians(yaw_deg) + yaw_of_zero
    return math.radians(roll_deg), math.radians(pitch_deg), (yaw + math.pi) % (2 * math.pi) - math.pi
