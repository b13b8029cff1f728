"""WGS84: geodetic, ECEF and local ENU coordinates, and the UTM zone of a place.

Source: National Geospatial-Intelligence Agency, NGA.STND.0036 (World Geodetic System 1984); ENU as in
Hofmann-Wellenhof et al., GNSS, section 8.2.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.arrays import F64
from common.messages import Datum
from common.se3 import SE3

WGS84_A = 6378137.0
WGS84_F = 1 / 298.257223563
WGS84_E2 = WGS84_F * (2 - WGS84_F)


def geodetic_to_ecef(latitude_deg: npt.ArrayLike, longitude_deg: npt.ArrayLike, height: npt.ArrayLike) -> F64:
    """ECEF position (..., 3) m of geodetic coordinates in degrees and metres above the ellipsoid."""
    lat, lon = np.radians(np.asarray(latitude_deg, float)), np.radians(np.asarray(longitude_deg, float))
    h = np.asarray(height, float)
    n = WGS84_A / np.sqrt(1 - WGS84_E2 * np.sin(lat) ** 2)
    return np.stack(
        np.broadcast_arrays(
            (n + h) * np.cos(lat) * np.cos(lon),
            (n + h) * np.cos(lat) * np.sin(lon),
            (n * (1 - WGS84_E2) + h) * np.sin(lat),
        ),
        axis=-1,
    )


def ecef_to_geodetic(p_ecef: npt.ArrayLike) -> F64:
    """Latitude °, longitude ° and ellipsoidal height m (..., 3) of ECEF positions (..., 3) m.

    Bowring's start refined by Newton-like iterations; below a micrometre anywhere from −10 km to orbit.
    """
    p = np.asarray(p_ecef, float)
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    rho = np.hypot(x, y)
    lat = np.arctan2(z, rho * (1 - WGS84_E2))
    for _ in range(6):
        n = WGS84_A / np.sqrt(1 - WGS84_E2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + WGS84_E2 * n * np.sin(lat), rho)
    n = WGS84_A / np.sqrt(1 - WGS84_E2 * np.sin(lat) ** 2)
    # Away from the poles rho/cos is exact, near them z/sin is: blend by using the projection on the normal.
    h = rho * np.cos(lat) + z * np.sin(lat) - WGS84_A**2 / n
    return np.stack([np.degrees(lat), np.degrees(np.arctan2(y, x)), h], axis=-1)


def T_ecef_enu(datum: Datum) -> SE3:
    """Transform from the local ENU frame at the datum to ECEF."""
    lat, lon = np.radians(datum.latitude_deg), np.radians(datum.longitude_deg)
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    origin = geodetic_to_ecef(datum.latitude_deg, datum.longitude_deg, datum.height)
    return SE3(np.stack([east, np.cross(up, east), up], axis=1), origin)


def geodetic_to_enu(
    datum: Datum, latitude_deg: npt.ArrayLike, longitude_deg: npt.ArrayLike, height: npt.ArrayLike
) -> F64:
    """Local ENU coordinates (..., 3) m at the datum of geodetic coordinates in degrees and metres."""
    return T_ecef_enu(datum).inverse().apply(geodetic_to_ecef(latitude_deg, longitude_deg, height))


def enu_to_geodetic(datum: Datum, p_world: npt.ArrayLike) -> F64:
    """Latitude °, longitude ° and ellipsoidal height m (..., 3) of ENU points (..., 3) m at the datum."""
    return ecef_to_geodetic(T_ecef_enu(datum).apply(np.asarray(p_world, float)))


def T_world_other(world: Datum, other: Datum) -> SE3:
    """Transform from the ENU frame at `other` to the ENU frame at `world`."""
    return T_ecef_enu(world).inverse() @ T_ecef_enu(other)


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG code of the WGS84 UTM zone that holds a place (the standard 6° zones, without the Norway exceptions)."""
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    return (32600 if latitude_deg >= 0 else 32700) + zone
