"""A simulated flight at the pace of time, and as the source of `luojia-air run`."""

from __future__ import annotations

import time
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from bus_network import client_of, collect, free_endpoint
from device_ports import wait_for
from live_system import Program

from air.devices.status import State
from air.sources.simulated.flown import SimulatedFlight
from air.sources.simulated.live import LiveFlight
from air.sources.source import open_source
from common.bus import BusConfig, ZenohBus
from common.keys import all_of
from common.measurements import ImuSample, RawBytes
from common.messages import Health, Level, MapTile
from common.streams import HEALTH, RAW_BYTES, RAW_GNSS, RAW_IMU, TILE
from common.wire import decode, encode

URL = "sim:plain?duration=4&flight.start=air"


def live(url: str = URL, now_s: object = time.monotonic) -> LiveFlight:
    flight = open_source(url)
    assert isinstance(flight, SimulatedFlight)
    return LiveFlight(flight, now_s)  # type: ignore[arg-type]


def test_measurements_come_when_their_time_has_come_and_as_they_are() -> None:
    flight = live("sim:plain?duration=2")
    items = iter(flight)
    flown = [encode(next(items))]
    begun_s = time.monotonic()
    flown += [encode(m) for m in items]
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


def test_run_flies_it_onto_the_bus(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    config = tmp_path / "air.toml"
    config.write_text(f'[bus]\nlisten = ["{endpoint}"]\nconnect = []\nshared_memory = false\n')
    url = "sim:plain?duration=6&flight.start=air"
    program = Program(["air", "run", "--config", str(config), "--source", url], tmp_path / "air.log")
    try:
        wait_for(lambda: _listening(endpoint), 20.0)
        bus = client_of(endpoint)
        imu, raw, gnss, health = (collect(bus, all_of(s))[0] for s in (RAW_IMU, RAW_BYTES, RAW_GNSS, HEALTH))
        wait_for(lambda: len(imu) > 300 and len(health) > 8, 20.0)
        assert program.stop()[0] == 0
    finally:
        program.process.kill()
        program.process.wait()
    sent = {encode(m) for m in open_source(url) if isinstance(m, ImuSample | RawBytes)}
    assert gnss
    assert {payload for _, payload in (*imu, *raw)} <= sent
    told = [decode(Health, payload) for _, payload in health]
    devices = {"imu", "gnss", "base", "mavlink"}
    assert {message.role for message in told} >= devices
    assert all(message.level is Level.OK for message in told if message.role in devices)
    bus.close()


def _listening(endpoint: str) -> bool:
    try:
        client_of(endpoint).close()
    except Exception:
        return False
    return True


@pytest.mark.slow
def test_run_maps_what_the_camera_of_a_simulated_flight_sees(tmp_path: Path) -> None:
    """The mapper has a process of its own, which goes to the ground by itself and ends with the flight."""
    ground = free_endpoint()
    config = tmp_path / "air.toml"
    config.write_text(f'[bus]\nlisten = ["{free_endpoint()}"]\nconnect = ["{ground}"]\nshared_memory = false\n')
    bus = ZenohBus(BusConfig("router", listen=(ground,), shared_memory=False))
    tiles, _ = collect(bus, all_of(TILE))
    url = "sim:playground?duration=120&flight.start=air&camera.rate_hz=2&base=off"
    program = Program(["air", "run", "--config", str(config), "--source", url], tmp_path / "air.log")
    try:
        wait_for(lambda: len(tiles) > 20, 120.0)
        assert program.stop()[0] == 0
    finally:
        program.process.kill()
        program.process.wait()
    known = [decode(MapTile, payload) for _, payload in tiles]
    assert any(np.isfinite(tile.height).any() for tile in known)
    bus.close()
