"""The viewer: what is chosen and coloured, and what a real browser shows."""

import socket
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from browser import chromium
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_map import DATUM_HERE, FakeAircraft, keyframe, pose, site_tile, small_tile

from common.bus_memory import MemoryBroker, MemoryBus
from common.errors import ConfigError
from common.wire import encode
from ground.cloud import hold_tile
from ground.config import ViewerConfig
from ground.gateway import Gateway
from ground.station import Station
from ground.viewer.detail import View, choose_levels, in_view
from ground.viewer.levels import MAX_LEVEL, LevelCache, reduced
from ground.viewer.points import Colouring, Style, tile_points
from ground.viewer.scene import Scene
from ground.viewer.tiles import TileShown
from ground.viewer.viewer import Viewer

PHOTO = Style(Colouring.PHOTO, min_views=2, show_uncertain=False, z_range=(0.0, 0.0))
DOWN = View(np.array([0.0, 0.0, 100.0]), np.diag([1.0, -1.0, -1.0]), np.radians(50), 1.6, 800)


# Levels


def test_a_reduced_tile_covers_the_same_ground_at_the_same_height() -> None:
    tile = site_tile(0, 1, n=64, cell=0.4)
    coarse = reduced(tile, min_views=2)
    assert coarse.height.shape == (32, 32)
    assert coarse.cell == 0.8
    used = np.isfinite(tile.height) & ~tile.disputed & (tile.views >= 2)
    blocks = np.where(used, tile.height, np.nan).reshape(32, 2, 32, 2)
    whole = np.isfinite(blocks).all(axis=(1, 3))
    np.testing.assert_allclose(coarse.height[whole], blocks.mean(axis=(1, 3))[whole], atol=1e-4)
    assert not (coarse.disputed & whole).any()


def test_uncertain_cells_only_count_where_there_are_no_others() -> None:
    tile = small_tile(0, 0)
    height, views, disputed = np.zeros((16, 16), np.float32), np.full((16, 16), 5, np.uint8), np.zeros((16, 16), bool)
    height[0, 0], disputed[0, 0] = 100.0, True  # one of four cells in dispute
    height[2:4, 2:4], views[2:4, 2:4] = 7.0, 1  # a block of too few views
    height[4:6, 4:6] = np.nan
    coarse = reduced(replace(tile, height=height, views=views, disputed=disputed), min_views=2)
    assert coarse.height[0, 0] == 0.0
    assert not coarse.disputed[0, 0]
    assert (coarse.height[1, 1], coarse.views[1, 1]) == (7.0, 1)
    assert np.isnan(coarse.height[2, 2])


def test_the_cache_gives_each_revision_its_own_levels() -> None:
    cache = LevelCache(min_views=2, limit=50_000)
    for revision in (1, 2):
        tile = small_tile(0, 0, revision)
        held = hold_tile("uav1", tile, encode(tile))
        for level in (3, 0, 2, 1):
            assert cache.level(held, level).height.shape == (16 >> level, 16 >> level)
            assert cache.level(held, level).revision == revision


# Level of detail


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), tiles=st.integers(1, 400), budget=st.integers(20_000, 500_000))
def test_the_budget_holds_whatever_there_is_to_see(seed: int, tiles: int, budget: int) -> None:
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-500, 500, (tiles, 3)) * [1, 1, 0.05]
    radius, cell, points = np.full(tiles, 18.0), np.full(tiles, 0.1), rng.uniform(0, 65_536, tiles)
    previous = rng.integers(-1, MAX_LEVEL + 1, tiles)
    levels = choose_levels(DOWN, centre, radius, cell, points, budget, previous)
    assert levels.shape == (tiles,)
    assert levels.min() >= 0
    assert (points / 4.0**levels).sum() <= budget


def test_the_near_is_finer_than_the_far_and_the_seen_than_the_unseen() -> None:
    centre = np.array([[0.0, 0, 60], [0, 0, -400.0], [0, 0, 140.0]])
    levels = choose_levels(DOWN, centre, np.full(3, 5.0), np.full(3, 0.1), np.full(3, 1e3), 10**6)
    np.testing.assert_array_equal(in_view(DOWN, centre, np.full(3, 5.0)), [True, True, False])
    assert levels[0] < levels[1]
    assert levels[0] < levels[2]


def test_a_level_is_kept_while_the_camera_trembles() -> None:
    centre, one = np.zeros((1, 3)), np.ones(1)
    previous, changes = None, 0
    for height in 100 + 3 * np.sin(np.arange(50)):
        view = replace(DOWN, p_scene=np.array([0.0, 0.0, height]))
        levels = choose_levels(view, centre, one, 0.05 * one, 65_536 * one, 10**6, previous)
        changes += previous is not None and bool((levels != previous).any())
        previous = levels
    assert changes <= 1


# Points


