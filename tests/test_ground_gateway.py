"""The gateway: whoever listens, whenever they join and however often they die, ends with the aircraft's map."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_map import DATUM_HERE, FLIGHT, FakeAircraft, keyframe, pose, small_tile

from common.bus import Bus, BusConfig, ZenohBus
from common.bus_memory import MemoryBroker, MemoryBus
from common.keys import all_of, stream_key
from common.messages import Health, Level
from common.se3 import SE3
from common.streams import DIGEST, HEALTH, TILE
from common.wire import decode
from ground.cloud import FlightId
from ground.gateway import Gateway
from ground.station import Station
from ground.store import Store

UAV1 = FlightId("uav1", FLIGHT)
Medium = Callable[[], Bus]


class Ground:
    """A station on a bus, and a look at what it holds."""

    def __init__(self, bus: Bus, name: str, store: Path | None = None) -> None:
        self.station = Station(name)
        self.gateway = Gateway(bus, self.station, Store(store) if store else None, time.time_ns)
        self.gateway.start()

    def revisions(self) -> list[tuple[int, ...]]:
        return sorted((t.id.level, t.id.x, t.id.y, t.revision) for t in self.gateway.scene().tiles)

    def keyframes(self) -> list[tuple[int, int]]:
        return [(k.keyframe.index, k.keyframe.revision) for k in self.gateway.scene().keyframes]


@pytest.fixture(params=["memory", "zenoh"])
def medium(request: pytest.FixtureRequest) -> Iterator[Medium]:
    """Opens buses that hear each other: first the router, then its clients."""
    with ExitStack() as stack:
        broker = MemoryBroker()
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        opened: list[Bus] = []

        def open_bus() -> Bus:
            if request.param == "memory":
                bus: Bus = MemoryBus(broker)
            elif not opened:
                bus = ZenohBus(BusConfig("router", listen=(endpoint,), shared_memory=False))
            else:
                bus = ZenohBus(BusConfig("client", connect=(endpoint,), shared_memory=False))
            opened.append(bus)
            stack.callback(bus.close)
            return bus

        yield open_bus


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def eventually(holds: Callable[[], bool], timeout_s: float = 10.0) -> None:
    """Wait until something holds; fail when it does not in time."""
    end = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.02)


def aircraft_revisions(aircraft: FakeAircraft) -> list[tuple[int, ...]]:
    return [tuple(row) for row in aircraft.digest().tiles.tolist()]


def fly(aircraft: FakeAircraft, lose: int = 0) -> None:
    """A flight of 12 tiles, of which some change and some get lost, and 4 keyframes, one of them refined."""
    aircraft.beat()
    for revision in (1, 2):
        for number, x in enumerate(range(-6, 6)):
            if revision == 1 or x % 2:
                aircraft.send_tile(small_tile(x, 1, revision), lost=number < lose)
    for index in range(4):
        aircraft.send_keyframe(keyframe(index, 5.0 * index))
    aircraft.send_keyframe(keyframe(2, 10.5, revision=3))
    aircraft.send_pose(pose(9 * 10**9, 3.0, 4.0))


def test_lost_tiles_are_asked_for_and_sent_again(medium: Medium) -> None:
    ground = Ground(medium(), "ground")
    aircraft = FakeAircraft(medium())
    eventually(lambda: ground.gateway.scene().alive.get("uav1", False))
    fly(aircraft, lose=5)
    aircraft.beat()
    eventually(lambda: ground.revisions() == aircraft_revisions(aircraft))
    assert aircraft.requests == 5
    aircraft.beat()
    time.sleep(0.2)
    assert aircraft.requests == 5
    ground.gateway.close()


def test_a_late_joiner_gets_the_same_tiles_though_the_aircraft_is_gone(medium: Medium) -> None:
    first = Ground(medium(), "first")
    aircraft = FakeAircraft(medium())
    eventually(lambda: first.gateway.scene().alive.get("uav1", False))
    fly(aircraft)
    eventually(lambda: first.revisions() == aircraft_revisions(aircraft))
    eventually(lambda: len(first.keyframes()) == 4)
    aircraft.close()

    late = Ground(medium(), "late")
    eventually(lambda: late.revisions() == aircraft_revisions(aircraft))
    eventually(lambda: late.keyframes() == [(0, 1), (1, 1), (2, 3), (3, 1)])
    assert late.gateway.scene().origin == DATUM_HERE
    for gateway in (first.gateway, late.gateway):
        gateway.close()


def test_a_restarted_ground_has_what_it_had_and_what_it_missed(medium: Medium, tmp_path: Path) -> None:
    router = medium()
    ground = Ground(router, "ground", tmp_path / "ground.sqlite")
    aircraft = FakeAircraft(medium())
    eventually(lambda: ground.gateway.scene().alive.get("uav1", False))
    fly(aircraft)
    eventually(lambda: ground.revisions() == aircraft_revisions(aircraft))
    ground.gateway.close()

    aircraft.send_tile(small_tile(0, 1, 9))
    aircraft.send_keyframe(keyframe(4, 20.0))
    again = Ground(router, "ground", tmp_path / "ground.sqlite")
    eventually(lambda: len(again.revisions()) == 12)
    aircraft.beat()
    eventually(lambda: again.revisions() == aircraft_revisions(aircraft))
    eventually(lambda: [index for index, _ in again.keyframes()] == [0, 1, 2, 3, 4])
    assert aircraft.requests == 1
    again.gateway.close()


def test_twenty_tiles_a_second_are_kept_up_with(medium: Medium, tmp_path: Path) -> None:
    ground = Ground(medium(), "ground", tmp_path / "ground.sqlite")
    aircraft = FakeAircraft(medium())
    eventually(lambda: ground.gateway.scene().alive.get("uav1", False))
    aircraft.beat()
    for i in range(30):
        aircraft.send_tile(small_tile(i % 6, i // 6, revision=i + 1))
        time.sleep(0.05)
    eventually(lambda: ground.revisions() == aircraft_revisions(aircraft), timeout_s=0.5)
    ground.gateway.close()


def test_bad_bytes_are_counted_and_hurt_nothing(medium: Medium) -> None:
    ground = Ground(medium(), "ground")
    bus = medium()
    aircraft = FakeAircraft(bus)
    eventually(lambda: ground.gateway.scene().alive.get("uav1", False))
    bus.publish(stream_key("uav1", TILE, 0, 0, 0), b"\xc1 nonsense", TILE)
    bus.publish(stream_key("uav1", DIGEST), b"", DIGEST)
    eventually(lambda: ground.gateway.scene().faults == 2)
    fly(aircraft)
    eventually(lambda: ground.revisions() == aircraft_revisions(aircraft))
    ground.gateway.close()


def test_health_tells_of_a_disk_that_refuses_and_the_service_goes_on(tmp_path: Path) -> None:
    (tmp_path / "ground.sqlite").write_bytes(b"no database" * 1000)
    broker = MemoryBroker()
    heard: list[Health] = []
    MemoryBus(broker).subscribe(all_of(HEALTH, "ground"), lambda _, payload: heard.append(decode(Health, payload)))
    ground = Ground(MemoryBus(broker), "ground", tmp_path / "ground.sqlite")
    aircraft = FakeAircraft(MemoryBus(broker))
    fly(aircraft)
    eventually(lambda: ground.revisions() == aircraft_revisions(aircraft))
    eventually(lambda: bool(heard) and heard[-1].level is Level.DEGRADED)
    assert "ground.sqlite" in heard[-1].text
    ground.gateway.close()


def test_a_vehicle_is_connected_while_its_token_stands(medium: Medium) -> None:
    ground = Ground(medium(), "ground")
    aircraft = FakeAircraft(medium())
    eventually(lambda: ground.gateway.scene().alive == {"uav1": True})
    aircraft.close()
    eventually(lambda: not ground.gateway.scene().alive.get("uav1", False))
    ground.gateway.close()


def test_worlds_of_two_flights_meet_in_the_scene() -> None:
    broker = MemoryBroker()
    ground = Ground(MemoryBus(broker), "ground")
    north = replace(DATUM_HERE, flight="2024-07-01T00:00:00Z", latitude_deg=DATUM_HERE.latitude_deg + 0.001)
    for vehicle, datum in (("uav1", DATUM_HERE), ("uav2", north)):
        FakeAircraft(MemoryBus(broker), vehicle, datum).beat()
    eventually(lambda: len(ground.gateway.scene().datums) == 2)
    scene = ground.gateway.scene()
    here, there = scene.T_scene_world(UAV1), scene.T_scene_world(FlightId("uav2", north.flight))
    assert isinstance(here, SE3)
    assert there is not None
    np.testing.assert_array_equal(here.t, np.zeros(3))
    # A thousandth of a degree of latitude at 50.84° is 111.24 m (pyproj.Geod, WGS84).
    np.testing.assert_allclose(there.t, [0.0, 111.24, 0.0], atol=0.02)
    ground.gateway.close()
