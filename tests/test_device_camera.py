"""Cameras: when the middle of the exposure was, frames of a capture, one that is lost, and video files."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
from device_ports import wait_for
from hypothesis import given
from hypothesis import strategies as st

from air.devices.camera import CameraReader, open_capture
from air.devices.camera_v4l2 import V4l2Capture
from air.devices.port import Arrival
from air.devices.settings import CameraConfig
from air.devices.status import State
from air.sensors.camera import Counter, Shot, StampPoint, mid_exposure_ns
from air.sensors.driver import TimeScale
from air.sources.source import open_source
from common.errors import DeviceError, SourceError
from common.measurements import CameraFrame, Encoding

MS = 1_000_000


@given(
    start_ns=st.integers(0, 2**62),
    exposure_s=st.floats(0, 0.1),
    rows=st.integers(1, 4000),
    line_time_s=st.floats(0, 5e-5),
)
def test_every_convention_of_a_stamp_gives_the_same_middle(
    start_ns: int, exposure_s: float, rows: int, line_time_s: float
) -> None:
    """One frame whose first row begins its exposure at `start_ns`, stamped in four ways."""
    readout_ns = start_ns + round(exposure_s * 1e9)
    end_ns = start_ns + round((exposure_s + (rows - 1) * line_time_s) * 1e9)
    middle_ns = start_ns + round((exposure_s + (rows - 1) * line_time_s) / 2 * 1e9)
    stamps = {
        StampPoint.START: start_ns,
        StampPoint.READOUT: readout_ns,
        StampPoint.END: end_ns,
        StampPoint.MIDDLE: middle_ns,
    }
    for point, stamp_ns in stamps.items():
        got_ns = mid_exposure_ns(stamp_ns, point, exposure_s, rows, line_time_s)
        assert abs(got_ns - middle_ns) <= 2  # rounded twice


@given(start=st.integers(0, 2**32 - 1), steps=st.lists(st.integers(-(2**31) + 1, 2**31 - 1), max_size=50))
def test_a_counter_that_wraps_is_continued(start: int, steps: list[int]) -> None:
    counter, true = Counter(32), start
    assert counter.unwrap(start) == start
    for step in steps:
        true += step
        assert counter.unwrap(true % 2**32) == true


class FakeCapture:
    """Gives some frames of the host's clock, then is gone."""

    scale = TimeScale.ARRIVAL

    def __init__(self, frames: int, shift_ns: int = 0) -> None:
        self._left, self._shift_ns = frames, shift_ns

    def read(self) -> Shot | None:
        time.sleep(0.01)
        self._left -= 1
        if self._left < 0:
            raise OSError("No such device")
        if self._left == 3:
            return None
        stamp_ns = time.monotonic_ns() - 5 * MS + self._shift_ns
        return Shot(stamp_ns, 64, 48, Encoding.MONO8, bytes(64 * 48), exposure_s=0.004, gain=2.0)

    def close(self) -> None:
        pass


def read_until(
    captures: list[FakeCapture | None], config: CameraConfig, frames: int
) -> tuple[CameraReader, list[Arrival]]:
    """A reader that opens one capture after the other; None is a camera that is not there."""
    got: list[Arrival] = []

    def open_it(_config: CameraConfig) -> FakeCapture:
        capture = captures.pop(0) if captures else None
        if capture is None:
            raise DeviceError("/dev/video0: is not there; is the device plugged in?")
        return capture

    reader = CameraReader(config, got.append, open_it)
    reader.start()
    wait_for(lambda: len(got) >= frames, 5.0)
    return reader, got


