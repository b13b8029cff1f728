"""The simulated telemetry of a DJI drone, read by the driver."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from air.sensors.mavlink import MavlinkVehicle
from air.sources.simulated.clocks import ClockOptions, Device, DeviceClock
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.simulated.motion.multirotor import fly
from air.sources.simulated.telemetry import MavlinkOptions, SimulatedTelemetry
from common.counts import Counts
from common.geo import geodetic_to_enu
from common.mavlink import PacketScanner, PacketWriter
from common.measurements import FixKind, VehicleState
from common.messages import Datum
from common.se3 import quaternion_to_matrix, rotation_angle

DATUM = Datum("2024-06-01T09-00-00-test", 30.5355, 114.3655, 62.0)
SECONDS = 150.0
TRAJECTORY, MISSION = fly(FlightOptions(width=12.0, length=20.0), 1, SECONDS, np.array([5.0, 6.0, 2.0]))


def simulated(options: MavlinkOptions, seed: int = 1, clock: ClockOptions = ClockOptions()) -> SimulatedTelemetry:  # noqa: B008
    bridge = DeviceClock.draw(clock, seed, Device.VEHICLE, SECONDS)
    return SimulatedTelemetry(TRAJECTORY, MISSION, DATUM, options, seed, bridge)


def states(options: MavlinkOptions) -> list[VehicleState]:
    driver = MavlinkVehicle()
    return [s for t, d in simulated(options).packets() for s in driver.feed(d, round(t * 1e9))]  # type: ignore[misc]


def test_a_drone_that_knows_all_tells_the_truth() -> None:
    seen = [s for s in states(MavlinkOptions.perfect()) if s.latitude_deg is not None and s.q_enu_body is not None]
    t_s = np.array([s.t_ns for s in seen]) * 1e-9
    motion = TRAJECTORY.at(t_s)
    p = geodetic_to_enu(DATUM, [s.latitude_deg for s in seen], [s.longitude_deg for s in seen], 62.0)
    # Positions come every 0.2 s, at 3 m/s, in steps of a centimetre.
    assert np.abs(p[:, :2] - motion.p_world[:, :2]).max() < 0.75
    heights = np.array([s.height_home for s in seen], float)
    np.testing.assert_allclose(heights, motion.p_world[:, 2] - 2.0, atol=0.25)
    velocities = np.array([s.v_enu for s in seen])
    assert np.abs(velocities - motion.v_world).max() < 0.45
    for state, R in list(zip(seen, motion.R_world_body, strict=True))[::20]:
        assert state.q_enu_body is not None
        assert rotation_angle(R.T @ quaternion_to_matrix(state.q_enu_body)) < 0.12  # told every 0.1 s, 60 °/s
    assert all(s.height_msl is None for s in seen)


def test_errors_are_of_their_size() -> None:
    seen = [s for s in states(MavlinkOptions()) if s.latitude_deg is not None]
    t_s = np.array([s.t_ns for s in seen]) * 1e-9
    p = geodetic_to_enu(DATUM, [s.latitude_deg for s in seen], [s.longitude_deg for s in seen], 62.0)
    error = p[:, :2] - TRAJECTORY.at(t_s).p_world[:, :2]
    assert 0.3 < np.sqrt(np.mean(error**2)) < 2.5  # two or three independent values alone


def test_modes_follow_the_mission_and_the_battery_empties() -> None:
    seen = states(MavlinkOptions.perfect())
    modes = [s.mode for s in seen if s.mode is not None]
    assert list(dict.fromkeys(modes)) == ["LOITER", "GUIDED", "AUTO", "RTL", "LAND"]
    assert {s.armed for s in seen} == {True, False}
    assert {s.fix for s in seen if s.fix} == {FixKind.FIX_3D}
    levels = [s.battery for s in seen if s.battery is not None]
    assert levels == sorted(levels, reverse=True)
    assert 0.8 < levels[-1] < levels[0] <= 1.0


def test_messages_come_at_the_bridges_rates_with_its_habits() -> None:
    counts, packets = Counts(), []
    scanner = PacketScanner(counts)
    for _, data in simulated(MavlinkOptions.perfect()).packets():
        packets += scanner.feed(data)
    rates = {name: count / SECONDS for name, count in counts.frames.items()}
    expected = {"ATTITUDE": 10, "ALTITUDE": 10, "GLOBAL_POSITION_INT": 5, "GPS_RAW_INT": 10 / 3, "HEARTBEAT": 1}
    for name, hz in expected.items():
        assert rates[name] == pytest.approx(hz, rel=0.02)
    assert rates["HOME_POSITION"] == pytest.approx(0.2, rel=0.05)
    assert {p.message.time_boot_ms for p in packets if p.name == "ATTITUDE"} == {0}
    assert all(p.message.alt == p.message.relative_alt for p in packets if p.name == "GLOBAL_POSITION_INT")
    numbers = [p.message.get_seq() for p in packets]
    assert all((b - a) % 256 == 1 for a, b in pairwise(numbers))


def test_the_same_flight_gives_the_same_bytes_and_loss_loses_some() -> None:
    packets = list(simulated(MavlinkOptions()).packets())
    assert packets == list(simulated(MavlinkOptions()).packets())
    assert packets != list(simulated(MavlinkOptions(), seed=2).packets())
    times = [t for t, _ in packets]
    assert times == sorted(times)
    every = len(list(simulated(MavlinkOptions.perfect()).packets()))
    assert 0.9 < len(list(simulated(MavlinkOptions(lost=0.05)).packets())) / every < 0.98


def test_a_writer_fills_with_zeros_and_refuses_what_is_unknown() -> None:
    data = PacketWriter(system=7).pack("BATTERY_STATUS", battery_remaining=40)
    (packet,) = PacketScanner(Counts()).feed(data)
    assert (packet.system, packet.message.battery_remaining, packet.message.voltages) == (7, 40, [0] * 10)
    with pytest.raises(TypeError):
        PacketWriter().pack("ATTITUDE", lean=1.0)
    with pytest.raises(AttributeError):
        PacketWriter().pack("ATTITUDES")
