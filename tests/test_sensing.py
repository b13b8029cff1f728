"""Devices on virtual ports, through the real `luojia-air run`, onto the bus."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bus_network import client_of, collect
from device_aircraft import Aircraft
from device_ports import wait_for

from common import rtcm
from common.keys import all_of, stream_key
from common.measurements import ClockPhase, ClockState, ImuSample, RawBytes, ReceiverSolution
from common.messages import Health, Level
from common.streams import CLOCK, HEALTH, RAW_BYTES, RAW_GNSS, RAW_IMU, RAW_SOLUTION, RTCM
from common.wire import decode, encode


@pytest.fixture
def aircraft(tmp_path: Path, real_data: Callable[[str], Path]) -> Iterator[Aircraft]:
    """Two ports into which recordings are played at the rate at which they were made."""
    system = Aircraft(tmp_path, real_data("gnss"), real_data("xsens"))
    yield system
    system.close()


def test_run_publishes_its_devices_and_one_that_was_pulled_out_comes_back(aircraft: Aircraft) -> None:
    aircraft.run()
    wait_for(lambda: "gnss" in aircraft.programs[0].said(), 20.0)
    bus = client_of(aircraft.endpoint)
    gnss, _ = collect(bus, all_of(RAW_GNSS))
    raw, _ = collect(bus, all_of(RAW_BYTES))
    health, _ = collect(bus, all_of(HEALTH))

    def newest(role: str) -> Health:
        return [h for _, p in list(health) if (h := decode(Health, p)).role == role][-1]

    def heard(device: str) -> int:
        return sum(decode(RawBytes, payload).device == device for _, payload in list(raw))

    wait_for(lambda: bool(gnss) and len(health) > 5, 20.0)
    wait_for(lambda: newest("gnss").level is newest("imu").level is Level.OK, 10.0)
    code, page = aircraft.check("--once")
    assert code == 0
    assert "told by luojia-air run" in page

    aircraft.imu.unplug()
    wait_for(lambda: newest("imu").level is Level.FAILED, 5.0)
    count = heard("imu")
    aircraft.imu.plug()
    assert wait_for(lambda: heard("imu") > count, 5.0) <= 2.0
    wait_for(lambda: newest("imu").level is Level.OK, 5.0)
    bus.close()


def test_corrections_of_the_ground_reach_the_receiver_whole_and_nothing_else_does(aircraft: Aircraft) -> None:
    aircraft.run()
    wait_for(lambda: "gnss" in aircraft.programs[0].said(), 20.0)
    bus = client_of(aircraft.endpoint)
    correction = rtcm.frame(bytes([0x43, 0x50]) + bytes(60))
    key, written = stream_key("uav1", RTCM), bytearray()

    def arrived() -> bool:
        for data in (b"stray" + correction[:20], correction[20:], correction[:-1] + b"?"):
            bus.publish(key, encode(RawBytes(1, "base", data)), RTCM)
        written.extend(aircraft.gnss.sent_by_host())
        return written.count(correction) > 1

    wait_for(arrived, 10.0)
    assert b"stray" not in written
    assert correction[:-1] + b"?" not in written
    bus.close()


@pytest.mark.slow
def test_run_stamps_the_imu_in_the_time_of_the_receiver(aircraft: Aircraft) -> None:
    """The receiver says its time once a second, so its clock takes 20 s to lock."""
    aircraft.run()
    wait_for(lambda: "gnss" in aircraft.programs[0].said(), 20.0)
    bus = client_of(aircraft.endpoint)
    imu, _ = collect(bus, all_of(RAW_IMU))
    gnss, _ = collect(bus, all_of(RAW_SOLUTION))
    clocks, _ = collect(bus, all_of(CLOCK))
    wait_for(lambda: len(imu) > 500 and len(clocks) > 8, 60.0)
    sample, solution = decode(ImuSample, imu[-1][1]), decode(ReceiverSolution, gnss[-1][1])
    assert 0 < (sample.t_ns - solution.t_ns) * 1e-9 < 1.5  # the recording is 1 s between its epochs
    states = {state.device: state for _, payload in clocks if (state := decode(ClockState, payload))}
    assert {name: state.phase for name, state in states.items()} == dict.fromkeys(("gnss", "imu"), ClockPhase.LOCKED)
    bus.close()


def test_check_opens_the_devices_when_nobody_else_does(aircraft: Aircraft) -> None:
    code, said = aircraft.check("--json")
    told = json.loads(said)
    assert code == 0
    assert told["told_by"].startswith("this program")
    gnss, imu = told["devices"]
    assert (gnss["device"], gnss["state"], gnss["well"]) == ("gnss", "alive", True)
    assert (imu["device"], imu["state"], imu["fault"]) == ("imu", "alive", "")
    assert 0.4 < gnss["rate_hz"] < 2.1  # recorded at 1 Hz
    assert 80 < imu["rate_hz"] < 120  # recorded at 100 Hz


def test_check_names_what_is_wrong_and_fails(tmp_path: Path) -> None:
    system = Aircraft(tmp_path)
    system.gnss.plug()
    garbage = random.Random(5).randbytes(20_000)
    system.play(system.gnss, garbage, 2.0)
    try:
        code, said = system.check("--json")
    finally:
        system.close()
    gnss, imu = json.loads(said)["devices"]
    assert code == 1
    assert "no frame decodes" in gnss["fault"]
    assert "baud" in gnss["fault"]
    assert (imu["state"], imu["fault"]) == (
        "closed",
        "is not there; is the device plugged in, and are the udev rules installed?",
    )
