"""Sites of the flight simulator: their truth against brute force, their options, and sites from files."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import from_bounds
from video_scene import Gliding, camera, fiducial_site

from air.sources.simulated.camera.video import CameraOptions
from air.sources.simulated.sites.geotiff import GeotiffOptions, read_site
from air.sources.simulated.sites.layout import Bounds, Box
from air.sources.simulated.sites.sites import SITES, WorldOptions, generate_site, texel_of
from air.sources.simulated.sites.surface import CELL
from common.errors import SourceError
from common.geo import geodetic_to_enu

SMALL = Bounds(-75.0, -20.0, -15.0, 25.0)
STILL = Gliding(np.array([-45.0, 0.0, 40.0]), np.zeros(3), np.zeros(3), 1.0)


@pytest.fixture(scope="module", params=sorted(SITES))
def site(request):
    """A corner of every site; the playground's has its stands."""
    return generate_site(WorldOptions(site=request.param, texel=0.1), 4, SMALL)


def test_rays_end_on_the_surface_and_meet_nothing_before(site) -> None:
    rng = np.random.default_rng(1)
    origin = np.array([-44.0, 2.0, 40.0])
    rays = np.column_stack([rng.uniform(-0.6, 0.6, (400, 2)), -np.ones(400)])
    p, _ = site.intersect(origin, rays)
    # Brute force: a step of a centimetre along every ray, a thousand before the end.
    length = np.linalg.norm(p - origin, axis=1)
    back = np.arange(0.015, 10.0, 0.01)
    for end, way, far in zip(p, (p - origin) / length[:, None], length, strict=True):
        before = end - back[back < far, None] * way
        above = before[:, 2] - site.height(before[:, :2])
        # The crown's roughness is finer than the marching step of a cell: it may be grazed by some centimetres.
        assert above.min() > -0.25
        assert (above < 0).mean() < 0.03
        after = end + 0.03 * way
        assert after[2] < site.height(after[None, :2])[0] + 0.02


def test_the_depth_of_every_pixel_is_where_its_ray_ends(site) -> None:
    cam = camera(site, STILL, replace(CameraOptions.perfect(), width=640, height=360))
    poses = cam.poses(0.5)
    cam.look(poses)
    rows, columns = (n.ravel() for n in np.mgrid[3:360:23, 5:640:29])
    d_cam = np.column_stack([cam._rays[rows, columns], np.ones(len(rows))])
    p, _ = site.intersect(poses.p_world[0], d_cam @ poses.R_world_cam[0].T)
    depth = (p - poses.p_world[0]) @ poses.R_world_cam[0][:, 2]
    off = np.abs(cam._depth[rows, columns] - depth)
    # Two centimetres at 40 m are 0.15 px at the edge of the image; in crowns the finest twigs are skipped.
    assert (off < 0.02).mean() > 0.97
    assert np.median(off) < 0.002


