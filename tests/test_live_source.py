"""The devices as a source, what is found plugged in, and how a device's state travels."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from device_ports import Player, VirtualPort, evenly
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20.common import MAV_AUTOPILOT_GENERIC, MAV_TYPE_QUADROTOR, MAVLink

from air.config import AirConfig
from air.devices.finding import cameras, name_of
from air.devices.settings import CameraConfig, DevicesConfig, ImuConfig, MavlinkConfig
from air.devices.status import DeviceStatus, State, Watch
from air.sensing import STREAM_OF
from air.sources.live import Live
from air.sources.source import open_source
from common.clock import SystemClock
from common.config import parse
from common.errors import ConfigError, SourceError
from common.measurements import ClockState, ImuSample, Measurement, RawBytes, VehicleState
from common.messages import Health
from common.wire import decode, encode


def test_without_a_receiver_the_computer_s_clock_stands_in(tmp_path: Path, real_data: Callable[[str], Path]) -> None:
    (recording,) = real_data("xsens").glob("*.bin")
    port = VirtualPort(tmp_path / "luojia-imu")
    port.plug()
    player = Player(port, evenly(recording.read_bytes(), 47.5))
    live = Live("live:", DevicesConfig(imu=ImuConfig(str(port.link))))
    items = iter(live)
    try:
        first = next(items)
        sample = next(item for item in items if isinstance(item, ImuSample))
        state = next(item for item in items if isinstance(item, ClockState))
        statuses = live.statuses()
    finally:
        live.close()
        player.stop()
        port.unplug()
    assert isinstance(first, RawBytes)  # held back until the clocks are known: everything but the bytes
    assert abs(SystemClock().now_ns() - sample.t_ns) < 5e9
    assert np.linalg.norm(sample.accel) == pytest.approx(9.8, abs=3.0)
    assert state.device in ("host", "imu")
    assert [status.state for status in statuses] == [State.ALIVE]
    assert len(list(items)) < 50  # what was left of the last arrival, then the end


def test_a_live_source_without_devices_or_settings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"needs the settings of the devices: live:FILE.toml"):
        open_source("live:")
    config = tmp_path / "air.toml"
    config.write_text('vehicle = "uav1"\n')
    with pytest.raises(SourceError, match=r"no device is configured; set devices.gnss.port"):
        open_source(f"live:{config}")


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"gnss": {"port": "COM3"}}, r"devices.gnss.port is 'COM3'; allowed: a path, tcp:HOST:PORT"),
        ({"imu": {"baud": 1}}, r"devices.imu.baud is 1; allowed: 300 to"),
        ({"camera": {"device": "webcam"}}, r"devices.camera.device is 'webcam'; allowed: /dev/videoN, realsense"),
        ({"camera": {"stamp": "begin"}}, r"devices.camera.stamp is 'begin'; allowed: 'start', 'readout', 'end'"),
    ],
)
def test_an_impossible_device_is_refused_with_its_key(table: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        parse({"devices": table}, AirConfig)


@given(
    state=st.sampled_from(State),
    rate_hz=st.floats(0, 1000).map(lambda x: round(x, 3)),
    age_s=st.none() | st.floats(0, 1000).map(lambda x: round(x, 3)),
    fault=st.text(st.characters(codec="ascii", categories=["L", "N", "P", "Z"]), max_size=60),
    dropped=st.integers(0, 2**40),
)
def test_a_status_travels_as_health(
    state: State, rate_hz: float, age_s: float | None, fault: str, dropped: int
) -> None:
    status = DeviceStatus("imu", "/dev/luojia-imu", state, rate_hz, age_s, fault, {"dropped_bytes": dropped})
    assert DeviceStatus.from_health(decode(Health, encode(status.health(7)))) == status


def test_other_healths_are_no_device() -> None:
    for text in ("60 photos placed", "alive | only two", ""):
        health = DeviceStatus("mapper", "x", State.ALIVE).health(1)
        assert DeviceStatus.from_health(Health(1, "mapper", health.level, text)) is None


def test_frames_without_measurements_are_a_fault() -> None:
    watch = Watch("gnss", "/dev/luojia-gnss")
    watch.opened(0.0)
    for t in range(60):
        watch.received(t / 10, 40, 1, 0, [])
    status = watch.status(6.0, {})
    assert status.state is State.ALIVE
    assert "none with a measurement" in status.fault
    watch.received(6.0, 40, 1, 0, ["GnssEpoch"])
    assert watch.status(6.1, {}).well


def test_rates_are_those_of_the_most_frequent_kind() -> None:
    watch = Watch("gnss", "/dev/luojia-gnss")
    watch.opened(0.0)
    for t in range(50):
        watch.received(t / 10, 40, 1, 0, ["GnssEpoch"] + ["KeplerEphemeris"] * (t % 10 == 0))
    assert watch.status(4.95, {}).rate_hz == pytest.approx(10.0, abs=0.51)


@pytest.mark.parametrize(
    ("vendor", "product", "description", "name"),
    [
        (0x1546, 0x01A9, "u-blox GNSS receiver", "GNSS receiver u-blox F9 (1546:01a9)"),
        (0x2639, 0x0300, "x", "IMU Xsens MTi (2639:0300)"),
        (0x0403, 0xD38B, "x", "IMU Xsens on a converter cable (0403:d38b)"),
        (0x0403, 0x6001, "FT232", "serial adapter FTDI (0403:6001)"),
        (0x9999, 0x0001, "Toaster", "Toaster (9999:0001)"),
        (None, None, "n/a", "serial port"),
    ],
)
def test_devices_are_named_by_their_usb_ids(
    vendor: int | None, product: int | None, description: str, name: str
) -> None:
    assert name_of(vendor, product, description) == name


def test_cameras_are_found_once_each(tmp_path: Path) -> None:
    for node, index, name in (("video0", 0, "Nose"), ("video1", 1, "Nose"), ("video10", 0, "Belly"), ("video2", 0, "")):
        (tmp_path / node).mkdir()
        (tmp_path / node / "index").write_text(f"{index}\n")
        (tmp_path / node / "name").write_text(f"{name}\n")
    (tmp_path / "video3").mkdir()  # vanished while it was looked at
    assert [found.path for found in cameras(tmp_path)] == ["/dev/video0", "/dev/video2", "/dev/video10"]
    assert cameras(tmp_path / "none") == []


def test_places_are_those_of_the_configured_devices() -> None:
    config = DevicesConfig(imu=ImuConfig("/dev/luojia-imu"), camera=CameraConfig("realsense:123"))
    assert config.places == {"imu": "/dev/luojia-imu", "camera": "realsense:123"}


def test_the_drone_s_telemetry_is_heard_through_an_address() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        host, number = probe.getsockname()
    live = Live("live:", DevicesConfig(mavlink=MavlinkConfig(f"udp:{host}:{number}")))
    drone = MAVLink(None, srcSystem=7)
    beat = drone.heartbeat_encode(MAV_TYPE_QUADROTOR, MAV_AUTOPILOT_GENERIC, 0, 0, 4).pack(drone)
    ended = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not ended.wait(0.05):
                sender.sendto(beat, (host, number))

    threading.Thread(target=send, daemon=True).start()
    try:
        state = next(item for item in live if isinstance(item, VehicleState))
    finally:
        ended.set()
        live.close()
    assert state.system == 7
    assert abs(SystemClock().now_ns() - state.t_ns) < 5e9


def test_every_measurement_has_its_stream() -> None:
    assert set(get_args(Measurement)) <= STREAM_OF.keys()
