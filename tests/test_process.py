"""A whole flight through `process`: the same bytes twice, and photos that are of no use named and harmless."""

import json
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
from photo_folder import moved, write_photo

from air.__main__ import main
from air.config import AirConfig
from air.process import process
from air.sources.simulated.survey import Survey, SurveyOptions
from common.export.datum import read_datum
from common.export.products import MAP_PRODUCTS, TRAJECTORY_PRODUCTS
from common.export.projection import UtmProjection
from common.export.trajectory import read_tum
from common.geo import T_world_other
from common.messages import Photo
from ground.evaluation.trajectories import associate

SURVEY = Survey("", SurveyOptions(seed=4, photos=15, gps_noise=0.05))
ELSEWHERE = Survey("", SurveyOptions(seed=9, photos=4, gps_noise=0.05))
NO_GPS, TRUNCATED, WRONG_CLOCK = 7, 2, 12
GOOD = [i for i in range(15) if i not in (NO_GPS, TRUNCATED, WRONG_CLOCK)]


@dataclass(frozen=True)
class Result:
    """What a run wrote, and how it compares with the truth: errors in m, both absolute."""

    out: Path
    report: dict
    camera_error: np.ndarray
    height_error: np.ndarray

    @property
    def problems(self) -> dict[str, dict[str, str]]:
        return {problem["photo"]: problem for problem in self.report["problems"]}


def result_of(out: Path) -> Result:
    truth = SURVEY.truth
    trajectory = read_tum(out / "trajectory.tum")
    k, i = associate(trajectory.t_ns, np.array(truth.t_ns))
    positions = T_world_other(truth.datum, read_datum(out / "datum.json")).apply(trajectory.positions[k])
    cameras = positions - np.array([truth.T_world_cam[j].t for j in i])
    p = UtmProjection(truth.datum).to_world(np.asarray(laspy.read(out / "map.laz").xyz))
    height = p[:, 2] - truth.world.height(p[:, :2])
    return Result(out, json.loads((out / "report.json").read_text()), np.linalg.norm(cameras, axis=1), np.abs(height))


@pytest.fixture(scope="module")
def photos() -> dict[int, Photo]:
    """All photos of the survey, rendered once."""
    return dict(enumerate(SURVEY))


