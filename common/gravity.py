"""Normal gravity and the rotation of the earth.

Source: National Geospatial-Intelligence Agency, NGA.STND.0036 (World Geodetic System 1984), chapter 4.
"""

from __future__ import annotations

import numpy as np

from common.arrays import F64
from common.geo import WGS84_A, WGS84_E2, WGS84_F

EARTH_RATE = 7.292115e-5
"""Rotation of the earth, rad/s."""
_AT_EQUATOR = 9.7803253359
_SOMIGLIANA = 1.931852652458e-3
_CENTRIFUGAL = 3.449786506841e-3


def normal_gravity(latitude_deg: float, height: float) -> float:
    """Acceleration by gravity m/s², downwards, at a latitude and a height m above the ellipsoid.

    It holds the centrifugal acceleration of the earth's rotation. Source: equations 4-1 (Somigliana) and 4-3.
    """
    square = np.sin(np.radians(latitude_deg)) ** 2
    on_ellipsoid = _AT_EQUATOR * (1 + _SOMIGLIANA * square) / np.sqrt(1 - WGS84_E2 * square)
    slope = 2 / WGS84_A * (1 + WGS84_F + _CENTRIFUGAL - 2 * WGS84_F * square)
    return float(on_ellipsoid * (1 - slope * height + 3 * (height / WGS84_A) ** 2))


def earth_rate_enu(latitude_deg: float) -> F64:
    """Angular velocity (3,) rad/s of the earth in local ENU axes."""
    latitude = np.radians(latitude_deg)
    return EARTH_RATE * np.array([0.0, np.cos(latitude), np.sin(latitude)])