def test_points_lie_on_the_surface_at_the_centres_of_their_cells() -> None:
    tile = site_tile(-1, 0, n=64, cell=0.4)
    held = hold_tile("uav1", tile, b"")
    points, colours = tile_points(tile, held.centre, PHOTO)
    shown = np.isfinite(tile.height) & ~tile.disputed & (tile.views >= 2)
    assert len(points) == len(colours) >= shown.sum()
    row, col = np.nonzero(shown)
    world = points[: len(row)].astype(np.float16).astype(float) + held.centre  # as it travels
    np.testing.assert_allclose(world[:, 0], (tile.id.x * 64 + col + 0.5) * 0.4, atol=0.01)
    np.testing.assert_allclose(world[:, 1], (tile.id.y * 64 + row + 0.5) * 0.4, atol=0.01)
    np.testing.assert_allclose(world[:, 2], tile.height[shown], atol=0.01)
    np.testing.assert_array_equal(colours[: len(row)], tile.colour[shown])


def test_walls_are_filled_between_their_feet_and_their_tops() -> None:
    tile = small_tile(0, 0)
    height = np.zeros((16, 16), np.float32)
    height[4:12, 4:12] = 10.0
    tile = replace(tile, height=height, views=np.full((16, 16), 5, np.uint8), disputed=np.zeros((16, 16), bool))
    points, _ = tile_points(tile, np.zeros(3), PHOTO)
    wall = points[256:]
    assert set(np.unique(wall[:, 2])) == set(np.arange(1.0, 10.0))
    assert len(wall) == 28 * 9  # the 28 cells around a square of 8 × 8
    assert (np.abs(wall[:, :2] - 8).max(axis=1) == 3.5).all()


@pytest.mark.parametrize("colouring", list(Colouring))
def test_uncertain_cells_are_shown_only_when_asked_for(colouring: Colouring) -> None:
    tile = small_tile(2, 1)
    held = hold_tile("uav1", tile, b"")
    style = Style(colouring, 4, False, (-5.0, 5.0))
    few, _ = tile_points(tile, held.centre, style)
    every, _ = tile_points(tile, held.centre, replace(style, show_uncertain=True))
    assert len(few) < len(every) >= np.isfinite(tile.height).sum()


# The page


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_taken_port_is_refused_by_name() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=str(port)):
            Viewer(ViewerConfig(port=port), "ground", 2, Scene)


@pytest.fixture
def service() -> Iterator[tuple[MemoryBroker, Viewer]]:
    broker = MemoryBroker()
    gateway = Gateway(MemoryBus(broker), Station("ground"), None, time.time_ns)
    gateway.start()
    viewer = Viewer(ViewerConfig(port=free_port(), point_budget=60_000), "ground", 2, gateway.scene)
    yield broker, viewer
    viewer.close()
    gateway.close()


@pytest.mark.browser
def test_a_browser_shows_the_map_and_how_the_service_is_doing(service: tuple[MemoryBroker, Viewer]) -> None:
    broker, viewer = service
    shown: list[TileShown] = []
    viewer.on_tile_shown(shown.append)
    with chromium(viewer.url) as browser:
        browser.page.get_by_text("nothing has arrived yet").wait_for(timeout=30_000)
        empty = browser.screenshot()

        aircraft = FakeAircraft(MemoryBus(broker))
        aircraft.beat()
        for x in (-1, 0):
            for y in (-1, 0):
                aircraft.send_tile(site_tile(x, y, n=128, cell=0.2))
        aircraft.send_keyframe(keyframe(0))
        aircraft.send_pose(pose(3 * 10**9, 5.0, 5.0))
        browser.page.get_by_text("photogrammetric").wait_for(timeout=20_000)
        browser.wait(4.0)
        full = browser.screenshot()

        assert "Tiles\t4" in browser.text()
        map_part = np.s_[250:700, 200:900]  # beside the panel
        changed = np.abs(full[map_part].astype(int) - empty[map_part]).max(axis=-1) > 40
        assert changed.mean() > 0.2
        green = full[map_part].astype(int)
        assert ((green[..., 1] > green[..., 0]) & (green[..., 1] > green[..., 2] + 20)).mean() > 0.1

        sent = {(s.id.x, s.id.y): s.monotonic_ns for s in shown}
        assert len(sent) == 4
        for (x, y), handed_ns in sent.items():
            frames = browser.received(f"/map/uav1_{DATUM_HERE.flight}/0_{x}_{y}")
            assert frames
            assert frames[0].monotonic_ns > handed_ns - 50_000_000

        before = len(browser.received("/map/"))
        aircraft.send_tile(site_tile(0, 0, revision=2, n=128, cell=0.2))
        browser.wait(2.0)
        changed_names = {m["name"] for f in browser.received("/map/")[before:] for m in f.messages() if "name" in m}
        assert {name for name in changed_names if name.startswith("/map/")} == {f"/map/uav1_{DATUM_HERE.flight}/0_0_0"}