def test_frames_are_stamped_in_the_middle_of_their_exposure(tmp_path: Path) -> None:
    calibration = tmp_path / "camera.toml"
    calibration.write_text("width=64\nheight=48\nfx=60.0\nfy=60.0\ncx=32.0\ncy=24.0\nline_time_s=0.0001\n")
    config = CameraConfig("/dev/video0", stamp=StampPoint.START, calibration=str(calibration))
    reader, got = read_until([FakeCapture(20)], config, 10)
    reader.close()
    frame = got[0].measurements[0]
    assert isinstance(frame, CameraFrame)
    assert (frame.width, frame.height, frame.encoding, frame.exposure_s, frame.gain) == (64, 48, "mono8", 0.004, 2.0)
    assert frame.line_time_s == 1e-4
    assert [a.measurements[0].index for a in got[:3] if isinstance(a.measurements[0], CameraFrame)] == [0, 1, 2]
    # Stamped 5 ms before it was read; half of 4 ms exposure and of 47 lines of 0.1 ms later is its middle.
    assert got[0].arrival_ns == frame.t_ns
    assert got[0].scale is TimeScale.ARRIVAL
    assert 0 <= time.monotonic_ns() - frame.t_ns < 5_000 * MS


def test_a_camera_that_was_lost_is_opened_again() -> None:
    reader, _ = read_until([FakeCapture(8), None, None, FakeCapture(1000)], CameraConfig("/dev/video0"), 20)
    status = reader.status()
    reader.close()
    assert status.state is State.ALIVE
    assert status.counts["opened"] == 2
    assert status.counts["refused"] == 1
    assert status.well


def test_stamps_of_another_clock_are_noticed() -> None:
    reader, got = read_until([FakeCapture(1000, shift_ns=10**18)], CameraConfig("/dev/video0"), 3)
    status = reader.status()
    reader.close()
    assert abs(got[0].arrival_ns - time.monotonic_ns()) < 5_000 * MS
    assert "another clock than CLOCK_MONOTONIC" in status.fault


def test_a_camera_that_is_not_there_is_named() -> None:
    with pytest.raises(DeviceError, match=r"/dev/video77: is not there; is the device plugged in"):
        open_capture(CameraConfig("/dev/video77"))
    with pytest.raises(DeviceError, match=r"realsense: (needs pyrealsense2; install luojia\[realsense\]|cannot)"):
        open_capture(CameraConfig("realsense"))


def video(path: Path, codec: str, creation: str | None = None) -> list[int]:
    """A film of 30 frames whose presentation times are uneven, and those times in ms."""
    times_ms = [33 * i + (7 if i % 3 == 1 else 0) for i in range(30)]
    with av.open(str(path), "w") as container:
        if creation:
            container.metadata["creation_time"] = creation
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height = 64, 48
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for i, t_ms in enumerate(times_ms):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 8 * i, np.uint8), format="bgr24")
            frame.pts, frame.time_base = t_ms, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return times_ms


def test_a_video_gives_its_frames_at_their_presentation_times(tmp_path: Path) -> None:
    times_ms = video(tmp_path / "film.mkv", "libx264", "2024-05-01T12:00:00.000000Z")
    frames = list(open_source(f"video:{tmp_path / 'film.mkv'}?camera=nose&line_time=2e-5"))
    assert all(isinstance(frame, CameraFrame) for frame in frames)
    assert [round((frame.t_ns - frames[0].t_ns) / MS) for frame in frames] == times_ms
    first = frames[0]
    assert isinstance(first, CameraFrame)
    assert (first.camera, first.width, first.height, first.line_time_s) == ("nose", 64, 48, 2e-5)
    # 12:00:00 UTC and 18 leap seconds.
    assert abs(first.t_ns - (1_714_564_818 * 10**9)) < 100 * MS
    last = frames[-1]
    assert isinstance(last, CameraFrame)
    assert abs(np.frombuffer(last.data, np.uint8).mean() - 8 * 29) < 6


