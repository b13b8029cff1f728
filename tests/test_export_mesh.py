"""Meshes, read back by trimesh."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from export_scene import TILTED, N, colour_of, plane, tile, tiles

from common.errors import ExportError
from common.export.mesh import triangulate, write_mesh
from common.export.surface import mosaic


def load(path: Path) -> trimesh.Trimesh:
    loaded = trimesh.load(path, process=False, force="mesh")
    assert isinstance(loaded, trimesh.Trimesh)
    return loaded


def test_ply_is_the_surface_in_the_world_frame(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", mosaic(tiles()), TILTED)
    mesh = load(tmp_path / "mesh.ply")
    side = 4 * N
    assert (len(mesh.vertices), len(mesh.faces)) == (side**2, 2 * (side - 1) ** 2)
    assert mesh.vertices[:, 2] == pytest.approx(plane(mesh.vertices[:, 0], mesh.vertices[:, 1]), abs=1e-4)
    assert (mesh.face_normals[:, 2] > 0.9).all()
    # The plane's area by its slope.
    assert mesh.area == pytest.approx(((side - 1) * 0.25) ** 2 * np.sqrt(1 + 0.2**2 + 0.1**2), rel=1e-4)


def test_glb_has_y_up_and_north_away(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.glb", mosaic(tiles()), TILTED)
    mesh = load(tmp_path / "mesh.glb")
    x, y, z = mesh.vertices.T
    assert y == pytest.approx(plane(x, -z), abs=1e-4)
    assert (mesh.face_normals[:, 1] > 0.9).all()


def test_glb_colours_are_linear_light(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.glb", mosaic(tiles()), TILTED)
    (mesh,) = trimesh.load_scene(tmp_path / "mesh.glb", process=False).geometry.values()
    linear = np.asarray(mesh.visual.vertex_attributes["color"])[:, :3] / 65535
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    x, _, z = mesh.vertices.T
    assert srgb * 255 == pytest.approx(colour_of(x, -z), abs=0.1)


def test_large_surface_is_thinned_to_the_limit_and_stays_true(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", mosaic(tiles(radius=5)), TILTED, max_triangles=20_000)
    mesh = load(tmp_path / "mesh.ply")
    assert 8_000 < len(mesh.faces) <= 20_000
    # The height of the median cell belongs to the square's middle but for the slope within one cell.
    assert np.abs(mesh.vertices[:, 2] - plane(mesh.vertices[:, 0], mesh.vertices[:, 1])).max() < 0.05


def test_thinning_ignores_a_lone_spike() -> None:
    surface = mosaic(tiles())
    surface.height[::4, ::4] += 50.0
    assert triangulate(surface, max_triangles=4_000).p_world[:, 2].max() < 10.0


def test_holes_stay_open_and_no_triangle_touches_them() -> None:
    holed = tile(0, 0)
    holed.height[10:14, 10:14] = np.nan
    mesh = triangulate(mosaic([holed]))
    assert np.isfinite(mesh.p_world).all()
    # Five by five squares touch the hole of four by four cells; each corner square keeps one triangle.
    assert len(mesh.triangles) == 2 * ((N - 1) ** 2 - 25) + 4


def test_walls_are_closed() -> None:
    built = tile(0, 0, lambda e, n: 0 * e)
    built.height[8:20, 8:20] = 9.0
    surface = mosaic([built])
    mesh = trimesh.Trimesh(*_geometry(surface), process=False)
    assert len(mesh.faces) == 2 * (N - 1) ** 2
    # Only the outline of the map is open.
    edges = np.sort(mesh.edges, axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert np.count_nonzero(count == 1) == 4 * (N - 1)


def _geometry(surface):  # type: ignore[no-untyped-def]
    mesh = triangulate(surface)
    return mesh.p_world, mesh.triangles


def test_unknown_suffix_and_empty_surface_are_refused(tmp_path: Path) -> None:
    surface = mosaic([tile(0, 0)])
    with pytest.raises(ExportError, match=r"mesh\.obj.*\.glb or \.ply"):
        write_mesh(tmp_path / "mesh.obj", surface, TILTED)
    surface.height[:] = np.nan
    with pytest.raises(ExportError, match=r"mesh\.glb"):
        write_mesh(tmp_path / "mesh.glb", surface, TILTED)
