"""Cells: from the mesh of a pair to layers, from layers to one surface."""

import cv2
import numpy as np
from mapping_scene import keyframe
from test_mapping_geometry import exact_correspondences

from air.mapping.fusion import fuse
from air.mapping.layer import Layer, layers
from air.mapping.tiles import Tiles
from air.mapping.triangulation import triangulate
from common.messages import TileId

N = 16
CELL = 0.1


def flat_layer(photos, height, sigma=0.02, radius=0.5, colour=100):
    return Layer(
        photos,
        0,
        0,
        np.full((N, N), height, np.float32),
        np.full((N, N), sigma, np.float16),
        np.full((N, N, 3), colour, np.uint8),
        np.full((N, N), radius, np.float16),
    )


def test_agreeing_layers_give_the_weighted_mean_and_count_photos_not_pairs():
    fused = fuse([flat_layer((0, 1), 1.00, 0.02), flat_layer((1, 2), 1.03, 0.04)], CELL, N)
    np.testing.assert_allclose(fused.height, (1.00 * 4 + 1.03) / 5, atol=1e-3)
    assert (fused.views == 3).all()
    assert not fused.disputed.any()
    assert (fused.sigma < 0.02).all()
    assert (fused.sigma > 0.02 / np.sqrt(2) / 2).all()


def test_outlier_does_not_move_the_surface():
    stack = [flat_layer((0, 1), 1.0), flat_layer((1, 2), 1.01), flat_layer((2, 3), 1.0), flat_layer((8, 9), 7.0)]
    fused = fuse(stack, CELL, N)
    np.testing.assert_allclose(fused.height, 1.0033, atol=1e-3)
    assert (fused.views == 4).all()
    assert not fused.disputed.any()


def test_two_pairs_that_differ_are_disputed_and_two_views_at_most():
    fused = fuse([flat_layer((0, 1), 1.0), flat_layer((2, 3), 4.0)], CELL, N)
    assert fused.disputed.all()
    assert (fused.views == 2).all()


def test_of_equal_surfaces_the_upper_one_is_shown():
    for stack in (
        [flat_layer((0, 1), 1.0), flat_layer((2, 3), 4.0)],
        [flat_layer((2, 3), 4.0), flat_layer((0, 1), 1.0)],
    ):
        np.testing.assert_allclose(fuse(stack, CELL, N).height, 4.0)


def test_colour_comes_from_the_agreeing_photo_nearest_to_its_image_centre():
    stack = [
        flat_layer((0, 1), 1.0, radius=0.6, colour=10),
        flat_layer((1, 2), 1.0, radius=0.2, colour=20),
        flat_layer((2, 3), 1.0, radius=0.4, colour=30),
        flat_layer((3, 4), 9.0, radius=0.1, colour=40),
    ]
    assert (fuse(stack, CELL, N).colour == 20).all()


def test_layer_that_is_a_little_wrong_as_a_whole_raises_sigma_instead_of_a_dispute():
    right = [flat_layer((0, 1), 1.0), flat_layer((1, 2), 1.0)]
    fused = fuse([*right, flat_layer((4, 5), 1.15), flat_layer((5, 6), 1.15)], CELL, N)
    assert not fused.disputed.any()
    assert (fused.views == 6).all()
    np.testing.assert_allclose(fused.height, 1.075, atol=0.08)
    assert fused.sigma.min() > 1.3 * fuse(right, CELL, N).sigma.max()
    # What is metres off stays a dispute.
    assert fuse([*right, flat_layer((4, 5), 3.0), flat_layer((5, 6), 3.0)], CELL, N).disputed.all()


def test_no_layers_give_an_unknown_surface():
    fused = fuse([], CELL, N)
    assert np.isnan(fused.height).all()
    assert (fused.views == 0).all()


def test_replacing_a_pair_leaves_no_trace_of_the_old_layer_and_counts_revisions():
    tiles = Tiles(CELL, N)
    here, there = TileId(0, 0, 0), TileId(0, 5, 5)
    assert tiles.replace((0, 1), {here: flat_layer((0, 1), 1.0), there: flat_layer((0, 1), 1.0)}) == {here, there}
    first = tiles.fuse("flight", 5, [here, there])
    assert [t.revision for t in first] == [1, 1]
    assert tiles.replace((0, 1), {here: flat_layer((0, 1), 2.0)}) == {here, there}
    second = {t.id: t for t in tiles.fuse("flight", 6, [here, there])}
    assert second[here].revision == 2
    np.testing.assert_allclose(second[here].height, 2.0)
    assert np.isnan(second[there].height).all()
    assert [t.id for t in tiles.all()] == [here, there]


def test_sloping_mesh_has_exact_heights_at_cell_centres_and_no_holes():
    left, right = keyframe(0, [103.0, -57.0, 20.0], 20.0), keyframe(1, [107.0, -56.0, 20.0], 20.0)
    matches, _ = exact_correspondences(left, right, 0.7)
    points = triangulate(matches, left, right)
    slope = np.array([0.3, -0.2])
    # The plane is tilted after triangulation: what is tested is the step from points to cells.
    points.p_origin[..., 2] += points.p_origin[..., :2] @ slope.astype(np.float32)
    for cell in (0.04, 0.1, 0.25):
        found = layers(matches, points, (0, 1), cell, 64)
        seen = 0
        for tile, layer in found.items():
            rows, columns = layer.height.shape
            x = (tile.x * 64 + layer.column + np.arange(columns) + 0.5) * cell
            y = (tile.y * 64 + layer.row + np.arange(rows) + 0.5) * cell
            truth = 0.7 + slope[0] * (x[None] - 103.0) + slope[1] * (y[:, None] + 57.0)
            error = np.abs(layer.height - truth)
            assert np.nanmax(error) < 0.01
            seen += np.isfinite(error).sum()
        known = points.p_origin[np.isfinite(points.p_origin[..., 2])][:, :2]
        area = cv2.contourArea(cv2.convexHull(known.astype(np.float32)))
        assert seen * cell**2 > 0.96 * area
