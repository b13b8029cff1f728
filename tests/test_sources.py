"""Opening sources by URL, and their pace."""

import subprocess
import sys
from operator import length_hint
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from air.sources.pace import Paced
from air.sources.source import open_photos
from common.errors import SourceError
from common.messages import Photo


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "a.jpg")
    return tmp_path


@pytest.mark.parametrize(
    ("url", "named"),
    [
        ("", ["photos", "sim"]),
        ("flight.mcap", ["flight.mcap", "No such file"]),
        ("rtsp://camera", ["rtsp", "photos", "sim"]),
        ("photos:no/such/folder", ["no/such/folder", "does not exist"]),
        ("photos:{folder}?speed=2", ["takes none"]),
        ("photos:{folder}/a.jpg", ["is a file"]),
        ("sim:race", ["race", "survey"]),
        ("sim:survey?colour=red", ["colour", "red", "seed", "photos", "gps_noise"]),
        ("sim:survey?photos=1", ["photos", "'1'", "2", "500"]),
        ("sim:survey?photos=ten", ["photos", "'ten'", "whole number"]),
        ("sim:survey?photos=", ["photos", "''"]),
        ("sim:survey?photos=3.5", ["photos", "'3.5'"]),
        ("sim:survey?gps_noise=nan", ["gps_noise", "'nan'", "0.001"]),
        ("sim:survey?gps_noise=-1", ["gps_noise", "'-1'"]),
        ("sim:survey?angles=2", ["angles", "'2'", "0", "1"]),
        ("sim:survey?seed=1&seed=2", ["seed", "twice"]),
    ],
)
def test_a_source_that_cannot_be_opened_is_refused_in_one_clear_line(url: str, named: list[str], folder: Path) -> None:
    with pytest.raises(SourceError) as refused:
        open_photos(url.replace("{folder}", str(folder)))
    message = str(refused.value)
    assert "\n" not in message
    for word in named:
        assert word in message


def test_a_folder_without_photos_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no photo")
    with pytest.raises(SourceError, match=r"holds no \*\.jpg"):
        open_photos(f"photos:{tmp_path}")


@pytest.mark.parametrize("pace", [0.0, -1.0, float("nan"), float("inf")])
def test_an_impossible_pace_is_refused(folder: Path, pace: float) -> None:
    with pytest.raises(SourceError, match="pace"):
        open_photos(f"photos:{folder}", pace)


class Clock:
    """Time that passes only while somebody sleeps or works."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now_s += seconds


class Stamped:
    """A source of empty photos at given instants, s."""

    url, truth, problems = "test:", None, ()

    def __init__(self, instants_s: list[float]):
        self.instants_s = instants_s

    def __len__(self) -> int:
        return len(self.instants_s)

    def __iter__(self):
        return (Photo(round(t * 1e9), f"{t}", b"", None, None) for t in self.instants_s)


def test_photos_come_at_the_pace_of_their_stamps() -> None:
    clock = Clock()
    arrivals = [clock() - 1000.0 for _ in Paced(Stamped([50.0, 52.0, 55.0, 55.5]), 2.0, clock, clock.sleep)]
    assert arrivals == pytest.approx([0.0, 1.0, 2.5, 2.75])


def test_a_slow_consumer_is_caught_up_with_and_not_delayed_further() -> None:
    clock, arrivals = Clock(), []
    for photo in Paced(Stamped([0.0, 2.0, 4.0, 6.0, 20.0]), 1.0, clock, clock.sleep):
        arrivals.append(clock() - 1000.0)
        clock.now_s += 5.0 if photo.t_ns == 0 else 0.1
    assert arrivals == pytest.approx([0.0, 5.0, 5.1, 6.0, 20.0])


def test_a_paced_source_passes_on_what_its_source_knows(folder: Path) -> None:
    plain, paced = open_photos(f"photos:{folder}"), open_photos(f"photos:{folder}", 1.0)
    assert (paced.url, length_hint(paced), paced.truth, paced.problems) == (plain.url, 1, None, plain.problems)


def test_photos_need_no_compiler_and_the_simulator_no_image_reader() -> None:
    script = "import sys, air.sources.source, air.sources.{}; sys.exit('{}' in sys.modules)"
    for module, unwanted in (("photos", "numba"), ("simulated.survey", "PIL")):
        assert subprocess.run([sys.executable, "-c", script.format(module, unwanted)], check=False).returncode == 0
