"""The recorder loses nothing that it need not: not by a kill, not by a full disk, not by what it is sent."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from bus_network import free_endpoint, wait_until
from live_system import Program
from recording_samples import START_NS, flight, frame, imu, stream_of

from air.config import CameraFormat, RecorderConfig
from air.recorder import ROLE, Arrival, Inflow, Recorder
from air.sources.source import open_source
from common.bus import BusConfig, ZenohBus
from common.clock import ManualClock
from common.errors import SourceError
from common.keys import alive_key, message_key, stream_key
from common.measurements import CameraFrame, Encoding, ImuSample
from common.messages import Health, Level, Photo
from common.recording.reader import Recording
from common.streams import HEALTH, RAW_CAMERA, RAW_IMU
from common.wire import decode, encode

GB = 10**9
FLIGHT = [Arrival(*message) for message in flight(100)]
AS_IS = RecorderConfig(camera=CameraFormat.AS_IS)


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock(START_NS)


def recorder_in(folder: Path, clock: ManualClock, config: RecorderConfig = AS_IS, free: int = 100 * GB) -> Recorder:
    return Recorder(folder, "uav1", config, clock.now_ns, lambda _: free)


def test_what_the_bus_brings_is_in_the_file_byte_for_byte(tmp_path: Path, clock: ManualClock) -> None:
    recorder = recorder_in(tmp_path / "new" / "folder", clock)
    recorder.write(FLIGHT)
    recorder.close()
    recording = Recording(recorder.path)
    assert [Arrival(*message) for message in recording.messages()] == FLIGHT
    assert recording.whole
    assert recording.about["vehicle"] == "uav1"
    assert recording.about["start_t_ns"] == str(START_NS)
    assert recording.about["software"].startswith("luojia ")


def test_streams_can_be_left_out_and_strangers_are_counted(tmp_path: Path, clock: ManualClock) -> None:
    recorder = recorder_in(tmp_path, clock, replace(AS_IS, leave_out=("raw/camera", "map/tile")))
    recorder.write([*FLIGHT, Arrival(START_NS, "luojia/@v1/uav1/unheard/of", b"?")])
    recorder.close()
    kept = [a for a in FLIGHT if "/raw/camera" not in a.key and "/map/tile" not in a.key]
    assert [Arrival(*message) for message in Recording(recorder.path).messages()] == kept
    assert recorder.health(0).counts["strangers"] == 1


@pytest.mark.parametrize(("camera", "error"), [(CameraFormat.JPEG, 3.0), (CameraFormat.H264, 4.0)])
def test_camera_frames_are_compressed_and_come_back_as_pictures(
    camera: CameraFormat, error: float, tmp_path: Path, clock: ManualClock
) -> None:
    """Mean error per pixel, of 255: what these qualities do to smooth grey waves, with a margin of two."""
    recorder = recorder_in(tmp_path, clock, RecorderConfig(camera=camera))
    frames = [frame(i) for i in range(40)]
    recorder.write(Arrival(f.t_ns, message_key("uav1", RAW_CAMERA, f), encode(f)) for f in frames)
    recorder.close()
    source = open_source(str(recorder.path))
    back = [item for item in source if isinstance(item, CameraFrame)]
    assert not source.problems
    assert [(f.t_ns, f.index, f.exposure_s) for f in back] == [(f.t_ns, f.index, f.exposure_s) for f in frames]
    assert all(f.encoding is (Encoding.JPEG if camera is CameraFormat.JPEG else Encoding.BGR8) for f in back)
    for before, after in zip(frames, back, strict=True):
        assert np.abs(pixels(before).astype(int) - pixels(after)).mean() < error
    assert recorder.path.stat().st_size < 0.5 * sum(len(f.data) for f in frames)


def pixels(f: CameraFrame) -> np.ndarray:
    if f.encoding is Encoding.JPEG:
        return np.asarray(cv2.imdecode(np.frombuffer(f.data, np.uint8), cv2.IMREAD_COLOR))
    return np.frombuffer(f.data, np.uint8).reshape(f.height, f.width, 3)


def test_frames_of_odd_size_and_compressed_ones_are_kept_too(tmp_path: Path, clock: ManualClock) -> None:
    recorder = recorder_in(tmp_path, clock, RecorderConfig(camera=CameraFormat.H264))
    png = CameraFrame(START_NS, "side", 0, 5, 5, Encoding.PNG, b"a file of its own", None)
    odd = frame(1, 63, 47)
    recorder.write(Arrival(START_NS, message_key("uav1", RAW_CAMERA, f), encode(f)) for f in (png, odd))
    recorder.close()
    first, second = [decode(CameraFrame, m.payload) for m in Recording(recorder.path).messages()]
    assert first == png
    assert (second.encoding, second.width, second.height) == (Encoding.JPEG, 63, 47)


def test_a_disk_that_fills_is_announced_then_the_file_is_closed_whole(tmp_path: Path, clock: ManualClock) -> None:
    free = 10 * GB
    recorder = Recorder(tmp_path, "uav1", AS_IS, clock.now_ns, lambda _: free)

    def second(arrivals: list[Arrival]) -> Health:
        clock.sleep(1.0)
        recorder.write(arrivals)
        return recorder.health(0)

    assert second(FLIGHT[:30]).level is Level.OK
    free = 3 * GB
    warned = second(FLIGHT[30:60])
    assert (warned.level, "3000 MB free" in warned.text) == (Level.DEGRADED, True)
    free = GB // 2
    stopped = second(FLIGHT[60:90])
    assert (stopped.level, "stopped: only 500 MB are free" in stopped.text) == (Level.FAILED, True)
    second(FLIGHT[90:])
    recording = Recording(recorder.path)
    assert [Arrival(*message) for message in recording.messages()] == FLIGHT[:90]
    assert recording.whole


@pytest.fixture
def small_files() -> Iterator[None]:
    """No file may grow beyond 100 kB, as on a disk with no more room."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.usefixtures("small_files")
