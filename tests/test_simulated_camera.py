"""What the simulated camera draws, measured in its images against the projection of known points."""

import cv2
import numpy as np
import pytest

from air.sources.simulated.camera.camera import Camera, daylight
from air.sources.simulated.sites.layout import Bounds, Box, House, Layout
from air.sources.simulated.sites.noise import fractal
from air.sources.simulated.sites.scene import HOUSE, PLAIN, SOLID, Light, Scene
from air.sources.simulated.sites.solids import index_solids
from common.camera import CameraModel
from common.se3 import SE3, rotation_vector_to_matrix

BOUNDS = Bounds(-60.0, -60.0, 60.0, 60.0)
LENS = CameraModel(640, 480, 500.0, 498.0, 322.6, 236.3, k1=-0.06, k2=0.04, p1=0.001, p2=-0.0007)
# Light from everywhere, so that brightness is reflectance.
OVERCAST = Light(np.array([0.0, 0.0, 1.0]), np.zeros(3), np.ones(3))
PAINT_CELL = 0.05


def pose(tilt_deg: tuple[float, float] = (2.5, -2.0), azimuth: float = 0.4) -> SE3:
    """A camera about 40 m above the origin that looks down, tilted."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    down = np.array([[c, s, 0], [s, -c, 0], [0, 0, -1.0]])
    return SE3(down @ rotation_vector_to_matrix(np.radians([*tilt_deg, 0.0])), np.array([1.5, -2.0, 39.0]))


def make_scene(solids: np.ndarray, paint: np.ndarray | None = None, relief: float = 2.0) -> Scene:
    """Rolling ground (flat for `relief` 0), black unless painted, without fine detail."""
    terrain = fractal(np.random.default_rng(5), BOUNDS.grid(1.0), 1.0, ((60.0, relief), (10.0, 0.1 * relief)))
    if paint is None:
        paint = np.zeros((*BOUNDS.grid(PAINT_CELL), 4), np.uint8)
    rows, columns = BOUNDS.grid(2.0)
    highest = float(max(terrain.max(), solids["top"].max(initial=-np.inf)))
    return Scene(
        BOUNDS.west, BOUNDS.south, terrain.astype(float), 1.0, paint, PAINT_CELL, np.zeros((2, 64, 64), np.float32),
        solids, 2.0, columns, rows, *index_solids(solids, BOUNDS, 2.0), highest,
    )  # fmt: skip


def house(roof: float, wall: float) -> np.ndarray:
    """A gabled house turned by 25°, reflecting as said."""
    solids = np.zeros(1, SOLID)
    heading = np.radians(25.0)
    solids[0] = (
        HOUSE, 6.0, 3.0, np.cos(heading), np.sin(heading), 5.0, 3.5, 8.0, 0.6,
        (roof,) * 3, (wall,) * 3, PLAIN, PLAIN, 0,
    )  # fmt: skip
    return solids


def corner(solid: np.void, u: float, v: float, z: float) -> np.ndarray:
    """World coordinates of a point given along the axes of a house."""
    x, y = u * solid["cos"] - v * solid["sin"], u * solid["sin"] + v * solid["cos"]
    return np.array([solid["x"] + x, solid["y"] + y, z])


def bilinear_height(scene: Scene, x: float, y: float) -> float:
    """The definition of the terrain, written out once more."""
    u, v = x - BOUNDS.west, y - BOUNDS.south
    i, j = int(v), int(u)
    block = scene.terrain[i : i + 2, j : j + 2]
    return float(np.array([1 - (v - i), v - i]) @ block @ np.array([1 - (u - j), u - j]))


def project(T_world_cam: SE3, p_world: np.ndarray) -> np.ndarray:
    """Pixels by OpenCV's own projection."""
    T_cam_world = T_world_cam.inverse()
    rotation = cv2.Rodrigues(T_cam_world.R)[0]
    return cv2.projectPoints(np.atleast_2d(p_world), rotation, T_cam_world.t, LENS.K, LENS.distortion)[0][:, 0]


def test_painted_marks_appear_where_they_project() -> None:
    rng = np.random.default_rng(1)
    # On a loose grid, so that the marks do not touch; 0.3 m is about 4 px.
    marks = np.stack(np.meshgrid(np.arange(-18, 21, 4.0), np.arange(-15, 14, 4.0)), -1).reshape(-1, 2)
    marks = marks + rng.uniform(-0.5, 0.5, marks.shape)
    rows, columns = BOUNDS.grid(PAINT_CELL)
    x, y = BOUNDS.west + PAINT_CELL * np.arange(columns), BOUNDS.south + PAINT_CELL * np.arange(rows)
    light = np.zeros((rows, columns))
    for mx, my in marks:
        light += np.exp(-((y - my) ** 2) / 0.18)[:, None] * np.exp(-((x - mx) ** 2) / 0.18)[None, :]
    paint = np.zeros((rows, columns, 4), np.uint8)
    paint[..., :3] = np.round(255 * np.sqrt(0.9 * np.clip(light, 0, 1)))[..., None]
    scene = make_scene(np.zeros(0, SOLID), paint)
    image = Camera(LENS, OVERCAST).linear_image(scene, pose())[..., 1]

    truth = project(pose(), np.array([[mx, my, bilinear_height(scene, mx, my)] for mx, my in marks]))
    inside = ((truth > 20) & (truth < [LENS.width - 20, LENS.height - 20])).all(axis=1)
    assert inside.sum() >= 60
    errors = np.array([_centroid(image, uv) - uv for uv in truth[inside]])
    assert np.abs(errors).max() < 0.1
    assert np.abs(errors.mean(axis=0)).max() < 0.02


