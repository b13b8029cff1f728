"""The simulated surface: rays against it, its files, its variety."""

import cv2
import numpy as np
import pytest

from air.sources.simulated.sites.layout import Bounds
from air.sources.simulated.sites.scene import DOME, GROUND, HOUSE
from air.sources.simulated.sites.world import World, generate_world

BOUNDS = Bounds(-55.0, -50.0, 55.0, 50.0)


@pytest.fixture(scope="module")
def world() -> World:
    return generate_world(3, BOUNDS)


def downward_rays(rng: np.random.Generator, n: int) -> np.ndarray:
    rays = rng.uniform(-0.75, 0.75, (n, 3))
    rays[:, 2] = -1.0
    return rays


def test_rays_end_at_the_first_point_of_the_surface(world: World) -> None:
    """Against brute force: along each ray the surface is below all the way, and is met where the ray ends."""
    rng = np.random.default_rng(0)
    for origin in (np.array([5.0, 3.0, 40.0]), np.array([-20.0, 12.0, 38.0])):
        p, _ = world.intersect(origin, downward_rays(rng, 1500))
        within = (p[:, 0] > -54) & (p[:, 0] < 54) & (p[:, 1] > -49) & (p[:, 1] < 49)
        p = p[within]
        assert len(p) > 1000
        length = np.linalg.norm(p - origin, axis=1, keepdims=True)
        ahead = (p - origin) / length
        for back in np.arange(0.002, 25.0, 0.02):
            q = p - back * ahead
            assert (q[:, 2] > world.height(q[:, :2]) - 1e-6).all(), f"{back} m before its end a ray is inside"
        just_behind = p + 0.002 * ahead
        assert (just_behind[:, 2] < world.height(just_behind[:, :2])).all()


def test_points_between_walls_lie_on_the_surface_exactly(world: World) -> None:
    p, solid = world.intersect(np.array([0.0, 0.0, 40.0]), downward_rays(np.random.default_rng(1), 3000))
    ground = solid < 0
    assert ground.sum() > 1500
    # A pixel is 40 mm: 0.2 mm are far below 0.1 px.
    assert np.abs(p[ground, 2] - world.height(p[ground, :2])).max() < 2e-4


def test_the_height_is_that_of_the_highest_thing(world: World) -> None:
    solids = world.scene.solids
    for k in np.flatnonzero(solids["kind"] == HOUSE)[:20]:
        ridge = np.array([[solids["x"][k], solids["y"][k]]])
        assert world.height(ridge)[0] >= solids["top"][k] - 1e-9
    assert (world.height(np.random.default_rng(2).uniform(-50, 50, (2000, 2))) <= world.scene.highest).all()


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5])
def test_every_seed_gives_a_village(seed: int) -> None:
    world = generate_world(seed, BOUNDS)
    solids = world.scene.solids
    houses = solids[(solids["kind"] == HOUSE) & (solids["a"] > 3.2)]
    above = houses["top"] - world.terrain(np.stack([houses["x"], houses["y"]], axis=1))
    assert len(houses) >= 4
    # Relief of half a metre under a house comes on top of walls and roof of 3 to 9 m.
    assert 2.4 < above.min() < above.max() < 10.5
    assert (solids["kind"] == DOME).sum() > 100
    assert 2.0 < np.ptp(world.scene.terrain) < 20.0


def test_the_world_is_a_function_of_its_seed() -> None:
    small = Bounds(-20.0, -20.0, 20.0, 20.0)
    first, again, other = (generate_world(seed, small) for seed in (7, 7, 8))
    for name in ("terrain", "paint", "detail", "solids", "listed"):
        np.testing.assert_array_equal(getattr(first.scene, name), getattr(again.scene, name))
    assert not np.array_equal(first.scene.terrain, other.scene.terrain)


def test_the_ground_is_textured_at_the_scale_of_a_pixel_and_does_not_repeat(world: World) -> None:
    """The fine detail (within half a metre) of patches of 2.4 m, sampled every 4 cm, is strong and never alike.

    But for roads, whose markings are meant to be alike.
    """
    patches = []
    for x, y in np.random.default_rng(4).uniform(-50, 45, (120, 2)):
        xy = np.stack(np.meshgrid(x + 0.04 * np.arange(60), y + 0.04 * np.arange(60)), -1).reshape(-1, 2)
        z, solid = world.top(xy)
        if (solid < 0).all():
            face = np.full(len(xy), GROUND, np.int32)
            colour = world.colour(np.column_stack([xy, z]), solid, face).reshape(60, 60, 3).astype(np.float32)
            green, blue = colour[..., 1], colour[..., 2]
            if green.mean() > blue.mean() + 10:
                patches.append((green - cv2.blur(green, (13, 13))).ravel())
    assert len(patches) > 40
    assert np.median([patch.std() for patch in patches]) > 6
    alike = np.corrcoef(np.array(patches)) - np.eye(len(patches))
    assert np.abs(alike).max() < 0.3
