"""The command `luojia-ground`, as its own process: killed, started again, asked for its products while it serves."""

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import laspy
import numpy as np
import pytest
from synthetic_map import FLIGHT, FakeAircraft, keyframe, pose, site_tile, surface

from common.bus import BusConfig, ZenohBus
from common.messages import TileId
from ground.__main__ import main
from ground.cloud import FlightId
from ground.store import read_store

UAV1 = FlightId("uav1", FLIGHT)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def config(tmp_path: Path) -> tuple[Path, str]:
    """A configuration file of a station without a viewer, and its endpoint."""
    endpoint, path = f"tcp/127.0.0.1:{free_port()}", tmp_path / "ground.toml"
    path.write_text(
        f'[bus]\nlisten = ["{endpoint}"]\nshared_memory = false\n'
        f'[store]\npath = "{tmp_path / "ground.sqlite"}"\n[viewer]\nenabled = false\n'
    )
    return path, endpoint


@contextmanager
def serving(config: Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "ground", "serve", "--config", str(config)]
    folder = Path(__file__).parent.parent
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def kept(config: Path) -> dict[TileId, int]:
    store = config.parent / "ground.sqlite"
    return {t.id: t.revision for t in read_store(store)[0].tiles(UAV1)} if store.exists() else {}


def test_killed_half_way_and_started_again_it_ends_with_the_aircrafts_map(config: tuple[Path, str]) -> None:
    path, endpoint = config
    bus = ZenohBus(BusConfig("peer", connect=(endpoint,), shared_memory=False))
    aircraft = FakeAircraft(bus)
    wanted = {TileId(0, x, y): 1 for x in (-1, 0) for y in (-1, 0, 1)}

    half, rest = list(wanted)[:3], list(wanted)[3:]
    for place in half:
        aircraft.tiles[place] = site_tile(place.x, place.y, n=128, cell=0.2)
    with serving(path) as process:
        _until(lambda: len(kept(path)) == len(half), aircraft.beat)
        process.send_signal(signal.SIGKILL)
    for place in rest:
        aircraft.send_tile(site_tile(place.x, place.y, n=128, cell=0.2))  # nobody listens
    with serving(path) as process:
        _until(lambda: kept(path) == wanted, aircraft.beat)
        aircraft.send_keyframe(keyframe(0))
        aircraft.send_pose(pose(10**9, 0.0, 0.0))

        report = _output("spy", "--seconds", "1.5", "--json", "--config", str(path), while_doing=aircraft.beat)
        streams = {(row["vehicle"], row["stream"]): row for row in json.loads(report)}
        assert streams["uav1", "map/digest"]["messages"] > 0
        assert all(row["faults"] == 0 for row in streams.values())

        _until(lambda: len(read_store(path.parent / "ground.sqlite")[0].keyframes(UAV1)) == 1, aircraft.beat)
        out = path.parent / "out"
        assert main(["export", "--out", str(out), "--config", str(path)]) == 0
        assert process.poll() is None
        process.terminate()
        assert process.wait(timeout=10) == 0
    bus.close()

    cloud = laspy.read(out / "map.laz")
    assert len(cloud.points) > 10_000
    heights = np.asarray(cloud.z) - 42.0  # the datum's height
    assert abs(np.median(heights) - np.median(surface(*np.meshgrid(np.arange(-25, 25), np.arange(-25, 50))))) < 0.3
    assert (out / "dsm.tif").exists()
    assert (out / "trajectory.tum").read_text().split()[0] == "2.000000000"


def _until(holds: Callable[[], bool], meanwhile: Callable[[], None], timeout_s: float = 20.0) -> None:
    end = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end, "did not happen in time"
        meanwhile()
        time.sleep(0.2)


def _output(*arguments: str, while_doing: Callable[[], None]) -> str:
    command = [sys.executable, "-m", "ground", *arguments]
    folder = Path(__file__).parent.parent
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        while process.poll() is None:
            while_doing()
            time.sleep(0.2)
        assert process.stdout is not None
        assert process.returncode == 0
        return process.stdout.read()


def test_export_without_a_store_says_which_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "g.toml"
    config.write_text(f'[store]\npath = "{tmp_path / "none.sqlite"}"\n')
    assert main(["export", "--out", str(tmp_path / "out"), "--config", str(config)]) == 1
    error = capsys.readouterr().err
    assert "none.sqlite" in error
    assert error.count("\n") == 1


def test_spy_without_a_station_names_the_endpoint(config: tuple[Path, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["spy", "--seconds", "1", "--config", str(config[0])]) == 1
    error = capsys.readouterr().err
    assert config[1] in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("toml", "named"),
    [
        ("[viewer]\nport = 99999", "viewer.port"),
        ('station = "a/b"', "station"),
        ('[bus]\nmode = "client"', "bus.connect"),
        ('[bus]\nmode = "peer"', "bus.mode"),
        ("min_views = 0", "min_views"),
        ("[stor]", "store"),
    ],
)
def test_an_impossible_setting_is_named(
    toml: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "g.toml"
    config.write_text(toml)
    assert main(["serve", "--config", str(config)]) == 1
    error = capsys.readouterr().err
    assert named in error
    assert "g.toml" in error


@pytest.mark.parametrize("arguments", [[], ["fly"], ["export"], ["spy", "--seconds", "x"]])
def test_wrong_usage_is_code_2(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as refusal:
        main(arguments)
    assert refusal.value.code == 2
