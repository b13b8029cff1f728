"""Telemetry at the ground: from a socket over the bus to the operator's panel."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from common.bus_memory import MemoryBroker, MemoryBus
from common.clock import SystemClock
from common.config import parse
from common.errors import ConfigError
from common.measurements import FixKind, Severity, VehicleState
from ground.config import GroundConfig, TelemetryConfig
from ground.gateway import Gateway
from ground.station import Station
from ground.telemetry import TelemetryNode
from ground.viewer.drone import BAD, FAIR, GOOD, PLAIN, drone_lines
from ground.viewer.scene import Scene, VehicleRow

KNOWN = VehicleState(
    t_ns=0,
    system=1,
    armed=True,
    mode="LOITER",
    height_home=40.2,
    battery=0.76,
    voltage_v=22.9,
    fix=FixKind.FIX_3D,
    satellites=17,
    radio_rssi=0.5,
)


def heartbeat(mode: int = 5) -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=9, srcComponent=1)
    return bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0x81, mode, 4, 3).pack(sender))


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def ground() -> Iterator[tuple[MemoryBus, Callable[[], Scene]]]:
    """A station's bus, and what it shows."""
    bus = MemoryBus(MemoryBroker())
    gateway = Gateway(bus, Station("ground"), None, SystemClock().now_ns)
    gateway.start()
    yield bus, gateway.scene
    gateway.close()


def shown(scene: Callable[[], Scene], mode: str, send: Callable[[], object], seconds: float = 8.0) -> VehicleRow:
    """What the station shows once the vehicle's mode is as wanted, while somebody keeps sending."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        send()
        rows = scene().vehicles
        if rows and rows[0].state.mode == mode:
            return rows[0]
        time.sleep(0.02)
    raise AssertionError(f"mode {mode} never arrived")


def test_a_drone_that_speaks_by_udp_is_shown(ground: tuple[MemoryBus, Callable[[], Scene]]) -> None:
    bus, scene = ground
    port = free_port(socket.SOCK_DGRAM)
    node = TelemetryNode(TelemetryConfig(f"udp:127.0.0.1:{port}", vehicle="uav7"), bus, SystemClock())
    node.start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        row = shown(scene, "LOITER", lambda: sender.sendto(heartbeat(), ("127.0.0.1", port)))
    node.close()
    assert (row.vehicle, row.state.system, row.state.armed) == ("uav7", 9, True)
    assert abs(row.state.t_ns - SystemClock().now_ns()) < 10e9
    assert row.age_s < 5


def test_a_link_that_breaks_is_opened_again(ground: tuple[MemoryBus, Callable[[], Scene]]) -> None:
    bus, scene = ground
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        node = TelemetryNode(TelemetryConfig(url), bus, SystemClock())
        node.start()
        for mode, name in ((5, "LOITER"), (6, "RTL")):
            connection, _ = server.accept()
            with connection:
                shown(scene, name, lambda c=connection, m=mode: c.sendall(heartbeat(m)))  # type: ignore[misc]
        node.close()


def test_a_station_without_a_link_shows_what_comes_from_on_board() -> None:
    assert GroundConfig().telemetry.url == ""
    for url in ("udp:14550", "serial", "tcp:host"):
        with pytest.raises(ConfigError, match=r"telemetry\.url"):
            parse({"telemetry": {"url": url}}, GroundConfig)
    with pytest.raises(ConfigError, match=r"telemetry\.vehicle"):
        parse({"telemetry": {"vehicle": "a b"}}, GroundConfig)


def test_the_operator_reads_what_matters() -> None:
    ((colour, text),) = drone_lines(VehicleRow("uav1", KNOWN, 0.2))
    assert colour == GOOD
    assert text.startswith("uav1 drone: armed · LOITER · 40 m above home · battery 76 % (22.9 V) · ")
    assert text.endswith("GPS 3d (17 satellites) · radio 50 %")
    ((colour, text),) = drone_lines(VehicleRow("uav1", KNOWN, 12.0))
    assert (colour, text.endswith("silent for 12 s")) == (BAD, True)
    (line,) = drone_lines(VehicleRow("uav1", VehicleState(0, 1), 0.0))
    assert line == (GOOD, "uav1 drone: nothing known")


@pytest.mark.parametrize(
    ("state", "colours"),
    [
        (VehicleState(0, 1, battery=0.29), [FAIR]),
        (VehicleState(0, 1, battery=0.1), [BAD]),
        (VehicleState(0, 1, fix=FixKind.NONE), [FAIR]),
        (VehicleState(0, 1, severity=Severity.CRITICAL, text="crash"), [GOOD, BAD]),
        (VehicleState(0, 1, severity=Severity.WARNING, text="wind"), [GOOD, FAIR]),
        (VehicleState(0, 1, severity=None, text="hello"), [GOOD, PLAIN]),
    ],
)
def test_what_is_wrong_has_a_colour(state: VehicleState, colours: list[str]) -> None:
    assert [colour for colour, _ in drone_lines(VehicleRow("uav1", state, 0.0))] == colours
