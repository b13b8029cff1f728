"""The surface as cloud-optimised GeoTIFFs in the UTM zone of the datum: heights (DSM) and colours (orthophoto)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio import Affine
from rasterio.enums import ColorInterp

from common.arrays import F32, F64, U8, Bool
from common.export.projection import UtmProjection
from common.export.surface import Surface
from common.messages import Datum

_BLOCK_ROWS = 256
_LATTICE_PX = 64
_COG = {
    "driver": "COG",
    "compress": "DEFLATE",
    "predictor": "YES",
    "level": 6,
    "blocksize": 512,
    "BIGTIFF": "IF_SAFER",
    "overview_resampling": "average",
}


def write_dsm(path: Path, surface: Surface, datum: Datum) -> None:
    """Write heights above the WGS84 ellipsoid, m, float32 with NaN for nothing, in cells of the surface's size."""
    grid = _UtmGrid.around(surface, datum)
    height = np.full((1, grid.rows, grid.cols), np.nan, np.float32)
    for rows, block in grid.blocks():
        height[0, rows], _ = block.resample(surface, with_colour=False)
    _write_cog(path, height, grid, nodata=np.nan, unit="metre", description="height above the WGS84 ellipsoid")


def write_ortho(path: Path, surface: Surface, datum: Datum) -> None:
    """Write the orthophoto: red, green, blue, alpha uint8; alpha is 0 where there is no surface and 255 elsewhere."""
    grid = _UtmGrid.around(surface, datum)
    rgba = np.zeros((4, grid.rows, grid.cols), np.uint8)
    for rows, block in grid.blocks():
        height, colour = block.resample(surface, with_colour=True)
        rgba[:3, rows] = np.moveaxis(colour, -1, 0)
        rgba[3, rows] = np.where(np.isfinite(height), 255, 0)
    _write_cog(path, rgba, grid, colours=(ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha))


@dataclass(frozen=True, eq=False)
class _Block:
    """Some rows of the UTM grid: where each pixel lies in the surface, and the height of its datum plane.

    `row`, `col` are fractional cells of the surface; `up` is the world height of the reference ellipsoidal height
    there and `per_metre` how much world height a metre of ellipsoidal height is (1 to 1e-6, kept for exactness).
    """

    row: F64
    col: F64
    up: F64
    per_metre: F64
    reference_height: float

    def resample(self, surface: Surface, with_colour: bool) -> tuple[F32, U8]:
        """Ellipsoidal heights (h, w), NaN where less than half the weight is known, and colours (h, w, 3) RGB."""
        total, height = np.zeros(self.row.shape), np.zeros(self.row.shape)
        colour = np.zeros((*self.row.shape, 3) if with_colour else (0, 0, 3), np.float32)
        for row, col, weight in self._corners(surface):
            corner = surface.height[row, col]
            known = np.where(np.isfinite(corner), weight, 0.0)
            total += known
            height += known * np.where(known > 0, corner, 0.0)
            if with_colour:
                colour += known[..., None].astype(np.float32) * surface.colour[row, col]
        seen = total >= 0.5
        safe = np.where(seen, total, 1.0)
        ellipsoidal = self.reference_height + (height / safe - self.up) / self.per_metre
        if with_colour:
            colour = np.where(seen[..., None], colour / safe[..., None].astype(np.float32), 0)
        return np.where(seen, ellipsoidal, np.nan).astype(np.float32), np.rint(colour).astype(np.uint8)

    def _corners(self, surface: Surface) -> Iterator[tuple[F64, F64, F64]]:
        """The four cells around each pixel (indices clipped) with their bilinear weights, 0 outside the surface."""
        rows, cols = surface.height.shape
        row0, col0 = np.floor(self.row), np.floor(self.col)
        for d_row in (0, 1):
            for d_col in (0, 1):
                row, col = row0.astype(np.int32) + d_row, col0.astype(np.int32) + d_col
                weight = (1 - np.abs(self.row - row)) * (1 - np.abs(self.col - col))
                inside: Bool = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
                yield np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1), np.where(inside, weight, 0.0)


