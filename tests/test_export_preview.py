"""The picture of a flight: what it shows, where, and how large it is."""

from pathlib import Path

import numpy as np
import pytest
from export_scene import N, colour_of, tile, tiles
from PIL import Image

from common.errors import ExportError
from common.export.preview import GAP_PX, PANEL_PX, hillshade, preview, write_preview
from common.export.surface import mosaic


def crate(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Flat ground with one crate of 3 × 3 m in the north-east."""
    return np.where((abs(east - 8) < 1.5) & (abs(north - 8) < 1.5), 2.0, 0.0)


def test_the_orthophoto_is_on_the_left_with_north_up() -> None:
    sheet = preview(mosaic(tiles()))
    side = (sheet.shape[1] - GAP_PX) // 2
    for row, col, east, north in ((0, 0, -16, 16), (0, side - 1, 16, 16), (side - 1, 0, -16, -16)):
        expected = colour_of(np.array(east), np.array(north))
        assert np.abs(sheet[row, col].astype(int) - expected).max() <= 1


def test_a_slope_is_bright_towards_the_light_and_dark_away_from_it() -> None:
    east = np.arange(40) * 0.5
    flat, rise, fall = (hillshade(np.tile(g * east, (30, 1)).astype(np.float32), 0.5)[15, 20] for g in (0, 0.3, -0.3))
    assert rise > flat > fall
    assert flat == pytest.approx(np.sin(np.radians(40.0)))
    # Light from 315° and 40° on a slope of 1.5 × 0.3: the inner product of the two unit vectors.
    normal = np.array([-0.45, 0.0, 1.0]) / np.hypot(0.45, 1.0)
    assert rise == pytest.approx(normal @ [-np.cos(np.radians(40)) * np.sqrt(0.5), 0, np.sin(np.radians(40))])


def test_a_crate_stands_out_of_the_relief_where_it_is() -> None:
    sheet = preview(mosaic(tiles(crate))).astype(int)
    side = (sheet.shape[1] - GAP_PX) // 2
    relief = sheet[:side, side + GAP_PX :]
    ground = relief[side * 3 // 4, side // 4]
    row, col = np.nonzero(np.abs(relief - ground).max(axis=2) > 15)
    east, north = col / side * 32 - 16, 16 - row / side * 32
    # 12 × 12 cells and the gradient's reach of one cell around them.
    assert (np.abs([east - 8, north - 8]) <= 1.5 + 2 * 0.25).all()
    assert len(row) > 0.9 * (3 / 32 * side) ** 2


def test_unknown_ground_is_paper_and_margins_are_cut_off() -> None:
    holed = tile(0, 0)
    holed.height[:, : N // 2] = np.nan
    holed.height[4:8, 20:28] = np.nan
    sheet = preview(mosaic([holed]))
    scale = PANEL_PX // N
    assert sheet.shape[1] == 2 * scale * N // 2 + GAP_PX
    assert (sheet[(N - 8) * scale : (N - 4) * scale, 4 * scale : 12 * scale] == 255).all()
    assert (sheet[(N - 8) * scale, 3 * scale] < 255).any()


@pytest.mark.parametrize("shape", [(1, 4), (4, 1), (2, 2), (3, 200)])
def test_a_surface_of_any_shape_has_a_picture(shape: tuple[int, int], tmp_path: Path) -> None:
    whole = mosaic(tiles(radius=4))
    few = np.full_like(whole.height, np.nan)
    few[: shape[0], : shape[1]] = whole.height[: shape[0], : shape[1]]
    whole.height[:] = few
    write_preview(tmp_path / "preview.jpg", whole)
    with Image.open(tmp_path / "preview.jpg") as image:
        assert max(image.size) > 0.9 * PANEL_PX


def test_the_file_is_small_even_where_the_ground_is_rough(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rough = tiles(lambda e, n: e / 10 + rng.normal(0, 0.03, e.shape), cell=0.1, radius=4)
    for t in rough:
        t.colour[:] = np.clip(t.colour + rng.normal(0, 8, t.colour.shape), 0, 255)
    write_preview(tmp_path / "preview.jpg", mosaic(rough))
    assert (tmp_path / "preview.jpg").stat().st_size < 1_000_000


def test_a_picture_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="nowhere"):
        write_preview(tmp_path / "nowhere" / "preview.jpg", mosaic(tiles()))


def test_the_same_surface_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg"):
        write_preview(tmp_path / name, mosaic(tiles(crate)))
    assert (tmp_path / "a.jpg").read_bytes() == (tmp_path / "b.jpg").read_bytes()
