"""What a photo's EXIF and XMP say about time, place, attitude and lens; hostile bytes give None, never an error."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
from PIL import Image

from common.arrays import F64
from common.camera import CameraModel
from common.messages import GnssFix

EPOCH = datetime(1970, 1, 1)
SIGMA_HORIZONTAL = 1.5
SIGMA_VERTICAL = 3.0
ATTITUDE_SIGMA = math.radians(10.0)
"""Gimbals level well, but their compass is often off by several degrees.

Worse, some DJI cameras store nadir images turned by 180° while the drone flies back, and no tag says so: a user of
the attitude must be able to find the heading out to be reversed.
"""

_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_MODEL = 0x0110
_DATE_TIME_ORIGINAL, _SUBSEC_ORIGINAL, _FOCAL_LENGTH, _FOCAL_35MM = 0x9003, 0x9291, 0x920A, 0xA405
_EXIF_WIDTH, _EXIF_HEIGHT, _PLANE_X_RESOLUTION, _PLANE_UNIT = 0xA002, 0xA003, 0xA20E, 0xA210
_LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT, _H_ERROR = 1, 2, 3, 4, 5, 6, 31
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}

SENSOR_WIDTH_MM = {
    "FC300C": 6.17,
    "FC300S": 6.17,
    "FC300X": 6.17,
    "FC330": 6.17,
    "FC220": 6.17,
    "FC6310": 13.2,
    "L1D-20c": 13.2,
}
"""For cameras whose EXIF gives the focal length in mm but not the size of the sensor; full width of the sensor."""


@dataclass(frozen=True, eq=False)
class PhotoFacts:
    """What a photo's header tells, None where it does not.

    `t_ns` is the camera's clock as ns since the GPS epoch (cameras know no time zone and no leap seconds);
    `R_enu_cam` (3, 3); `trouble` says what was found and could not be believed.
    """

    t_ns: int | None = None
    fix: GnssFix | None = None
    camera: CameraModel | None = None
    R_enu_cam: F64 | None = None
    trouble: tuple[str, ...] = ()


def read_facts(jpeg: bytes) -> PhotoFacts:
    """What the header of an encoded image tells; an unreadable one tells nothing and says so in `trouble`."""
    with warnings.catch_warnings():
        # Pillow warns about damaged EXIF and large images, which we judge ourselves.
        warnings.simplefilter("ignore")
        try:
            image = Image.open(io.BytesIO(jpeg))
            width, height = image.size
        except Exception as error:  # Pillow raises nearly every built-in exception on damaged headers.
            return PhotoFacts(trouble=(f"is no readable image ({type(error).__name__})",))
        tags, gps = _tags(image)
        fix, no_fix = gnss_fix(gps)
        return PhotoFacts(
            t_ns=clock_time(tags),
            fix=fix,
            camera=camera_guess(tags, width, height),
            R_enu_cam=gimbal_attitude(_xmp(image)),
            trouble=(no_fix,) if no_fix else (),
        )


def clock_time(tags: dict[int, Any]) -> int | None:
    """Nanoseconds since 1970 on the camera's own clock, from DateTimeOriginal and its sub-seconds."""
    try:
        taken = datetime.strptime(str(tags[_DATE_TIME_ORIGINAL]).strip(" \0"), "%Y:%m:%d %H:%M:%S")
    except (KeyError, ValueError):
        return None
    subsec = str(tags.get(_SUBSEC_ORIGINAL, "")).strip(" \0")
    fraction = int(subsec[:9].ljust(9, "0")) if subsec.isascii() and subsec.isdigit() else 0
    elapsed = taken - EPOCH
    return (elapsed.days * 86_400 + elapsed.seconds) * 1_000_000_000 + fraction


def gnss_fix(gps: dict[int, Any]) -> tuple[GnssFix | None, str]:
    """The position in a GPS directory, altitude taken as ellipsoidal; or None and the reason."""
    latitude = _degrees(gps.get(_LAT), gps.get(_LAT_REF), "S")
    longitude = _degrees(gps.get(_LON), gps.get(_LON_REF), "W")
    altitude = _number(gps.get(_ALT))
    if latitude is None or longitude is None:
        return None, "has no GPS position"
    if abs(latitude) > 90 or abs(longitude) > 180 or (latitude == 0 and longitude == 0):
        return None, f"has the impossible GPS position {latitude:.6f}°, {longitude:.6f}°"
    if altitude is None or abs(altitude) > 20_000:
        return None, "has a GPS position without a usable altitude"
    below = gps.get(_ALT_REF) in (b"\x01", b"\x03", 1, 3)
    sigma = _number(gps.get(_H_ERROR))
    scale = sigma / SIGMA_HORIZONTAL if sigma is not None and 0 < sigma < 1000 else 1.0
    height = -altitude if below else altitude
    return GnssFix(latitude, longitude, height, SIGMA_HORIZONTAL * scale, SIGMA_VERTICAL * scale), ""


