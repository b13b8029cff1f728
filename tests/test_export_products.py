"""All products of a flight: which appear, and what a full disk leaves behind."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import laspy
import pytest
from export_scene import TILTED, N, keyframes, tiles

from common.errors import ExportError
from common.export.products import MAP_PRODUCTS, TRAJECTORY_PRODUCTS, write_products
from common.export.trajectory import read_tum


def test_every_product_is_written_and_nothing_else(tmp_path: Path) -> None:
    paths = write_products(tmp_path / "new" / "folder", TILTED, tiles(), keyframes())
    assert sorted(paths) == sorted(TRAJECTORY_PRODUCTS + MAP_PRODUCTS)
    assert sorted(paths.values()) == sorted((tmp_path / "new" / "folder").iterdir())
    assert len(laspy.read(paths["map.laz"]).points) == 16 * N * N
    assert len(read_tum(paths["trajectory.tum"]).poses) == 5


def test_newest_revision_of_a_keyframe_counts(tmp_path: Path) -> None:
    flown = keyframes()
    moved = replace(flown[1], revision=3, T_world_cam=flown[0].T_world_cam)
    paths = write_products(tmp_path, TILTED, [], [moved, *flown])
    positions = read_tum(paths["trajectory.tum"]).positions
    assert len(positions) == 5
    assert positions[1] == pytest.approx(positions[0])


@pytest.mark.parametrize("min_views", [2, 9])
def test_flight_without_a_surface_gives_its_trajectory_only(tmp_path: Path, min_views: int) -> None:
    write_products(tmp_path, TILTED, tiles(), keyframes())
    paths = write_products(tmp_path, TILTED, tiles() if min_views == 9 else [], keyframes(), min_views)
    assert sorted(paths) == sorted(TRAJECTORY_PRODUCTS)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(TRAJECTORY_PRODUCTS)


def test_nothing_at_all_is_refused_and_touches_nothing(tmp_path: Path) -> None:
    (tmp_path / "map.laz").write_text("earlier")
    with pytest.raises(ExportError, match="nothing to export"):
        write_products(tmp_path, TILTED, [], [])
    assert [path.name for path in tmp_path.iterdir()] == ["map.laz"]


def test_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="file"):
        write_products(tmp_path / "file", TILTED, tiles(), keyframes())


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from export_scene import TILTED, keyframes, tiles
from common.errors import ExportError
from common.export.products import write_products
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
limit = int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    write_products(Path(sys.argv[1]), TILTED, tiles(), keyframes())
except ExportError as error:
    sys.exit(f"refused: {error}")
"""


def test_full_disk_leaves_the_earlier_products_whole(tmp_path: Path) -> None:
    paths = write_products(tmp_path, TILTED, tiles(), keyframes())
    before = {name: path.read_bytes() for name, path in paths.items()}
    sizes = {len(content) for content in before.values()}
    here = Path(__file__).parent
    for limit in sorted(sizes)[-3:]:  # each limit stops another writer half-way
        run = subprocess.run(
            [sys.executable, "-c", FULL_DISK, str(tmp_path), str(limit - 1)],
            env={"PYTHONPATH": f"{here}:{here.parent}", "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 1, run.stderr
        assert "refused:" in run.stderr
        assert "cannot be written" in run.stderr
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