def test_what_hides_the_sky_is_found(site) -> None:
    rng = np.random.default_rng(2)
    azimuth, elevation = rng.uniform(0, 2 * np.pi, 60), rng.uniform(0.3, 1.5, 60)
    sky = np.column_stack([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    for xy in ((-40.0, 1.0), (-51.0, -3.0), (-35.0, 5.0)):
        place = np.array([*xy, site.height([xy])[0] + 0.5])
        away = np.arange(0.0, 45.0, 0.02)
        expected = np.array([np.any(site.height((q := place + away[:, None] * ray)[:, :2]) > q[:, 2]) for ray in sky])
        assert (site.blocked(place, sky) == expected).mean() > 0.96
    assert not site.blocked(np.array([-45.0, 0.0, 40.0]), sky).any()


def test_truth_as_raster_and_as_cloud_agree(site) -> None:
    dsm = site.dsm()
    assert dsm.shape == SMALL.grid(CELL)
    p, colour = (np.concatenate(part) for part in zip(*site.cloud(0.5), strict=True))
    column, row = np.round(SMALL.pixels(p[:, :2], CELL)).astype(int).T
    assert np.median(np.abs(dsm[row, column] - p[:, 2])) < 0.05
    assert colour.std(axis=0).min() > 3


def test_a_site_is_a_function_of_its_seed() -> None:
    first, again, other = (generate_site(WorldOptions(site="town", texel=0.2), n, SMALL) for n in (1, 1, 2))
    np.testing.assert_array_equal(first.surface.colour, again.surface.colour)
    np.testing.assert_array_equal(first.surface.solids, again.surface.solids)
    np.testing.assert_array_equal(first.dsm(), again.dsm())
    assert not np.array_equal(first.surface.colour, other.surface.colour)


def test_a_large_site_has_coarser_texels_so_that_it_fits() -> None:
    assert texel_of(Bounds(-100, -100, 100, 100), 0.02) == pytest.approx(0.02)
    assert texel_of(Bounds(-500, -500, 500, 500), 0.02) == pytest.approx(0.1)


def test_a_pond_is_level_and_lies_in_a_hollow() -> None:
    pond = generate_site(WorldOptions(site="field", texel=0.2, water=8.0), 1, Bounds(-60, -60, 60, 60))
    p, solid = pond.intersect(
        np.array([0.0, 0.0, 60.0]),
        np.column_stack([np.mgrid[-0.9:0.9:60j, -0.9:0.9:60j].reshape(2, -1).T, -np.ones(3600)]),
    )
    water = solid == -2
    assert water.sum() > 20
    np.testing.assert_allclose(p[water, 2], pond.surface.water, atol=1e-6)
    assert np.all(pond.terrain(p[water, :2]) < pond.surface.water + 1e-3)


def test_cars_drive_along_their_lanes_and_are_drawn_where_they_are() -> None:
    options = WorldOptions(site="playground", texel=0.2, cars=4, car_speed=10.0)
    site = generate_site(options, 1, Bounds(-60, -60, 60, 60))
    assert len(site.movers) == 4
    x, y, _ = site.movers[0].pose(1.0)
    moved = np.hypot(*np.subtract(site.movers[0].pose(1.5)[:2], (x, y)))
    assert moved == pytest.approx(0.5 * site.movers[0].speed, rel=0.05)
    cam = camera(
        site,
        Gliding(np.array([x, y, 40.0]), np.zeros(3), np.zeros(3)),
        replace(CameraOptions.perfect(), width=640, height=360),
    )
    poses = cam.poses(1.0)
    cam.look(poses)
    u, v = cam.model.project(
        poses.R_world_cam[180].T @ (np.array([x, y, site.terrain([[x, y]])[0] + 1.0]) - poses.p_world[180])
    )
    assert cam._what[round(v), round(u)] >= 16 * site.surface.still


def test_swaying_plants_move_and_the_ground_does_not() -> None:
    site = generate_site(WorldOptions(site="forest", texel=0.1, sway=0.2), 4, SMALL)
    cam = camera(site, STILL, replace(CameraOptions.perfect(), width=640, height=360))
    first = cam.look(cam.poses(0.1)).copy()
    difference = np.abs(cam.look(cam.poses(0.6)) - first).max(axis=2)
    poses = cam.poses(0.1)
    d_world = np.concatenate([cam._rays, np.ones((360, 640, 1), np.float32)], axis=2) @ poses.R_world_cam[0].T
    p = poses.p_world[0] + cam._depth[..., None] * d_world
    plants = p[..., 2] - site.terrain(p[..., :2].reshape(-1, 2)).reshape(360, 640)
    bare = cv2.dilate((plants > 0.02).astype(np.uint8), np.ones((9, 9))) == 0
    assert difference[bare].max() < 1e-6
    assert difference[plants > 3.0].mean() > 0.005


def test_a_wall_has_a_sharp_edge() -> None:
    site = fiducial_site(np.zeros((0, 2)), relief=0.0, boxes=(Box(0.0, 0.0, 0.0, 5.0, 0.14, 2.2),))
    np.testing.assert_allclose(site.height([[0.0, 0.139], [0.0, 0.141]]), [2.2, 0.0], atol=1e-9)
    p, solid = site.intersect(np.array([0.0, -30.0, 30.0]), np.array([[0.0, 32.0, -30.0], [0.0, 29.0, -29.5]]))
    assert solid.tolist() == [0, -1]
    assert p[0, 1] == pytest.approx(-0.14, abs=1e-9)


# Sites from files


def write_tiff(path: Path, bands: np.ndarray, crs: str, bounds: tuple[float, float, float, float]) -> str:
    count, height, width = bands.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=width, height=height, count=count, dtype=bands.dtype, crs=crs,
        transform=from_bounds(*bounds, width, height),
    ) as raster:  # fmt: skip
        raster.write(bands)
    return str(path)


def test_files_in_two_projections_are_laid_on_one_another(tmp_path: Path) -> None:
    # A hill at one place, and a red spot on it, in web mercator and in UTM.
    mercator, utm = (Transformer.from_crs("EPSG:4326", f"EPSG:{code}", always_xy=True) for code in (3857, 32617))
    west, south, east, north, spot = -81.752, 41.303, -81.751, 41.304, (-81.7513, 41.3034)
    a, b = mercator.transform([west, east], [south, north]), utm.transform([west, east], [south, north])
    photo, heights = np.full((3, 800, 600), 90, np.uint8), np.full((1, 500, 400), 200.0, np.float32)
    for grid, transformer, corners, paint in ((photo, mercator, a, (250, 20, 20)), (heights, utm, b, (210.0,))):
        x, y = transformer.transform(*spot)
        _, rows, columns = grid.shape
        column = (x - corners[0][0]) / (corners[0][1] - corners[0][0]) * columns - 0.5
        row = (corners[1][1] - y) / (corners[1][1] - corners[1][0]) * rows - 0.5
        v, u = np.mgrid[:rows, :columns]
        metres = (corners[0][1] - corners[0][0]) / columns * (0.751 if transformer is mercator else 1.0)
        grid[:, np.hypot(u - column, v - row) * metres < 3.0] = np.array(paint)[:, None]
    ortho = write_tiff(tmp_path / "ortho.tif", photo, "EPSG:3857", (a[0][0], a[1][0], a[0][1], a[1][1]))
    dsm = write_tiff(tmp_path / "dsm.tif", heights, "EPSG:32617", (b[0][0], b[1][0], b[0][1], b[1][1]))
    site, datum = read_site(GeotiffOptions(ortho, dsm), 1, "hill")
    assert datum.height == pytest.approx(200.0, abs=0.01)
    place = geodetic_to_enu(datum, spot[1], spot[0], 210.0)
    p, colour = (np.concatenate(part) for part in zip(*site.cloud(0.2), strict=True))
    for chosen in (p[:, 2] > 5.0, colour[:, 0] > 1.8 * colour[:, 1]):
        # The pixels of the files are 0.14 and 0.2 m wide.
        np.testing.assert_allclose(p[chosen, :2].mean(axis=0), place[:2], atol=0.15)
        assert chosen.sum() * 0.04 == pytest.approx(np.pi * 9, rel=0.08)
    assert p[p[:, 2] > 5, 2].max() == pytest.approx(place[2], abs=0.02)


def test_a_real_orthophoto_makes_a_site(real_data, tmp_path: Path) -> None:
    folder = real_data("world_fukumoto")
    with rasterio.open(folder / "ortho_z21.png") as photo:
        bands = photo.read([1, 2, 3])
    # A mosaic of whole web mercator tiles: its corner is that of the tile which holds the stated corner.
    pixel = 2 * np.pi * 6378137.0 / (256 << 21)
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(
        -81.75223013722616, 41.30306910385722
    )
    left, bottom = (np.floor((c + np.pi * 6378137.0) / (256 * pixel)) * 256 * pixel - np.pi * 6378137.0 for c in (x, y))
    bounds = (left, bottom, left + bands.shape[2] * pixel, bottom + bands.shape[1] * pixel)
    ortho = write_tiff(tmp_path / "ortho.tif", bands, "EPSG:3857", bounds)
    site, datum = read_site(GeotiffOptions(ortho, str(folder / "dsm.tif"), 0.05), 1, "fukumoto")
    assert 100 < site.bounds.east - site.bounds.west < 160
    assert (datum.latitude_deg, datum.longitude_deg) == pytest.approx((41.3036, -81.7516), abs=1e-3)
    assert site.orthophoto()[1000:1500, 1000:1500, :3].std() > 10


def test_a_file_that_is_none_or_lies_nowhere_is_named(tmp_path: Path) -> None:
    good = write_tiff(tmp_path / "good.tif", np.ones((1, 8, 8), np.float32), "EPSG:32617", (0, 0, 8, 8))
    far = write_tiff(tmp_path / "far.tif", np.ones((1, 8, 8), np.float32), "EPSG:32617", (900, 0, 908, 8))
    nowhere = tmp_path / "nowhere.tif"
    with rasterio.open(nowhere, "w", driver="GTiff", width=8, height=8, count=1, dtype="uint8") as raster:
        raster.write(np.ones((1, 8, 8), np.uint8))
    for ortho, dsm, words in (
        (str(tmp_path / "none.tif"), good, "ortho=.*none.tif cannot be read"),
        (good, str(nowhere), "dsm=.*nowhere.tif says not where it lies"),
        (good, far, "do not overlap"),
    ):
        with pytest.raises(SourceError, match=words):
            read_site(GeotiffOptions(ortho, dsm), 1, "x")