@pytest.fixture(scope="module")
def good_folder(photos: dict[int, Photo], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the photos that nothing is wrong with."""
    folder = tmp_path_factory.mktemp("good")
    for i in GOOD:
        write_photo(folder, photos[i])
    return folder


@pytest.fixture(scope="module")
def clean(good_folder: Path) -> Result:
    """What the good photos alone give."""
    out = good_folder.parent / "clean"
    process(AirConfig(), f"photos:{good_folder}", out, quiet=True)
    return result_of(out)


@pytest.fixture(scope="module")
def spoiled(photos: dict[int, Photo], good_folder: Path) -> Result:
    """What they give with a photo of every bad kind among them."""
    folder = good_folder.parent / "spoiled"
    shutil.copytree(good_folder, folder)
    write_photo(folder, replace(photos[NO_GPS], fix=None))
    truncated = write_photo(folder, photos[TRUNCATED])
    truncated.write_bytes(truncated.read_bytes()[: truncated.stat().st_size // 2])
    write_photo(folder, photos[WRONG_CLOCK], clock=datetime(1980, 1, 6))
    black = bytes(cv2.imencode(".jpg", np.zeros((960, 1280, 3), np.uint8))[1])
    write_photo(folder, replace(photos[5], t_ns=photos[5].t_ns + 10**9, jpeg=black), "black.jpg")
    shutil.copy(folder / photos[9].name, folder / "copy.jpg")
    stranger = ELSEWHERE.photo(0)
    write_photo(folder, replace(stranger, t_ns=photos[3].t_ns + 10**9, fix=photos[3].fix), "stranger.jpg")
    write_photo(folder, moved(replace(ELSEWHERE.photo(2), t_ns=photos[0].t_ns - 10**9), -60.0, 40.0), "antipode.jpg")
    (folder / "empty.jpg").write_bytes(b"")
    out = good_folder.parent / "spoiled_out"
    process(AirConfig(), f"photos:{folder}", out, quiet=True)
    return result_of(out)


def test_the_map_and_the_cameras_lie_where_the_truth_is(clean: Result) -> None:
    assert clean.report["photos"] == {"read": 12, "placed": 12, "waiting": 0, "rejected": 0}
    assert clean.report["problems"] == []
    # Fixes of 5 cm and 10 cm in height leave twelve photos a common error of some centimetres, and 1 % in focal
    # length, which so few photos cannot tell from height: 0.4 m at 40 m at most.
    assert clean.camera_error.max() < 0.15
    assert np.median(clean.height_error) < 0.30


def test_all_products_and_the_report_are_written_and_nothing_else(clean: Result) -> None:
    written = {path.name for path in clean.out.iterdir()}
    assert written == {*TRAJECTORY_PRODUCTS, *MAP_PRODUCTS, "report.json"}


def test_the_same_flight_gives_the_same_bytes_again(clean: Result, good_folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "air", "process", f"photos:{good_folder}", "--out", str(tmp_path), "--quiet"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.startswith("12 of 12 photos, ")
    for name in (*TRAJECTORY_PRODUCTS, *MAP_PRODUCTS):
        assert (tmp_path / name).read_bytes() == (clean.out / name).read_bytes(), name


@pytest.mark.parametrize(
    ("photo", "state", "reason"),
    [
        (f"SIM_{NO_GPS + 1:04d}.jpg", "placed", "no GPS position: placed by its neighbours"),
        (f"SIM_{TRUNCATED + 1:04d}.jpg", "rejected", "truncated"),
        (f"SIM_{WRONG_CLOCK + 1:04d}.jpg", "placed", "clock"),
        ("black.jpg", "rejected", "black"),
        ("copy.jpg", "rejected", "the same file as SIM_0010.jpg"),
        ("stranger.jpg", "waiting", "another place"),
        ("antipode.jpg", "waiting", "another place"),
        ("empty.jpg", "rejected", "not an image"),
    ],
)
def test_a_bad_photo_is_named_with_the_reason(spoiled: Result, photo: str, state: str, reason: str) -> None:
    assert spoiled.problems[photo]["state"] == state
    assert reason in spoiled.problems[photo]["reason"]


def test_bad_photos_spoil_nothing(clean: Result, spoiled: Result) -> None:
    assert len(spoiled.report["problems"]) == 8
    assert spoiled.report["photos"] == {"read": 20, "placed": 14, "waiting": 2, "rejected": 4}
    # Two more photos are placed, so the map may only be larger; what it says differs by less than its own error.
    assert len(spoiled.height_error) > 0.98 * len(clean.height_error)
    assert spoiled.camera_error.max() < clean.camera_error.max() + 0.03
    for share in (0.5, 0.9, 0.99):
        assert np.quantile(spoiled.height_error, share) < np.quantile(clean.height_error, share) + 0.05


def refusal(source: str, out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The line in which the command refuses to work."""
    assert main(["process", source, "--out", str(out), "--quiet"]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("luojia-air: ")
    assert printed.err.count("\n") == 1
    return printed.err


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("photos:{}/empty", "holds no *.jpg"),
        ("photos:{}/missing", "does not exist"),
        ("photos:{}/notes.txt", "is a file, not a folder"),
        ("tape:{}", "no known scheme; use one of "),
        ("{}", "no known scheme"),
        ("sim:race", "there is no site 'race'"),
        ("sim:survey?photos=many", "'photos' is 'many', must be a whole number from 2 to 500"),
    ],
)
def test_a_source_that_cannot_be_opened_is_refused_in_one_line(
    source: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("")
    line = refusal(source.format(tmp_path), tmp_path / "out", capsys)
    assert source.format(tmp_path) in line
    assert reason in line
    assert not (tmp_path / "out").exists()


def test_photos_that_show_nothing_are_refused_in_one_line_that_names_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no image")
    line = refusal(f"photos:{tmp_path}", tmp_path / "out", capsys)
    assert "none of 1 photos could be placed" in line
    assert "a.jpg: the file is truncated or is not an image" in line


def test_photos_without_any_position_are_refused_in_one_line(
    photos: dict[int, Photo], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for i in (0, 1):
        write_photo(tmp_path, replace(photos[i], fix=None))
    line = refusal(f"photos:{tmp_path}", tmp_path / "out", capsys)
    assert "none of 2 photos could be placed" in line
    assert "GPS" in line


@pytest.mark.parametrize("place", ["a_file", "a_file/below", "/proc/sys", "/proc/luojia"])
def test_a_folder_that_takes_no_files_is_refused_before_any_work(
    place: str, good_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a_file").write_text("")
    begun = time.process_time()
    line = refusal(f"photos:{good_folder}", tmp_path / place, capsys)
    assert str(tmp_path / place) in line
    assert "choose another folder" in line
    assert time.process_time() - begun < 3.0