def test_a_video_that_was_cut_is_read_up_to_the_cut(tmp_path: Path) -> None:
    video(tmp_path / "film.mkv", "mjpeg")
    whole = (tmp_path / "film.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(whole[: len(whole) * 2 // 3])
    frames = list(open_source(f"video:{tmp_path / 'cut.mkv'}"))
    assert 10 <= len(frames) < 30


def test_what_is_no_video_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no film")
    for rest in ("text.mp4", "missing.mp4"):
        with pytest.raises(SourceError, match=f"{rest}.*cannot be read as a video"):
            open_source(f"video:{tmp_path / rest}")
    with pytest.raises(SourceError, match="line_time is 'slow'"):
        open_source(f"video:{tmp_path / 'text.mp4'}?line_time=slow")


def test_a_real_video_is_read(real_data: Callable[[str], Path]) -> None:
    source = iter(open_source(f"video:{real_data('karma') / 'karma.mp4'}"))
    first, second = next(source), next(source)
    assert isinstance(first, CameraFrame)
    assert (first.width, first.height) == (854, 480)
    assert second.t_ns - first.t_ns == pytest.approx(1e9 * 1001 / 30000, abs=1e6)


def test_the_capture_hands_out_jpeg_frames_as_they_come(tmp_path: Path) -> None:
    """FFmpeg's input device is not there on a machine without cameras: a file goes the same way."""
    times_ms = video(tmp_path / "film.mkv", "mjpeg")
    capture = V4l2Capture(CameraConfig(str(tmp_path / "film.mkv")), form="matroska")
    shots = [shot for _ in times_ms if (shot := capture.read())]
    with pytest.raises(OSError, match="no more frames"):
        capture.read()
    capture.close()
    assert [shot.stamp_ns // MS for shot in shots] == times_ms
    assert all(shot.encoding is Encoding.JPEG and shot.data[:2] == b"\xff\xd8" for shot in shots)


class FakeColourFrame:
    def __init__(self, known: dict[str, int]) -> None:
        self._known = known

    def supports_frame_metadata(self, kind: str) -> bool:
        return kind in self._known

    def get_frame_metadata(self, kind: str) -> int:
        return self._known[kind]

    def get_width(self) -> int:
        return 4

    def get_height(self) -> int:
        return 2

    def get_data(self) -> bytes:
        return bytes(range(24))


def fake_realsense(frames: list[FakeColourFrame]) -> SimpleNamespace:
    """As much of pyrealsense2 as the capture uses."""

    def wait_for_frames(_timeout_ms: int) -> SimpleNamespace:
        if not frames:
            raise RuntimeError("Frame didn't arrive\nwithin 2000")
        return SimpleNamespace(get_color_frame=lambda: frames.pop(0))

    nothing = SimpleNamespace(enable_device=lambda _: None, enable_stream=lambda *_: None)
    pipeline = SimpleNamespace(start=lambda _: None, stop=lambda: None, wait_for_frames=wait_for_frames)
    kinds = ("sensor_timestamp", "actual_exposure", "gain_level")
    return SimpleNamespace(
        config=lambda: nothing,
        pipeline=lambda: pipeline,
        stream=SimpleNamespace(color=0),
        format=SimpleNamespace(bgr8=0),
        frame_metadata_value=SimpleNamespace(**{kind: kind for kind in kinds}),
    )


def test_a_realsense_stamps_the_middle_of_the_exposure_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    first = FakeColourFrame({"sensor_timestamp": 2**32 - 10_000, "actual_exposure": 8000, "gain_level": 64})
    wrapped = FakeColourFrame({"sensor_timestamp": 23_333})
    library = fake_realsense([first, FakeColourFrame({}), wrapped])
    monkeypatch.setitem(sys.modules, "pyrealsense2", library)
    capture = open_capture(CameraConfig("realsense:0123"))
    assert capture.scale is TimeScale.DEVICE
    assert capture.read() == Shot((2**32 - 10_000) * 1000, 4, 2, Encoding.BGR8, bytes(range(24)), 0.008, 64)
    assert capture.read() is None  # without metadata
    later = capture.read()
    assert later is not None
    assert later.stamp_ns == (2**32 + 23_333) * 1000
    assert (later.exposure_s, later.gain) == (None, None)
    with pytest.raises(OSError, match="Frame didn't arrive within 2000"):
        capture.read()
    capture.close()
