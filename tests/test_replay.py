"""A replay publishes the same bytes in the same order, at the pace that was asked for."""

from __future__ import annotations

import time
from itertools import islice
from pathlib import Path

import pytest
from bus_network import collect, free_endpoint, wait_until
from live_system import Program
from recording_samples import START_NS, STEP_NS, flight, write

from air.__main__ import main
from air.replay import Passage, paced, publish
from common.bus import BusConfig, ZenohBus
from common.bus_memory import MemoryBroker, MemoryBus
from common.clock import ManualClock
from common.errors import SourceError
from common.keys import PREFIX, alive_key
from common.recording.reader import Recorded, Recording

FLIGHT = flight(100)
STEP_S = STEP_NS * 1e-9


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    write(tmp_path / "flight.mcap", FLIGHT)
    return Recording(tmp_path / "flight.mcap")


@pytest.mark.parametrize("speed", [0.5, 1.0, 20.0, float("inf")])
def test_messages_come_in_order_when_their_time_has_come(recording: Recording, speed: float) -> None:
    clock = ManualClock(77)
    seen = [(message, clock.t_ns - 77) for message in paced(recording, Passage(speed), clock)]
    assert [message for message, _ in seen] == FLIGHT
    for message, t_ns in seen:
        assert t_ns == pytest.approx((message.log_ns - START_NS) / speed, abs=100)


def test_a_slow_listener_accumulates_no_delay(recording: Recording) -> None:
    clock = ManualClock()
    for message in paced(recording, Passage(), clock):
        assert clock.t_ns - (message.log_ns - START_NS) <= 0.9 * STEP_NS
        clock.sleep(0.9 * STEP_S)


def test_start_and_end_choose_a_passage_and_a_loop_repeats_it(recording: Recording) -> None:
    clock = ManualClock()
    passage = Passage(1.0, 10 * STEP_S, 20 * STEP_S, loop=True)
    seen = list(islice(paced(recording, passage, clock), 25))
    assert seen == (FLIGHT[10:20] * 3)[:25]


@pytest.mark.parametrize(
    "wrong", [{"speed": 0.0}, {"speed": float("nan")}, {"start_s": -1.0}, {"start_s": 5.0, "end_s": 5.0}]
)
def test_an_impossible_passage_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SourceError, match="allowed"):
        Passage(**wrong)  # type: ignore[arg-type]


def test_a_passage_without_messages_is_refused(recording: Recording) -> None:
    with pytest.raises(SourceError, match="no message in this passage"):
        list(paced(recording, Passage(start_s=1e4, loop=True), ManualClock()))


def test_the_bus_gets_the_same_bytes_under_the_same_keys(recording: Recording) -> None:
    bus = MemoryBus(MemoryBroker())
    got, _ = collect(bus, f"{PREFIX}/**")
    count = publish([*recording.messages(), Recorded(0, "luojia/@v1/uav1/of/old", b"")], bus)
    wait_until(lambda: len(got) == count)
    assert got == [(message.key, message.payload) for message in FLIGHT]


def test_the_command_replays_over_zenoh_byte_for_byte(recording: Recording, tmp_path: Path) -> None:
    endpoint = free_endpoint()
    listener = ZenohBus(BusConfig("peer", listen=(endpoint,)))
    got, _ = collect(listener, f"{PREFIX}/**")
    listener.declare_alive(alive_key("listener", "test"))
    config = tmp_path / "air.toml"
    config.write_text(f'[bus]\nconnect = ["{endpoint}"]\n')
    command = ["air", "replay", str(recording.path), "--config", str(config), "--speed", "10", "--quiet"]
    program = Program(command, tmp_path / "log")
    begun_s = time.monotonic()
    assert program.process.wait(timeout=30.0) == 0, program.said()
    assert time.monotonic() - begun_s > len(FLIGHT) * STEP_S / 10
    wait_until(lambda: len(got) == len(FLIGHT))
    # Urgent streams overtake others on the link; each keeps its order.
    for stream_key in {message.key for message in FLIGHT}:
        assert [p for k, p in got if k == stream_key] == [m.payload for m in FLIGHT if m.key == stream_key]
    assert f"{len(FLIGHT)} messages" in program.said()
    listener.close()


def test_a_file_that_is_no_recording_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path / "none.mcap")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
