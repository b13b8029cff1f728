"""A simulated flight at the pace of time, and as the source of `luojia-air run`."""

from __future__ import annotations

import time
from itertools import islice
from pathlib import Path

import pytest
from bus_network import client_of, collect, free_endpoint
from device_ports import wait_for
from live_system import Program

from air.devices.status import State
from air.sources.simulated.flown import SimulatedFlight
from air.sources.simulated.live import LiveFlight
from air.sources.source import open_source
from common.keys import all_of
from common.measurements import ImuSample, RawBytes
from common.messages import Health, Level
from common.streams import HEALTH, RAW_BYTES, RAW_GNSS, RAW_IMU
from common.wire import decode, encode

URL = "sim:plain?duration=4&flight.start=air"


def live(url: str = URL, now_s: object = time.monotonic) -> LiveFlight:
    flight = open_source(url)
    assert isinstance(flight, SimulatedFlight)
    return LiveFlight(flight, now_s)  # type: ignore[arg-type]


def test_measurements_come_when_their_time_has_come_and_as_they_are() -> None:
    flight = live("sim:plain?duration=2")
    begun_s = time.monotonic()
    flown = [encode(m) for m in flight]
    assert time.monotonic() - begun_s == pytest.approx(2.0, abs=0.7)
    statuses = {status.device: status for status in flight.statuses()}
    assert flown == [encode(m) for m in open_source("sim:plain?duration=2")]
    assert set(statuses) == {"imu", "gnss", "base", "mavlink"}
    assert {status.state for status in statuses.values()} == {State.ALIVE}
    assert statuses["imu"].rate_hz == pytest.approx(200, rel=0.1)
    assert all(status.well for status in statuses.values())


def test_a_closed_flight_ends() -> None:
    flight = live("sim:plain?duration=100")
    items = iter(flight)
    list(islice(items, 20))
    flight.close()
    assert len(list(items)) < 200


def test_a_computer_that_does_not_keep_up_is_told() -> None:
    """Every look at this clock takes 20 ms, and there are more than 200 arrivals a second."""
    now_s = 0.0

    def slow() -> float:
        nonlocal now_s
        now_s += 0.02
        return now_s

    flight = live(URL, slow)
    list(islice(flight, 500))
    (imu,) = (status for status in flight.statuses() if status.device == "imu")
    assert "this computer is too slow for the flight" in imu.fault


def test_run_flies_it_onto_the_bus_and_ends_with_it(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    config = tmp_path / "air.toml"
    config.write_text(f'[bus]\nlisten = ["{endpoint}"]\nconnect = []\nshared_memory = false\n')
    url = "sim:plain?duration=6&flight.start=air"
    program = Program(["air", "run", "--config", str(config), "--source", url], tmp_path / "air.log")
    try:
        wait_for(lambda: _listening(endpoint), 20.0)
        bus = client_of(endpoint)
        imu, raw, gnss, health = (collect(bus, all_of(s))[0] for s in (RAW_IMU, RAW_BYTES, RAW_GNSS, HEALTH))
        assert program.process.wait(30.0) == 0
    finally:
        program.process.kill()
        program.process.wait()
    sent = {encode(m) for m in open_source(url) if isinstance(m, ImuSample | RawBytes)}
    assert len(imu) > 300
    assert gnss
    assert {payload for _, payload in (*imu, *raw)} <= sent
    told = [decode(Health, payload) for _, payload in health]
    assert {message.role for message in told} >= {"imu", "gnss", "base", "mavlink"}
    assert all(message.level is Level.OK for message in told)
    bus.close()


def _listening(endpoint: str) -> bool:
    try:
        client_of(endpoint).close()
    except Exception:
        return False
    return True
