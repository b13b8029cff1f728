"""A recording played as devices, and what `luojia-air run` makes of one."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bus_network import client_of, collect, free_endpoint
from device_ports import wait_for
from live_system import Program

from air.__main__ import main
from air.sources.played import GAP_S, Played
from air.sources.source import Sensed
from common.keys import all_of
from common.measurements import ImuSample
from common.messages import Health, Level, Mode, Photo, Pose
from common.streams import HEALTH, POSE, POSE_IMU
from common.wire import decode


class Recording:
    """A source of samples with these stamps, s, and a photo."""

    url, truth, problems = "test:", None, ()

    def __init__(self, *stamps_s: float) -> None:
        self.stamps_s = stamps_s

    def __iter__(self) -> Iterator[Sensed]:
        yield Photo(0, "a", b"", None, None)
        for t_s in self.stamps_s:
            yield ImuSample(round(t_s * 1e9), np.zeros(3), np.zeros(3))


def arrivals_s(*stamps_s: float, pace: float = 1.0) -> list[float]:
    """When the samples come, s from the first one on."""
    came = [time.monotonic() for _ in Played(Recording(*stamps_s), pace)]
    return [t - came[0] for t in came]


def test_samples_come_when_their_time_has_come() -> None:
    # 0.05 s for a computer that is busy.
    assert arrivals_s(100.0, 100.1, 100.3) == pytest.approx([0.0, 0.1, 0.3], abs=0.05)
    assert arrivals_s(100.0, 100.1, 100.3, pace=2.0) == pytest.approx([0.0, 0.05, 0.15], abs=0.05)


def test_pauses_and_stamps_that_are_off_are_not_waited_for() -> None:
    assert arrivals_s(0.0, 0.1, 0.1 + GAP_S, 0.2 + GAP_S) == pytest.approx([0.0, 0.1, 0.1, 0.2], abs=0.05)
    assert arrivals_s(50.0, 20.0, 50.1, 50.05, 50.2) == pytest.approx([0.0, 0.0, 0.1, 0.1, 0.2], abs=0.05)


def test_a_recording_that_is_closed_ends() -> None:
    played = Played(Recording(0.0, 9.0))
    items = iter(played)
    next(items)
    played.close()
    assert not list(items)


def test_a_computer_that_does_not_keep_up_is_told() -> None:
    now_s = iter(np.arange(0.0, 100.0, 0.7))
    played = Played(Recording(0.0, 0.1, 0.2, 0.3), 1.0, lambda: float(next(now_s)))
    assert len(list(played)) == 4
    (status,) = played.statuses()
    assert "this computer is too slow for the pace" in status.fault


@pytest.mark.slow
def test_run_of_a_recording_publishes_the_poses_of_the_odometry(tmp_path: Path) -> None:
    """On board at the rate of the IMU, for the radio at 10 Hz. GNSS and IMU know their world after some turns."""
    recording = tmp_path / "flight.mcap"
    assert main(["simulate", "sim:plain?duration=60&flight.start=air", "--out", str(recording)]) == 0
    endpoint, config = free_endpoint(), tmp_path / "air.toml"
    config.write_text(f'[bus]\nlisten = ["{endpoint}"]\nconnect = []\nshared_memory = false\n')
    program = Program(["air", "run", "--config", str(config), "--source", str(recording)], tmp_path / "air.log")
    try:
        wait_for(lambda: _listening(endpoint), 20.0)
        bus = client_of(endpoint)
        slow, fast, health = (collect(bus, all_of(s))[0] for s in (POSE, POSE_IMU, HEALTH))
        wait_for(lambda: len(fast) > 1000, 90.0)
        assert program.stop()[0] == 0
    finally:
        program.process.kill()
        program.process.wait()
    for messages, rate_hz in ((fast, POSE_IMU.rate_hz), (slow, POSE.rate_hz)):
        poses = [decode(Pose, payload) for _, payload in messages]
        assert {pose.mode for pose in poses} <= {Mode.GNSS_INERTIAL, Mode.INERTIAL}
        assert np.median(np.diff([pose.t_ns for pose in poses])) == pytest.approx(1e9 / rate_hz, rel=0.06)
    told = {(m := decode(Health, payload)).role: m.level for _, payload in health}
    assert told["recording"] is Level.OK
    assert "odometry" in told
    bus.close()


def _listening(endpoint: str) -> bool:
    try:
        client_of(endpoint).close()
    except Exception:
        return False
    return True
