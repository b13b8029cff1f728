"""All products of one flight in one folder."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from common.errors import ExportError
from common.export.datum import write_datum
from common.export.laz import write_points
from common.export.mesh import write_mesh
from common.export.ply import write_points_ply
from common.export.preview import write_preview
from common.export.raster import write_dsm, write_ortho
from common.export.surface import MIN_VIEWS, Surface, mosaic
from common.export.trajectory import newest_keyframes, write_geojson, write_tum
from common.messages import Datum, Keyframe, MapTile

Writer = Callable[[Path], None]

TRAJECTORY_PRODUCTS = ("datum.json", "trajectory.tum", "trajectory.geojson")
MAP_PRODUCTS = ("map.laz", "map.ply", "dsm.tif", "ortho.tif", "mesh.glb", "mesh.ply", "preview.jpg")
_WRITERS_AT_ONCE = 2


def write_products(
    folder: Path, datum: Datum, tiles: Iterable[MapTile], keyframes: Iterable[Keyframe], min_views: int = MIN_VIEWS
) -> dict[str, Path]:
    """Write what the flight gives and return the path of each product by name.

    `trajectory.tum` holds `T_world_cam`. A flight without a surface gives its trajectory and no map files; a map
    file of an earlier export in the same folder is removed then, for it would belong to another datum.
    All files appear together at the end, so neither a full disk nor a crash leaves half a file under a product's name.
    Raises ExportError that names the file and the reason, and when there is neither a keyframe nor a surface.
    """
    newest, surface = newest_keyframes(keyframes), _surface(tiles, min_views)
    if not newest and surface is None:
        raise ExportError(f"{folder}: nothing to export, flight {datum.flight!r} has no keyframe and no surface yet")
    writers = _trajectory_writers(datum, newest) | (_map_writers(datum, surface) if surface else {})
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=folder) as unfinished:
            with ThreadPoolExecutor(_WRITERS_AT_ONCE) as pool:
                written = [
                    pool.submit(_write, w, Path(unfinished) / name, folder / name) for name, w in writers.items()
                ]
            for product in written:
                product.result()
            for name in writers:
                (Path(unfinished) / name).replace(folder / name)
    except OSError as error:
        raise ExportError(f"{folder}: cannot write the products ({error.strerror or error})") from error
    for name in set(MAP_PRODUCTS) - set(writers):
        (folder / name).unlink(missing_ok=True)
    return {name: folder / name for name in writers}


def _surface(tiles: Iterable[MapTile], min_views: int) -> Surface | None:
    held = list(tiles)
    surface = mosaic(held, min_views) if held else None
    return surface if surface is not None and surface.valid.any() else None


def _trajectory_writers(datum: Datum, keyframes: list[Keyframe]) -> dict[str, Writer]:
    t_ns = np.array([keyframe.t_ns for keyframe in keyframes], np.int64)
    return {
        "datum.json": lambda path: write_datum(path, datum),
        "trajectory.tum": lambda path: write_tum(path, t_ns, [keyframe.T_world_cam for keyframe in keyframes]),
        "trajectory.geojson": lambda path: write_geojson(path, datum, keyframes),
    }


def _map_writers(datum: Datum, surface: Surface) -> dict[str, Writer]:
    p_world, colour, sigma, views = surface.points()
    return {
        "map.laz": lambda path: write_points(path, p_world, colour, datum, sigma, views),
        "map.ply": lambda path: write_points_ply(path, p_world, colour, datum, sigma, views),
        "dsm.tif": lambda path: write_dsm(path, surface, datum),
        "ortho.tif": lambda path: write_ortho(path, surface, datum),
        "mesh.glb": lambda path: write_mesh(path, surface, datum),
        "mesh.ply": lambda path: write_mesh(path, surface, datum),
        "preview.jpg": lambda path: write_preview(path, surface),
    }


def _write(write: Writer, path: Path, product: Path) -> None:
    """Run one writer. Whatever library it uses, a failure to write becomes an ExportError that names the product."""
    try:
        write(path)
    except ExportError:
        raise
    except Exception as error:
        raise ExportError(f"{product}: cannot be written ({error or type(error).__name__})") from error