def _centroid(image: np.ndarray, near: np.ndarray, radius: int = 14) -> np.ndarray:
    u0, v0 = np.round(near).astype(int)
    window = image[v0 - radius : v0 + radius + 1, u0 - radius : u0 + radius + 1].astype(float)
    v, u = np.mgrid[v0 - radius : v0 + radius + 1, u0 - radius : u0 + radius + 1]
    return np.array([(u * window).sum(), (v * window).sum()]) / window.sum()


def _edge_offset(image: np.ndarray, edge: np.ndarray, inside: np.ndarray, level: float) -> float:
    """Mean distance in px, outwards, of a bright area's edge from where it projects (N, 2), by profiles across it."""
    along = np.gradient(edge, axis=0)
    out = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    out = out if out[0] @ (inside - edge[0]) < 0 else -out
    reach = 4.0
    depth = np.linspace(-reach, reach, 161)
    at = (edge[:, None] + depth[None, :, None] * out[:, None]).astype(np.float32)
    profile = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR).mean(axis=0) / level
    return float(np.trapezoid(profile, depth) - reach)


def edge_pixels(T_world_cam: SE3, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) along the middle of a straight edge in the world; the lens bends it."""
    s = np.linspace(0.15, 0.85, 200)[:, None]
    return project(T_world_cam, a + s * (b - a))


@pytest.mark.parametrize("azimuth", [0.4, 2.1, 4.0])
def test_the_edges_of_roof_and_wall_appear_where_they_project(azimuth: float) -> None:
    T = SE3(pose((-3.0, 2.0), azimuth).R, np.array([4.0, -9.0, 39.0]))
    solid = house(0.0, 0.0)[0]
    a, b, eave = solid["a"], solid["b"], solid["top"] - solid["slope"] * solid["b"]
    roof_middle = project(T, corner(solid, 0.0, 0.0, solid["top"]))[0]
    roof = Camera(LENS, OVERCAST).linear_image(make_scene(house(1.0, 0.0), relief=0.0), T)[..., 1]
    for v in (-b, b):
        edge = edge_pixels(T, corner(solid, -a, v, eave), corner(solid, a, v, eave))
        assert abs(_edge_offset(roof, edge, roof_middle, roof.max())) < 0.1

    # The south wall, which faces the camera, bright between black roof and black ground: its foot and its top.
    wall = Camera(LENS, OVERCAST).linear_image(make_scene(house(0.0, 1.0), relief=0.0), T)[..., 1]
    wall_middle = project(T, corner(solid, 0.0, -b, eave / 2))[0]
    for z in (0.0, eave):
        edge = edge_pixels(T, corner(solid, -a, -b, z), corner(solid, a, -b, z))
        assert np.linalg.norm(edge.mean(axis=0) - wall_middle) > 5, "the wall is wide enough to measure"
        assert abs(_edge_offset(wall, edge, wall_middle, wall.max())) < 0.1


def test_a_shadow_falls_where_the_sun_puts_it() -> None:
    light = daylight()
    scene = make_scene(house(0.5, 0.5), np.full((*BOUNDS.grid(PAINT_CELL), 4), (255, 255, 255, 0), np.uint8), 0.0)
    image = Camera(LENS, light).linear_image(scene, pose())[..., 1]
    # The sun is in the south-east, so the north eave casts the edge of the shadow.
    eave = corner(house(0, 0)[0], 0.0, 3.5, 8.0 - 0.6 * 3.5)
    edge = eave - light.sun * eave[2] / light.sun[2]
    away = (edge - eave)[:2] / np.linalg.norm((edge - eave)[:2])
    shade, sun = (project(pose(), np.array([*(edge[:2] + step * away), 0.0]))[0] for step in (-0.2, 0.2))
    darker, lighter = (image[round(v), round(u)] for u, v in (shade, sun))
    assert darker < 0.5 * lighter


def test_an_image_is_the_same_every_time_and_its_noise_is_slight() -> None:
    scene = make_scene(house(0.3, 0.5), np.full((*BOUNDS.grid(PAINT_CELL), 4), (120, 120, 120, 0), np.uint8))
    camera = Camera(LENS, daylight())
    first, again, other = (camera.image(scene, pose(), np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    difference = first.astype(float) - other
    # Two images with noise of 1.6 and rounding of 0.29 each.
    assert difference.std() == pytest.approx(np.sqrt(2 * (1.6**2 + 1 / 12)), rel=0.05)


def test_a_layout_keeps_houses_within_their_corners() -> None:
    box = Box(1.0, 2.0, np.radians(90), 3.0, 1.0, 2.5)
    np.testing.assert_allclose(np.abs(box.corners() - [1.0, 2.0]), np.tile([1.0, 3.0], (4, 1)))
    assert Layout(BOUNDS, houses=[House(box)]).houses[0].wing is None
