"""From the world frame of a flight to the UTM zone of its datum and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from pyproj import CRS, Transformer

from common.arrays import F64
from common.geo import enu_to_geodetic, geodetic_to_enu, utm_epsg
from common.messages import Datum


@dataclass(frozen=True)
class UtmProjection:
    """WGS84 / UTM in the zone of a datum, with ellipsoidal heights.

    Exact: ENU → ECEF → geodetic by `common.geo`, geodetic → UTM by PROJ (Karney 2011, below a nanometre).
    """

    datum: Datum

    @property
    def epsg(self) -> int:
        """EPSG code of the zone (the horizontal CRS)."""
        return utm_epsg(self.datum.latitude_deg, self.datum.longitude_deg)

    @property
    def crs(self) -> CRS:
        """The zone's CRS with three axes: east, north, height above the WGS84 ellipsoid, all m."""
        return CRS.from_epsg(self.epsg).to_3d()

    @cached_property
    def _utm_of_geographic(self) -> Transformer:
        return Transformer.from_crs(CRS.from_epsg(4326), CRS.from_epsg(self.epsg), always_xy=True)

    def from_world(self, p_world: npt.ArrayLike) -> F64:
        """UTM east, north and ellipsoidal height (..., 3) m of world points (..., 3) m."""
        geodetic = enu_to_geodetic(self.datum, p_world)
        east, north = self._utm_of_geographic.transform(geodetic[..., 1], geodetic[..., 0])
        return np.stack([east, north, geodetic[..., 2]], axis=-1)

    def to_world(self, p_utm: npt.ArrayLike) -> F64:
        """World points (..., 3) m of UTM east, north and ellipsoidal height (..., 3) m."""
        p = np.asarray(p_utm, float)
        longitude, latitude = self._utm_of_geographic.transform(p[..., 0], p[..., 1], direction="INVERSE")
        return geodetic_to_enu(self.datum, latitude, longitude, p[..., 2])
