"""Point clouds as LAZ 1.4 in the UTM zone of the datum."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np

from common.arrays import U8, AnyFloat
from common.export.projection import UtmProjection
from common.messages import Datum

_SCALE = 0.001


def write_points(
    path: Path, p_world: AnyFloat, colour: U8, datum: Datum, sigma: AnyFloat | None = None, views: U8 | None = None
) -> None:
    """Write points (N, 3) m in world with colour (N, 3) RGB as LAZ 1.4, point format 7, steps of 1 mm.

    Coordinates are UTM east, north and height above the ellipsoid, with the CRS inside; `sigma` (N,) m and
    `views` (N,) become extra dimensions. Source: ASPRS LAS specification 1.4 R15.
    """
    projection = UtmProjection(datum)
    p_utm = projection.from_world(p_world)
    las = laspy.LasData(_header(projection, p_utm, sigma is not None, views is not None))
    las.x, las.y, las.z = p_utm.T
    las.red, las.green, las.blue = colour.T.astype(np.uint16) * 257
    las.return_number[:] = 1
    las.number_of_returns[:] = 1
    if sigma is not None:
        las.sigma = np.asarray(sigma, np.float32)
    if views is not None:
        las.views = views
    with path.open("wb") as stream:
        las.write(stream, do_compress=True)


def _header(projection: UtmProjection, p_utm: AnyFloat, with_sigma: bool, with_views: bool) -> laspy.LasHeader:
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, _SCALE)
    header.offsets = np.floor(p_utm.min(axis=0)) if len(p_utm) else np.zeros(3)
    header.generating_software = "Luojia"
    header.creation_date = None  # the same map gives the same bytes on another day
    header.add_crs(projection.crs)
    if with_sigma:
        header.add_extra_dim(laspy.ExtraBytesParams("sigma", np.float32, "one-sigma of height, m"))
    if with_views:
        header.add_extra_dim(laspy.ExtraBytesParams("views", np.uint8, "photos that agree"))
    return header