def camera_guess(tags: dict[int, Any], width: int, height: int) -> CameraModel:
    """A first guess of the intrinsics of an image of `width` × `height` px: no distortion, centred principal point."""
    longer = max(width, height)
    guesses = (_focal_by_table(tags, longer), _focal_by_resolution(tags, longer), _focal_by_35mm(tags, width, height))
    focal = next((f for f in guesses if f is not None and 0.2 * longer < f < 50 * longer), float(longer))
    return CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _focal_by_table(tags: dict[int, Any], longer: int) -> float | None:
    focal_mm = _number(tags.get(_FOCAL_LENGTH))
    sensor_mm = SENSOR_WIDTH_MM.get(str(tags.get(_MODEL, "")).strip(" \0"))
    return None if focal_mm is None or sensor_mm is None else focal_mm / sensor_mm * longer


def _focal_by_resolution(tags: dict[int, Any], longer: int) -> float | None:
    """Focal length in px from the pixel pitch, which belongs to the image as taken, before any resizing."""
    focal_mm, per_unit = _number(tags.get(_FOCAL_LENGTH)), _number(tags.get(_PLANE_X_RESOLUTION))
    unit_mm = _MM_PER_UNIT.get(int(_number(tags.get(_PLANE_UNIT)) or 2))
    taken = max(_number(tags.get(_EXIF_WIDTH)) or 0.0, _number(tags.get(_EXIF_HEIGHT)) or 0.0) or longer
    if focal_mm is None or per_unit is None or unit_mm is None:
        return None
    return focal_mm * per_unit / unit_mm * longer / taken


def _focal_by_35mm(tags: dict[int, Any], width: int, height: int) -> float | None:
    """Focal length in px from the 35 mm equivalent, which compares diagonals (CIPA DCG-001).

    Wider images than 3:2 are crops of a 4:3 sensor, whose diagonal is 5/4 of its width.
    """
    equivalent_mm = _number(tags.get(_FOCAL_35MM))
    if not equivalent_mm:
        return None
    longer, shorter = max(width, height), min(width, height)
    diagonal = math.hypot(width, height) if longer <= 1.51 * shorter else 1.25 * longer
    return equivalent_mm / math.hypot(36.0, 24.0) * diagonal


def gimbal_attitude(xmp: Any) -> F64 | None:
    """`R_enu_cam` (3, 3) from DJI's gimbal angles in XMP, or None where they are missing or were never filled in."""
    angles = [_find_number(xmp, f"Gimbal{axis}Degree") for axis in ("Yaw", "Pitch", "Roll")]
    if any(angle is None for angle in angles) or not any(angles):
        return None
    yaw, pitch, roll = (math.radians(angle) for angle in angles if angle is not None)
    return R_enu_cam(yaw, pitch, roll)


def R_enu_cam(yaw: float, pitch: float, roll: float) -> F64:
    """Attitude (3, 3) of a camera from yaw (from north, clockwise), pitch (−π/2 looks down) and roll, rad.

    Roll lowers the right side; the top of a nadir image points along the yaw, as DJI defines its gimbal.
    """
    ahead = np.array([math.sin(yaw), math.cos(yaw), 0.0])
    level_right = np.array([math.cos(yaw), -math.sin(yaw), 0.0])
    forward = math.cos(pitch) * ahead + math.sin(pitch) * np.array([0.0, 0.0, 1.0])
    level_down = np.cross(forward, level_right)
    right = math.cos(roll) * level_right + math.sin(roll) * level_down
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _tags(image: Image.Image) -> tuple[dict[int, Any], dict[int, Any]]:
    """Tags of the image and of its EXIF directory together, and those of its GPS directory."""
    try:
        exif = image.getexif()
        return {**exif, **exif.get_ifd(_EXIF_IFD)}, dict(exif.get_ifd(_GPS_IFD))
    except Exception:  # as above: any exception, for any damage
        return {}, {}


def _xmp(image: Image.Image) -> Any:
    try:
        return image.getxmp()
    except Exception:  # malformed or hostile XML
        return {}


def _find_number(tree: Any, name: str) -> float | None:
    """The number under a key anywhere in nested dictionaries and lists: XMP allows attributes and elements."""
    values = (value for key, value in _leaves(tree) if key == name)
    return next((number for value in values if (number := _number(value)) is not None), None)


def _leaves(tree: Any) -> Iterator[tuple[str, Any]]:
    stack = [tree]
    while stack:
        node = stack.pop()
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in items:
            if isinstance(value, dict | list):
                stack.append(value)
            else:
                yield str(key), value


def _number(value: Any) -> float | None:
    """A finite float, or None for whatever else the tag holds."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _degrees(dms: Any, reference: Any, negative: str) -> float | None:
    """Signed degrees of (degrees, minutes, seconds) and a hemisphere letter."""
    if not isinstance(dms, tuple) or len(dms) != 3:
        return None
    parts = [_number(part) for part in dms]
    if any(part is None for part in parts):
        return None
    degrees = sum((part / 60.0**i for i, part in enumerate(parts) if part is not None), 0.0)
    return -degrees if str(reference).strip(" \0").upper().startswith(negative) else degrees
