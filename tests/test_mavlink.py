"""MAVLink: a real log against pymavlink's own reading, every message and every "unknown", damage, who is followed."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v10 import ardupilotmega as v1
from pymavlink.dialects.v20 import ardupilotmega as v2

from air.sensors.driver import TimeScale
from air.sensors.mavlink import MavlinkVehicle
from air.sources.source import open_source
from common.clock import GPST_MINUS_UTC_NS
from common.counts import Counts
from common.mavlink import PacketScanner, Stamps, Telemetry, is_tlog
from common.measurements import FixKind, Severity, VehicleState
from common.se3 import quaternion_to_matrix

LOG = "cuav/testimgs/flight.tlog"
HOUR_NS = 3_600_000_000_000


def packed(*messages: Any, dialect: Any = v2, system: int = 1) -> bytes:
    sender = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
    return b"".join(message.pack(sender) for message in messages)


def heartbeat(base_mode: int = 0x81, custom_mode: int = 5, autopilot: int = v2.MAV_AUTOPILOT_ARDUPILOTMEGA) -> Any:
    return v2.MAVLink_heartbeat_message(v2.MAV_TYPE_QUADROTOR, autopilot, base_mode, custom_mode, 4, 3)


def after(*messages: Any, before: tuple[Any, ...] = ()) -> VehicleState:
    """The state when a vehicle has sent a heartbeat, then others, a second apart."""
    telemetry = Telemetry()
    for i, message in enumerate((heartbeat(), *before, *messages)):
        states = telemetry.feed(packed(message), i * 1_000_000_000)
    (state,) = states
    return state


# The real log


@pytest.fixture
def log(real_data: Callable[[str], Path]) -> Path:
    return real_data(LOG)


def test_every_message_of_the_log_is_the_one_that_pymavlink_reads(log: Path) -> None:
    reader = mavutil.mavlink_connection(str(log), robust_parsing=True)
    expected = []
    while (message := reader.recv_match()) is not None:
        expected.append((round(message._timestamp * 1e6), message.get_srcSystem(), message.to_dict()))
    counts = Counts()
    packets = PacketScanner(counts, tlog=True).feed(log.read_bytes())
    found = [((p.t_ns - GPST_MINUS_UTC_NS) // 1000, p.system, p.message.to_dict()) for p in packets if p.t_ns]
    assert len(found) == len(expected) > 19_000
    # pymavlink gives the time as a float, good to a microsecond; NaN in a message is not equal to itself.
    assert max(abs(a[0] - b[0]) for a, b in zip(found, expected, strict=True)) <= 1
    assert [repr(a[1:]) for a in found] == [repr(b[1:]) for b in expected]
    assert counts.frames == Counter(fields["mavpackettype"] for _, _, fields in expected)
    assert counts.dropped_bytes == 0


def test_the_states_of_the_log_follow_its_messages(log: Path) -> None:
    source = open_source(f"mavlink:{log}")
    states = [state for state in source if isinstance(state, VehicleState)]
    assert not source.problems
    gaps = np.diff([state.t_ns for state in states])
    assert gaps.min() >= 100_000_000
    assert len(states) > 1000
    last = states[-1]
    assert last.system == 1
    assert last.fix is FixKind.FIX_3D
    assert last.latitude_deg == pytest.approx(-35.36, abs=0.02)
    speeds = [np.linalg.norm(s.v_enu) for s in states if s.v_enu is not None]
    moved = [(s.latitude_deg, s.longitude_deg, s.t_ns) for s in states if s.latitude_deg and s.longitude_deg]
    north = np.diff([m[0] for m in moved]) * 111_000
    east = np.diff([m[1] for m in moved]) * 111_000 * math.cos(math.radians(-35.36))
    length = np.hypot(north, east).sum()
    duration = (moved[-1][2] - moved[0][2]) / 1e9
    assert length / duration == pytest.approx(np.mean(speeds), rel=0.1)  # the plane climbs, and its wind is no matter
    # The nose of a fixed wing points about where it goes: east and north are not mixed up.
    ahead = [
        float(quaternion_to_matrix(s.q_enu_body)[:2, 0] @ s.v_enu[:2] / np.linalg.norm(s.v_enu[:2]))
        for s in states
        if s.q_enu_body is not None and s.v_enu is not None and np.linalg.norm(s.v_enu[:2]) > 5
    ]
    assert np.median(ahead) > 0.9


def test_a_log_without_its_stamps_is_told_by_the_time_since_start(log: Path, tmp_path: Path) -> None:
    packets = PacketScanner(Counts(), tlog=True).feed(log.read_bytes()[:200_000])
    bare = b"".join(bytes(p.message.get_msgbuf()) for p in packets)
    assert not is_tlog(bare[:4096])
    (tmp_path / "link.bin").write_bytes(bare)
    states = [s for s in open_source(f"mavlink:{tmp_path / 'link.bin'}") if isinstance(s, VehicleState)]
    stamps = [s.t_ns for s in states]
    assert len(states) > 200
    assert 0 < stamps[-1] < HOUR_NS


# Messages


def test_an_armed_vehicle_and_its_mode() -> None:
    state = after(heartbeat(v2.MAV_MODE_FLAG_SAFETY_ARMED | v2.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, 3))
    assert (state.armed, state.mode) == (True, "AUTO")
    state = after(heartbeat(v2.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, 4242))
    assert (state.armed, state.mode) == (False, None)


@pytest.mark.parametrize("as_quaternion", [False, True])
@pytest.mark.parametrize(
    ("roll", "pitch", "yaw", "forward", "left"),
    [
        (0, 0, 0, (0, 1, 0), (-1, 0, 0)),
        (0, 0, 90, (1, 0, 0), (0, 1, 0)),
        (0, 30, 0, (0, math.cos(math.pi / 6), 0.5), (-1, 0, 0)),
        (90, 0, 0, (0, 1, 0), (0, 0, 1)),
    ],
)
def test_the_attitude_is_of_forward_left_up_in_enu(
    as_quaternion: bool, roll: float, pitch: float, yaw: float, forward: tuple[float, ...], left: tuple[float, ...]
) -> None:
    """MAVLink: yaw clockwise from north, pitch nose up, roll right wing down."""
    r, p, y = (math.radians(a) for a in (roll, pitch, yaw))
    message = v2.MAVLink_attitude_message(5, r, p, y, 0, 0, 0)
    if as_quaternion:
        message = v2.MAVLink_attitude_quaternion_message(5, *mavutil_quaternion(r, p, y), 0, 0, 0)
    state = after(message)
    assert state.q_enu_body is not None
    R_enu_body = quaternion_to_matrix(state.q_enu_body)
    np.testing.assert_allclose(R_enu_body[:, 0], forward, atol=1e-6)
    np.testing.assert_allclose(R_enu_body[:, 1], left, atol=1e-6)


def mavutil_quaternion(roll: float, pitch: float, yaw: float) -> list[float]:
    from pymavlink.quaternion import Quaternion

    return [float(c) for c in Quaternion([roll, pitch, yaw]).q]


def test_position_and_velocity() -> None:
    state = after(
        v2.MAVLink_global_position_int_message(1, 476_000_000, -80_000_000, 512_300, 40_100, 100, -200, 50, 0)
    )
    assert (state.latitude_deg, state.longitude_deg) == pytest.approx((47.6, -8.0))
    assert (state.height_msl, state.height_home) == pytest.approx((512.3, 40.1))
    assert state.v_enu is not None
    np.testing.assert_allclose(state.v_enu, [-2.0, 1.0, -0.5])


def test_battery_gps_radio_home_and_load() -> None:
    cells = [4000, 3990, 3980] + [0xFFFF] * 7
    state = after(
        v2.MAVLink_gps_raw_int_message(0, 6, 0, 0, 0, 90, 90, 0, 0, 17, 0, 1400, 2000, 0, 0),
        v2.MAVLink_sys_status_message(0, 0, 0, 250, 11_000, 500, 60, 0, 0, 0, 0, 0, 0),
        v2.MAVLink_battery_status_message(0, 0, 0, 0, cells, 1550, 0, 0, 75),
        v2.MAVLink_rc_channels_message(0, 8, *[1500] * 18, 127),
        v2.MAVLink_home_position_message(10_000_000, 20_000_000, 30_000, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0),
    )
    assert (state.fix, state.satellites, state.sigma_horizontal) == (FixKind.RTK_FIXED, 17, pytest.approx(1.4))
    assert (state.battery, state.load) == (0.75, 0.25)
    assert (state.voltage_v, state.current_a) == pytest.approx((11.97, 15.5))
    assert state.radio_rssi == 0.5
    assert state.home == (1.0, 2.0, 30.0)


def test_gimbals_tell_their_yaw_from_north() -> None:
    east = v2.MAVLink_attitude_message(5, 0, 0, math.pi / 2, 0, 0, 0)
    down = after(v2.MAVLink_mount_status_message(0, 0, -9000, 0, 1000), before=(east,)).gimbal
    assert down == pytest.approx((0, -math.pi / 2, math.radians(100)))
    half = math.sqrt(0.5)
    for flags, yaw in ((64, 0.0), (32, math.pi / 2), (16, 0.0), (0, math.pi / 2)):
        message = v2.MAVLink_gimbal_device_attitude_status_message(0, 0, 0, flags, [1, 0, 0, 0], 0, 0, 0, 0)
        assert after(message, before=(east,)).gimbal == pytest.approx((0, 0, yaw))
    down_device = v2.MAVLink_gimbal_device_attitude_status_message(0, 0, 0, 64, [half, 0, -half, 0], 0, 0, 0, 0)
    gimbal = after(down_device).gimbal
    assert gimbal is not None
    assert gimbal[1] == pytest.approx(-math.pi / 2, abs=1e-3)
    orientation = v2.MAVLink_mount_orientation_message(0, 1.0, -45.0, 100.0)
    assert after(orientation, before=(east,)).gimbal == pytest.approx(
        (math.radians(1), -math.pi / 4, math.radians(190 - 360))
    )
    assert after(orientation).gimbal is None  # turned with an airframe whose yaw nobody knows


def test_texts_come_whole_and_printable() -> None:
    state = after(v2.MAVLink_statustext_message(4, b"low \x07battery"))
    assert (state.severity, state.text) == (Severity.WARNING, "low battery")
    long = [v2.MAVLink_statustext_message(2, part, 7, i) for i, part in enumerate((b"first, ", b"second, ", b"third"))]
    assert after(*long).text == "first, second, third"
    assert after(v2.MAVLink_statustext_message(9, b"odd")).severity is None


# Unknown

NAN = math.nan
UNKNOWN = [
    (v2.MAVLink_attitude_message(0, NAN, 0, 0, 0, 0, 0), ["q_enu_body"]),
    (v2.MAVLink_attitude_quaternion_message(0, NAN, 0, 0, 0, 0, 0, 0), ["q_enu_body"]),
    (v2.MAVLink_attitude_quaternion_message(0, 0, 0, 0, 0, 0, 0, 0), ["q_enu_body"]),
    (
        v2.MAVLink_global_position_int_message(
            0, 0x7FFFFFFF, 0x7FFFFFFF, 0x7FFFFFFF, 0x7FFFFFFF, 0x7FFF, 0x7FFF, 0x7FFF, 0xFFFF
        ),
        ["latitude_deg", "longitude_deg", "height_msl", "height_home", "v_enu"],
    ),
    (v2.MAVLink_global_position_int_message(0, 0, 0, 5, 4, 0, 0, 0, 0), ["latitude_deg", "longitude_deg"]),
    (v2.MAVLink_global_position_int_message(0, 1, 1, 4000, 4000, 0, 0, 0, 0), ["height_msl"]),
    (
        v2.MAVLink_gps_raw_int_message(0, 200, 0, 0, 0, 0xFFFF, 0xFFFF, 0xFFFF, 0xFFFF, 0xFF),
        ["fix", "satellites", "sigma_horizontal"],
    ),
    (
        v2.MAVLink_battery_status_message(0, 0, 0, 0x7FFF, [0xFFFF] * 10, -1, -1, -1, -1),
        ["battery", "voltage_v", "current_a"],
    ),
    (
        v2.MAVLink_sys_status_message(0, 0, 0, 0xFFFF, 0xFFFF, -1, -1, 0, 0, 0, 0, 0, 0),
        ["battery", "voltage_v", "current_a", "load"],
    ),
    (v2.MAVLink_mount_orientation_message(0, NAN, NAN, NAN), ["gimbal"]),
    (v2.MAVLink_gimbal_device_attitude_status_message(0, 0, 0, 64, [NAN] * 4, NAN, NAN, NAN, 0), ["gimbal"]),
    (v2.MAVLink_home_position_message(0, 0, 0, 0, 0, 0, [0] * 4, 0, 0, 0), ["home"]),
    (v2.MAVLink_radio_status_message(0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0, 0), ["radio_rssi"]),
    (v2.MAVLink_radio_status_message(0, 0, 0, 0, 0, 0, 0), ["radio_rssi"]),
    (v2.MAVLink_rc_channels_message(0, 0, *[0xFFFF] * 18, 0xFF), ["radio_rssi"]),
    (v2.MAVLink_altitude_message(0, NAN, NAN, NAN, NAN, NAN, NAN), ["height_msl", "height_home"]),
    (v2.MAVLink_altitude_message(0, 0, 0, 0, 12.5, 0, 0), ["height_msl"]),
]


@pytest.mark.parametrize(("message", "fields"), UNKNOWN, ids=lambda v: getattr(v, "name", None) or "")
def test_what_the_protocol_calls_unknown_stays_unknown(message: Any, fields: list[str]) -> None:
    state = after(message)
    assert {name: getattr(state, name) for name in fields} == dict.fromkeys(fields)


def test_unknown_clears_what_the_same_message_said_and_leaves_what_others_say() -> None:
    cells = [4000] + [0xFFFF] * 9
    known = v2.MAVLink_battery_status_message(0, 0, 0, 0, cells, 100, 0, 0, 80)
    unknown = v2.MAVLink_battery_status_message(0, 0, 0, 0, [0xFFFF] * 10, -1, 0, 0, -1)
    assert after(known, v2.MAVLink_sys_status_message(0, 0, 0, 0, 0xFFFF, -1, -1, 0, 0, 0, 0, 0, 0)).battery == 0.8
    assert after(known, unknown).battery is None
    second = v2.MAVLink_battery_status_message(1, 0, 0, 0, cells, 100, 0, 0, 10)
    assert after(known, second, heartbeat()).battery == 0.8


# Who is followed, and when it is told


def test_the_first_autopilot_is_followed_and_nobody_else() -> None:
    telemetry = Telemetry()
    attitude = v2.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0)
    station = heartbeat(autopilot=v2.MAV_AUTOPILOT_INVALID)
    assert telemetry.feed(packed(attitude, station, system=255) + packed(attitude, system=7), 0) == []
    (state,) = telemetry.feed(packed(heartbeat(), system=7), 0)
    assert state.system == telemetry.system == 7
    assert telemetry.feed(packed(heartbeat(), attitude, system=8), HOUR_NS) == []
    assert Telemetry(system=8).feed(packed(heartbeat(), system=7), 0) == []


def test_states_come_ten_times_a_second_at_most_and_after_a_clock_jumped_back() -> None:
    telemetry, stamps = Telemetry(), []
    for t_ms in range(0, 2000, 4):
        stamps += [s.t_ns for s in telemetry.feed(packed(heartbeat()), t_ms * 1_000_000)]
    assert stamps == [t_ms * 1_000_000 for t_ms in range(0, 2000, 100)]
    assert len(telemetry.feed(packed(heartbeat()), 5)) == 1


def test_mavlink_1_is_read_as_well() -> None:
    data = packed(v1.MAVLink_heartbeat_message(2, 3, 0x81, 5, 4, 3), dialect=v1)
    assert data[0] == 0xFE
    (state,) = Telemetry().feed(data, 5)
    assert (state.t_ns, state.system, state.armed, state.mode) == (5, 1, True, "LOITER")
    assert MavlinkVehicle().scale is TimeScale.ARRIVAL


# Damage


@given(st.lists(st.tuples(st.binary(max_size=30), st.booleans()), max_size=10), st.integers(1, 200))
def test_whole_messages_survive_stray_bytes_between_them(parts: list[tuple[bytes, bool]], chunk: int) -> None:
    """Stray bytes hold no marker here: one may hold back the message behind it until more arrives."""
    data, sent, stray = b"", 0, 0
    for noise, whole in parts:
        noise = noise.translate(None, b"\xfd\xfe")
        data, stray = data + noise, stray + len(noise)
        if whole:
            data, sent = data + packed(heartbeat()), sent + 1
    telemetry = Telemetry()
    for at in range(0, len(data), chunk):
        telemetry.feed(data[at : at + chunk], at)
    assert telemetry.counts.frames["HEARTBEAT"] == sent
    assert telemetry.counts.dropped_bytes == stray


@given(st.binary(max_size=2000), st.sampled_from(Stamps), st.integers(1, 300))
def test_any_bytes_are_accounted_for(data: bytes, stamps: Stamps, chunk: int) -> None:
    vehicle = MavlinkVehicle(stamps=stamps)
    for at in range(0, len(data), chunk):
        vehicle.feed(data[at : at + chunk], at)
    assert vehicle.counts.received_bytes == len(data)
    assert vehicle.counts.dropped_bytes <= len(data)


def test_a_false_marker_costs_no_message_that_follows_it() -> None:
    for false in (b"\xfd", b"\xfe\xff", b"\xfd\x40\x00\x00\x00\x01\x01\x1e\x00\x00", b"\xfd\xff\x01"):
        telemetry = Telemetry()
        telemetry.feed(false + packed(*[heartbeat()] * 30), 0)
        assert telemetry.counts.frames["HEARTBEAT"] == 30
        assert telemetry.counts.dropped_bytes == len(false)


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**32 - 1), st.integers(0, 255), st.integers(0, 255))
def test_any_stamp_and_any_mode_is_survived(t_us: int, custom_mode: int, base_mode: int, autopilot: int) -> None:
    frame = packed(heartbeat(base_mode, custom_mode, autopilot))
    for state in MavlinkVehicle(system=1, stamps=Stamps.TLOG).feed(struct.pack(">Q", t_us) + frame, 0):
        assert isinstance(state, VehicleState)
        assert abs(state.t_ns) < 2**63