def test_a_disk_that_refuses_stops_the_recording_and_leaves_it_readable(tmp_path: Path, clock: ManualClock) -> None:
    recorder = recorder_in(tmp_path, clock)
    rng = np.random.default_rng(0)
    sent = []
    for i in range(30):
        noise = replace(frame(i), data=rng.bytes(64 * 48 * 3))
        arrival = Arrival(clock.t_ns, message_key("uav1", RAW_CAMERA, noise), encode(noise))
        clock.sleep(1.0)
        recorder.write([arrival])
        sent.append(arrival)
    recorder.close()
    health = recorder.health(0)
    assert (health.level, "the disk refuses" in health.text) == (Level.FAILED, True)
    recording = Recording(recorder.path)
    kept = [Arrival(*message) for message in recording.messages()]
    assert 5 <= len(kept) < 30
    assert kept == sent[: len(kept)]
    assert [p for p in recording.problems if "ends without its index" not in p] == []


def test_an_older_recording_is_never_overwritten(tmp_path: Path, clock: ManualClock) -> None:
    paths = [recorder_in(tmp_path, clock).path for _ in range(3)]
    assert len(set(paths)) == 3
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(SourceError, match="no recording can be created"):
        recorder_in(tmp_path / "file", clock)


def test_a_queue_that_is_full_drops_and_counts_and_time_never_runs_back() -> None:
    times = iter([5, 3, 9, 8])
    inflow = Inflow(25, lambda: next(times))
    for i in range(3):
        inflow.put(f"k{i}", bytes(10))
    assert (inflow.dropped, [a.key for a in inflow.take(0.0)]) == (1, ["k0", "k1"])
    inflow.put("k3", bytes(10))
    assert [(a.t_ns, a.key) for a in inflow.take(0.0)] == [(9, "k3")]
    assert inflow.take(0.01) == []


# As a process


class Flying:
    """A recorder as a process, and a bus beside it on which samples of the IMU are published at 200 Hz."""

    def __init__(self, folder: Path) -> None:
        endpoint = free_endpoint()
        config = folder / "air.toml"
        config.write_text(f'[recorder]\nconnect = ["{endpoint}"]\nmin_free_mb = 0\nwarn_free_mb = 0\n')
        self.bus = ZenohBus(BusConfig("peer", listen=(endpoint,)))
        self.health: list[Health] = []
        alive = threading.Event()
        self.bus.watch_alive(alive_key("uav1", ROLE), lambda _, there: alive.set() if there else None)
        self.bus.subscribe(
            stream_key("uav1", HEALTH, ROLE), lambda _, payload: self.health.append(decode(Health, payload))
        )
        self.out = folder / "out"
        self.program = Program(["air", "record", "--out", str(self.out), "--config", str(config)], folder / "log")
        assert alive.wait(20.0), self.program.said()
        wait_until(lambda: self.health)

    def publish(self, seconds: float) -> list[bytes]:
        sent, begun_s = [], time.monotonic()
        for i in range(round(200 * seconds)):
            time.sleep(max(0.0, begun_s + i / 200 - time.monotonic()))
            sent.append(encode(imu(i)))
            self.bus.publish(stream_key("uav1", RAW_IMU), sent[-1], RAW_IMU)
        return sent

    @property
    def path(self) -> Path:
        (path,) = self.out.glob("uav1_*.mcap")
        return path

    def recorded(self) -> list[bytes]:
        key = stream_key("uav1", RAW_IMU)
        return [message.payload for message in Recording(self.path).messages() if message.key == key]

    def close(self) -> None:
        self.program.process.kill()
        self.program.process.wait()
        self.bus.close()


