"""The mapper on an exact scene: accuracy, live growth, corrected poses and photos that cannot serve."""

from dataclasses import replace

import numpy as np
import pytest
from mapping_scene import BOXES, Scene, block, keyframe

from air.mapping.mapper import Mapper
from air.mapping.settings import MappingSettings
from common.se3 import SE3, rotation_vector_to_matrix

SCENE = Scene(BOXES)
FRAMES = block(2, 4)
SETTINGS = MappingSettings(threads=1)
METRES = np.array([3.0, 2.0, 0.0])


@pytest.fixture(scope="module")
def photos():
    return {k.index: SCENE.photo(k.camera, k.T_world_cam, k.index) for k in FRAMES}


@pytest.fixture(scope="module")
def whole(photos):
    mapper = filled(photos)
    return mapper.update("flight", FRAMES)


def filled(photos, settings=SETTINGS):
    mapper = Mapper(settings)
    for index, image in photos.items():
        mapper.add_image(index, image)
    return mapper


def cells(tiles):
    """East and north (M, 2), height, sigma, views and disputed of all known cells."""
    out = []
    for tile in tiles:
        n = tile.height.shape[0]
        x, y = ((i * n + np.arange(n) + 0.5) * tile.cell for i in (tile.id.x, tile.id.y))
        known = np.isfinite(tile.height)
        xy = np.stack(np.meshgrid(x, y), axis=-1)[known]
        out.append((xy, tile.height[known], tile.sigma[known], tile.views[known], tile.disputed[known]))
    return [np.concatenate(column) for column in zip(*out, strict=True)]


def near_wall(xy, distance):
    inside = [
        (xy[:, 0] > b[0] - distance)
        & (xy[:, 0] < b[2] + distance)
        & (xy[:, 1] > b[1] - distance)
        & (xy[:, 1] < b[3] + distance)
        & ~(
            (xy[:, 0] > b[0] + distance)
            & (xy[:, 0] < b[2] - distance)
            & (xy[:, 1] > b[1] + distance)
            & (xy[:, 1] < b[3] - distance)
        )
        for b in BOXES
    ]
    return np.any(inside, axis=0)


def errors(tiles):
    xy, height, sigma, views, disputed = cells(tiles)
    return height - SCENE.height(xy), near_wall(xy, 0.5), sigma, views, disputed


def test_surface_is_found_to_centimetres_without_spikes(whole):
    error, wall, sigma, views, disputed = errors(whole)
    shown = (views >= 3) & ~disputed
    assert abs(np.mean(error[shown & ~wall])) < 0.005
    assert np.median(np.abs(error[shown])) < 0.01
    assert np.mean(np.abs(error[shown])) < 0.03
    assert np.quantile(np.abs(error[shown & ~wall]), 0.995) < 0.1
    assert np.abs(error[shown & ~wall]).max() < 0.5
    assert np.mean(np.abs(error[shown]) < 3 * sigma[shown] + 0.02) > 0.95


def test_block_is_complete_where_four_photos_see_it(whole):
    xy, _, _, views, disputed = cells(whole)
    shown = xy[(views >= 3) & ~disputed]
    # Within this rectangle a point lies in at least four photos; beside walls some of them cannot see it.
    asked = np.stack(np.meshgrid(np.arange(-8, 8, 0.1) + 0.05, np.arange(-7, 7, 0.1) + 0.05), axis=-1).reshape(-1, 2)
    asked = asked[~near_wall(asked, 1.0)]
    have = {tuple(c) for c in np.floor(shown / SETTINGS.cell).astype(int)}
    assert len(have) == len(shown)
    complete = np.mean([tuple(c) in have for c in np.floor(asked / SETTINGS.cell).astype(int)])
    assert complete > 0.98


def test_semi_global_search_is_as_good(photos):
    tiles = filled(photos, replace(SETTINGS, method="semi-global")).update("flight", FRAMES)
    error, _, _, views, disputed = errors(tiles)
    assert np.median(np.abs(error[(views >= 3) & ~disputed])) < 0.01


@pytest.mark.parametrize("change", [{"threads": 2}, {"revisable": False}])
def test_result_is_the_same_twice_with_more_threads_and_without_memory(photos, whole, change):
    again = filled(photos, replace(SETTINGS, **change)).update("flight", FRAMES)
    assert [t.id for t in again] == [t.id for t in whole]
    for a, b in zip(whole, again, strict=True):
        np.testing.assert_array_equal(a.height, b.height)
        np.testing.assert_array_equal(a.colour, b.colour)
        np.testing.assert_array_equal(a.views, b.views)