@dataclass(frozen=True)
class _UtmGrid:
    """A north-up pixel grid in UTM: west and north edge m, pixel size m, and how to get back into a surface."""

    projection: UtmProjection
    west: float
    north: float
    pixel: float
    rows: int
    cols: int
    x0: float
    y0: float
    reference_height: float

    @staticmethod
    def around(surface: Surface, datum: Datum) -> _UtmGrid:
        """The grid of the surface's cell size, on multiples of it, that holds the whole surface."""
        projection = UtmProjection(datum)
        up = float(np.nanmedian(surface.height)) if surface.valid.any() else 0.0
        rows, cols = surface.height.shape
        # The edges of the rectangle bend in UTM: points along them bound it, the corners alone do not.
        along = np.linspace(0.0, 1.0, 33)
        border = np.concatenate([np.stack(np.broadcast_arrays(along, s), axis=1) for s in (0.0, 1.0)])
        border = np.concatenate([border, border[:, ::-1]]) * [cols * surface.cell, rows * surface.cell]
        border += [surface.x0, surface.y0]
        utm = projection.from_world(np.column_stack([border, np.full(len(border), up)]))
        west, south = np.floor(utm[:, :2].min(axis=0) / surface.cell) * surface.cell
        east, north = np.ceil(utm[:, :2].max(axis=0) / surface.cell) * surface.cell
        return _UtmGrid(
            projection=projection,
            west=float(west),
            north=float(north),
            pixel=surface.cell,
            rows=round((north - south) / surface.cell),
            cols=round((east - west) / surface.cell),
            x0=surface.x0,
            y0=surface.y0,
            reference_height=float(utm[:, 2].mean()),
        )

    def blocks(self) -> Iterator[tuple[slice, _Block]]:
        """The grid in bands of rows, from north to south."""
        for first in range(0, self.rows, _BLOCK_ROWS):
            last = min(first + _BLOCK_ROWS, self.rows)
            yield slice(first, last), self._block(first, last)

    def _block(self, first: int, last: int) -> _Block:
        """Exact transform on a coarse lattice, bilinear between: over 64 px the Earth's curve is below a micrometre."""
        v = np.linspace(first, last - 1, max(2, (last - first) // _LATTICE_PX + 1))
        u = np.linspace(0, self.cols - 1, max(2, self.cols // _LATTICE_PX + 1))
        east = self.west + (u[None, :] + 0.5) * self.pixel
        north = self.north - (v[:, None] + 0.5) * self.pixel
        at = np.stack(np.broadcast_arrays(east, north, self.reference_height), axis=-1)
        p_world = self.projection.to_world(at)
        # One metre along the normal of the ellipsoid, a straight line: the world height is linear in the other.
        per_metre = self.projection.to_world(at + np.array([0.0, 0.0, 1.0]))[..., 2] - p_world[..., 2]
        px_v, px_u = np.arange(first, last, dtype=float), np.arange(self.cols, dtype=float)
        dense = [_bilinear(values, v, u, px_v, px_u) for values in (*np.moveaxis(p_world, -1, 0), per_metre)]
        return _Block(
            row=(dense[1] - self.y0) / self.pixel - 0.5,
            col=(dense[0] - self.x0) / self.pixel - 0.5,
            up=dense[2],
            per_metre=dense[3],
            reference_height=self.reference_height,
        )


def _bilinear(values: F64, v: F64, u: F64, at_v: F64, at_u: F64) -> F64:
    """Values (len(v), len(u)) on a lattice interpolated to the rectangle (len(at_v), len(at_u))."""
    along_u = np.stack([np.interp(at_u, u, row) for row in values])
    weights = np.stack([np.interp(at_v, v, node) for node in np.eye(len(v))], axis=1)
    return np.asarray(weights @ along_u)


def _write_cog(
    path: Path,
    bands: F32 | U8,
    grid: _UtmGrid,
    nodata: float | None = None,
    unit: str | None = None,
    description: str | None = None,
    colours: tuple[ColorInterp, ...] = (),
) -> None:
    count, rows, cols = bands.shape
    with rasterio.open(
        path,
        "w",
        **_COG,
        count=count,
        height=rows,
        width=cols,
        dtype=bands.dtype.name,
        nodata=nodata,
        crs=f"EPSG:{grid.projection.epsg}",
        transform=Affine(grid.pixel, 0.0, grid.west, 0.0, -grid.pixel, grid.north),
    ) as raster:
        if colours:
            raster.colorinterp = colours
        raster.write(bands)
        if unit is not None and description is not None:
            raster.units, raster.descriptions = (unit,) * count, (description,) * count
