"""Aircraft and grounds as real processes: whoever listens, whenever, and however it dies, ends with the same map."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from bus_network import wait_until
from live_system import Held, LiveSystem

from air.__main__ import main

PHOTOS = 6
FLIGHT = f"sim:survey?seed=5&photos={PHOTOS}"
ENDED = "the source has ended"
FLIGHT_WITHIN_S = 120.0
"""The machines that run tests may be busy; a free one with two cores needs twelve seconds."""


@pytest.fixture
def system(tmp_path: Path) -> Iterator[LiveSystem]:
    system = LiveSystem(tmp_path)
    yield system
    system.close()


def summary(held: Held) -> dict[str, int]:
    return {key: revision for key, (revision, _) in held.items()}


def assert_same(system: LiveSystem, *names: str) -> None:
    """Each station holds what the aircraft holds, revision for revision and byte for byte; no ground is up."""
    aircraft = system.on_aircraft()
    assert sum("/" in key for key in aircraft) >= 4
    assert sum("/" not in key for key in aircraft) == PHOTOS
    for name in names:
        held = system.on_ground(name)
        assert summary(held) == summary(aircraft)
        assert held == aircraft


def test_two_grounds_one_joining_after_the_last_photo_hold_the_aircrafts_map(system: LiveSystem) -> None:
    aircraft = system.aircraft(FLIGHT, pace=4.0)
    wait_until(lambda: "tiles sent" in aircraft.said(), FLIGHT_WITHIN_S)  # before anybody listens
    first = system.ground("first")
    wait_until(lambda: ENDED in aircraft.said(), FLIGHT_WITHIN_S)
    second = system.ground("second", "client")
    system.settle("first", "second")
    for program in (second, first):
        code, took_s = program.stop()
        assert code == 0
        assert took_s < 5.0
    assert_same(system, "first", "second")
    code, took_s = aircraft.stop()
    assert (code, took_s < 3.0) == (0, True), f"exit code {code} after {took_s:.1f} s"
    assert "Traceback" not in aircraft.said() + first.said() + second.said()


@pytest.mark.slow
def test_a_ground_killed_half_way_and_restarted_ends_with_the_aircrafts_map(system: LiveSystem) -> None:
    ground = system.ground("first")
    aircraft = system.aircraft(FLIGHT, pace=4.0)
    wait_until(lambda: len(system.on_ground("first")) >= 5, FLIGHT_WITHIN_S)
    ground.process.send_signal(signal.SIGKILL)
    ground.process.wait()
    seen = aircraft.said().count("tiles sent")
    wait_until(lambda: aircraft.said().count("tiles sent") >= seen + 2, FLIGHT_WITHIN_S)  # nobody listens
    assert ENDED not in aircraft.said()
    ground = system.ground("first")
    wait_until(lambda: ENDED in aircraft.said(), FLIGHT_WITHIN_S)
    system.settle("first")
    assert ground.stop()[0] == 0
    assert_same(system, "first")
    assert aircraft.stop(signal.SIGTERM)[0] == 0


@pytest.mark.slow
def test_stopped_in_the_middle_of_its_work_it_ends_at_once(system: LiveSystem) -> None:
    aircraft = system.aircraft("sim:survey?seed=5&photos=40", pace=100.0)
    wait_until(lambda: aircraft.said().count("tiles sent") >= 6, FLIGHT_WITHIN_S)
    code, took_s = aircraft.stop()
    assert (code, took_s < 3.0) == (0, True), f"exit code {code} after {took_s:.1f} s"


@pytest.mark.parametrize("source", ["photos:nowhere", "lidar:x", "sim:survey?photos=none"])
def test_a_source_that_cannot_be_opened_is_refused_in_one_line(source: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--source", source]) == 1
    error = capsys.readouterr().err
    assert source in error
    assert error.count("\n") == 1
