"""One surface of many tiles."""

from dataclasses import replace

import numpy as np
import pytest
from export_scene import N, plane, tile, tiles

from common.errors import ExportError
from common.export.surface import mosaic
from common.messages import TileId


def test_every_cell_lies_where_its_tile_says() -> None:
    surface = mosaic(tiles())
    p_world, colour, sigma, views = surface.points()
    assert p_world.shape == (16 * N * N, 3)
    assert p_world[:, 2] == pytest.approx(plane(p_world[:, 0], p_world[:, 1]), abs=1e-5)
    assert p_world[:, 0].min() == pytest.approx(-2 * N * 0.25 + 0.125)
    assert p_world[:, 1].max() == pytest.approx(2 * N * 0.25 - 0.125)
    assert (colour.shape, sigma.shape, views.shape) == ((len(p_world), 3), (len(p_world),), (len(p_world),))


def test_tiles_far_apart_keep_their_places() -> None:
    surface = mosaic([tile(-3, 5), tile(7, -2)])
    p_world, *_ = surface.points()
    assert len(p_world) == 2 * N * N
    assert p_world[:, 2] == pytest.approx(plane(p_world[:, 0], p_world[:, 1]), abs=1e-5)


def test_cells_of_few_views_and_disputed_cells_are_left_out() -> None:
    doubtful = tile(0, 0)
    doubtful.views[:4] = 2
    doubtful.disputed[:, :4] = True
    assert len(mosaic([doubtful]).points()[0]) == (N - 4) * (N - 4)
    assert len(mosaic([doubtful], keep_disputed=True).points()[0]) == (N - 4) * N
    assert len(mosaic([doubtful], min_views=1, keep_disputed=True).points()[0]) == N * N


def test_specks_go_and_larger_patches_stay() -> None:
    patchy = tile(0, 0)
    patchy.height[:] = np.nan
    patchy.height[2:3, 2:5] = 1.0
    patchy.height[10:12, 10:12] = 1.0
    valid = mosaic([patchy]).valid
    assert not valid[2].any()
    assert valid[10:12, 10:12].all()
    assert np.count_nonzero(valid) == 4


def test_spike_over_solid_ground_is_a_speck() -> None:
    spiky = tile(0, 0)
    spiky.height[7, 7] += 6.0
    spiky.height[20, 20:22] -= 4.0
    valid = mosaic([spiky]).valid
    assert not valid[7, 7]
    assert not valid[20, 20:22].any()
    assert np.count_nonzero(valid) == N * N - 3


def test_walls_of_a_building_are_no_specks() -> None:
    built = tile(0, 0)
    built.height[5:9, 5:9] += 12.0
    assert mosaic([built]).valid.all()


def test_specks_are_found_across_the_bands_of_a_tall_map() -> None:
    tall = [tile(0, y) for y in range(40)]
    surface_rows = 40 * N
    band = 1024
    whole = mosaic(tall)
    assert whole.valid.all()
    assert len(whole.height) == surface_rows > band
    for t in tall:
        t.height[:] = np.nan
    below, above = tall[band // N - 1], tall[band // N]
    below.height[-2:, 3] = 1.0
    above.height[:2, 3] = 1.0
    below.height[-1, 9] = 1.0
    above.height[:2, 9] = 1.0
    assert np.count_nonzero(mosaic(tall).valid) == 4


def test_newest_revision_of_a_tile_counts() -> None:
    old, new = tile(0, 0, revision=1), tile(0, 0, lambda e, n: plane(e, n) + 1.0, revision=2)
    for order in ([old, new], [new, old]):
        assert mosaic(order).height == pytest.approx(new.height)


def test_overview_tiles_are_ignored() -> None:
    overview = replace(tile(0, 0), id=TileId(1, 0, 0), cell=0.5)
    assert mosaic([tile(0, 0), overview]).height.shape == (N, N)


def test_no_tiles_mixed_flights_and_stray_tiles_are_refused() -> None:
    with pytest.raises(ExportError, match="no tiles"):
        mosaic([])
    with pytest.raises(ExportError, match="different kinds"):
        mosaic([tile(0, 0), replace(tile(1, 0), flight="another")])
    with pytest.raises(ExportError, match="stray"):
        mosaic([tile(0, 0), tile(100_000, 100_000)])


def test_tiles_are_not_altered() -> None:
    spiky = tile(0, 0)
    spiky.height[7, 7] += 6.0
    before = spiky.height.copy()
    mosaic([spiky])
    assert np.array_equal(spiky.height, before)