@pytest.fixture
def flying(tmp_path: Path) -> Iterator[Flying]:
    system = Flying(tmp_path)
    yield system
    system.close()


def test_a_stopped_recorder_has_everything(flying: Flying) -> None:
    sent = flying.publish(1.5)
    wait_until(lambda: flying.health[-1].counts["messages"] >= len(sent))
    code, _ = flying.program.stop(signal.SIGTERM)
    assert code == 0, flying.program.said()
    assert flying.recorded() == sent
    assert Recording(flying.path).whole
    assert flying.health[-1].level is Level.OK


def test_a_killed_recorder_loses_at_most_the_last_second(flying: Flying) -> None:
    sent = flying.publish(3.3)
    os.kill(flying.program.process.pid, signal.SIGKILL)
    flying.program.process.wait()
    recorded = flying.recorded()
    assert recorded == sent[: len(recorded)]
    assert len(sent) - len(recorded) <= 200, "more than a second of 200 Hz is lost"
    problems = Recording(flying.path).problems
    assert len(problems) == 1
    assert "ends without its index" in problems[0]


def test_a_recorder_that_is_held_up_loses_nothing(flying: Flying) -> None:
    """Half a second without the processor: more frames wait than shared memory holds."""
    big = frame(0, 1280, 720)
    sent: list[bytes] = []

    def film() -> None:
        begun_s = time.monotonic()
        for i in range(60):
            time.sleep(max(0.0, begun_s + i / 30 - time.monotonic()))
            sent.append(encode(replace(big, index=i)))
            flying.bus.publish(message_key("uav1", RAW_CAMERA, big), sent[-1], RAW_CAMERA)

    filming = threading.Thread(target=film)
    filming.start()
    holding = threading.Timer(0.7, os.kill, (flying.program.process.pid, signal.SIGSTOP))
    letting = threading.Timer(1.2, os.kill, (flying.program.process.pid, signal.SIGCONT))
    holding.start()
    letting.start()
    samples = flying.publish(2.0)
    filming.join()
    wait_until(lambda: flying.health[-1].counts["messages"] >= len(samples) + len(sent))
    flying.program.stop()
    assert flying.recorded() == samples
    key = message_key("uav1", RAW_CAMERA, big)
    frames = [decode(CameraFrame, m.payload) for m in Recording(flying.path).messages() if m.key == key]
    assert [f.index for f in frames] == list(range(60))


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_three_minutes_at_full_rate_drop_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "tests/benchmarks/bench_recording.py", "--seconds", "180", "--formats", "jpeg", "--json"]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=True)
    for figures in json.loads(done.stdout).values():
        assert figures["lost"] == 0
        assert figures["differing"] == 0


def test_the_imu_comes_back_from_a_recording_as_a_source(tmp_path: Path, clock: ManualClock) -> None:
    recorder = recorder_in(tmp_path, clock)
    recorder.write(FLIGHT)
    recorder.close()
    source = open_source(str(recorder.path))
    samples = [item for item in source if isinstance(item, ImuSample)]
    assert [s.t_ns for s in samples[1:]] == [imu(i).t_ns for i in range(100)]
    np.testing.assert_array_equal(samples[-1].accel, imu(99).accel)
    assert not source.problems


def test_a_real_flight_comes_back_from_its_recording_unchanged(
    real_data: Callable[[str], Path], tmp_path: Path, clock: ManualClock
) -> None:
    flown = list(open_source(f"euroc:{real_data('euroc_v101_micro')}"))
    recorder = recorder_in(tmp_path, clock)
    for item in flown:
        assert not isinstance(item, Photo)
        recorder.write([Arrival(item.t_ns, message_key("uav1", stream_of(item), item), encode(item))])
    recorder.close()
    source = open_source(f"mcap:{recorder.path}")
    back = list(source)
    assert not source.problems
    assert [type(item) for item in back] == [type(item) for item in flown]
    for before, after in zip(flown, back, strict=True):
        assert not isinstance(before, Photo)
        assert not isinstance(after, Photo)
        assert encode(before) == encode(after)