def test_map_grows_photo_by_photo_and_only_touched_tiles_get_a_revision(photos):
    mapper = Mapper(SETTINGS)
    revisions = {}
    for k in FRAMES:
        mapper.add_image(k.index, photos[k.index])
        for tile in mapper.update("flight", [k]):
            assert tile.revision == revisions.get(tile.id, 0) + 1
            revisions[tile.id] = tile.revision
    assert {t.id: t.revision for t in mapper.tiles()} == revisions
    assert max(revisions.values()) > 3
    error, _, _, views, disputed = errors(mapper.tiles())
    assert np.median(np.abs(error[(views >= 3) & ~disputed])) < 0.012
    assert mapper.update("flight", FRAMES) == []


def test_corrected_poses_and_focal_length_give_the_map_of_the_true_ones(photos, whole):
    shift, turn = np.array([0.3, -0.2, 0.4]), rotation_vector_to_matrix(np.array([0.0, 0.0, 0.02]))
    wrong = [
        replace(
            k,
            T_world_cam=SE3(turn @ k.T_world_cam.R, turn @ k.T_world_cam.t + shift),
            camera=replace(k.camera, fx=k.camera.fx * 1.01, fy=k.camera.fy * 1.01),
        )
        for k in FRAMES
    ]
    mapper = filled(photos, replace(SETTINGS, moves_per_update=5))
    before = mapper.update("flight", wrong)
    assert np.median(np.abs(errors(before)[0])) > 0.1
    for k in FRAMES:
        mapper.forget(k.index)
    mapper.update("flight", [replace(k, revision=2) for k in FRAMES])
    while mapper.update("flight", []):
        pass
    assert {t.id for t in before} <= {t.id for t in mapper.tiles()}
    error, _, _, views, disputed = errors(mapper.tiles())
    shown = (views >= 3) & ~disputed
    assert np.median(np.abs(error[shown])) < 0.012
    assert np.mean(np.abs(error[shown])) < 0.03
    assert shown.sum() > 0.9 * (errors(whole)[3] >= 3).sum()


def test_change_below_the_tolerance_moves_nothing(photos):
    mapper = filled(photos)
    mapper.update("flight", FRAMES)
    nudge = np.array([0, 0, 0.005])
    nudged = [replace(k, revision=2, T_world_cam=SE3(k.T_world_cam.R, k.T_world_cam.t + nudge)) for k in FRAMES]
    assert mapper.update("flight", nudged) == []


def test_ground_is_found_far_below_the_datum_and_when_it_is_told_roughly(photos):
    lower = [replace(k, T_world_cam=SE3(k.T_world_cam.R, k.T_world_cam.t - [0, 0, 500.0])) for k in FRAMES[:3]]
    for hint in (None, -497.0, -503.0):
        tiles = filled(photos).update("flight", lower, ground_height=hint)
        xy, height, *_ = cells(tiles)
        assert np.median(np.abs(height + 500.0 - SCENE.height(xy))) < 0.02


@pytest.mark.parametrize(
    "bad",
    [
        replace(FRAMES[1], index=90),
        keyframe(90, [900.0, 0.0, 20.0]),
        keyframe(90, [0.0, 0.0, -30.0]),
        keyframe(90, [0.0, 0.0, np.inf]),
        replace(FRAMES[1], index=90, T_world_cam=SE3(FRAMES[1].T_world_cam.R, FRAMES[1].T_world_cam.t + METRES)),
        keyframe(90, FRAMES[1].T_world_cam.t, tilt=(1.2, 0.0)),
    ],
    ids=["duplicate", "far away", "below ground", "not finite", "wrong by metres", "wrong attitude"],
)
def test_photo_that_does_not_fit_does_no_harm(photos, whole, bad):
    mapper = filled({**photos, 90: photos[1]})
    mapper.update("flight", [*FRAMES, bad])
    error, wall, _, views, disputed = errors(mapper.tiles())
    shown = (views >= 3) & ~disputed
    assert np.mean(np.abs(error[shown])) < 0.03
    assert np.abs(error[shown & ~wall]).max() < 0.5
    assert shown.sum() > 0.98 * ((errors(whole)[3] >= 3) & ~errors(whole)[4]).sum()


def test_black_photo_and_keyframe_without_photo_give_nothing(photos):
    mapper = Mapper(SETTINGS)
    mapper.add_image(0, np.zeros_like(photos[0]))
    mapper.add_image(1, np.zeros_like(photos[1]))
    assert mapper.update("flight", FRAMES[:3]) == []
    assert mapper.tiles() == []


def test_oldest_photos_are_forgotten_beyond_the_limit(photos):
    mapper = filled(photos, replace(SETTINGS, images_kept=2))
    tiles = mapper.update("flight", FRAMES)
    _, _, _, views, _ = cells(tiles)
    assert views.max() == 2
