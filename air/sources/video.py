"""A video file as a camera: frames at their presentation times."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import av
import av.container
import av.error
from av.video.stream import VideoStream

from air.sensors.camera import Camera, Shot, StampPoint
from air.sensors.driver import TimeScale
from air.sources.imported import Faults, Imported, one_line, split_options
from common.clock import GPST_MINUS_UTC_NS
from common.errors import SourceError
from common.measurements import CameraFrame, Encoding

OPTIONS = ("camera", "line_time")


def open_video(url: str, rest: str) -> Imported:
    """The frames of `video:FILE`, also `video:FILE?camera=NAME&line_time=SECONDS`.

    A presentation time is taken for the middle of the exposure: nothing in the file says better. Times count from
    the file's creation time, which is UTC, or from 0 where it has none. Raises SourceError.
    """
    path, options = split_options(url, rest, OPTIONS)
    try:
        line_time_s = float(options.get("line_time", "0"))
    except ValueError:
        line_time_s = -1.0
    if not 0.0 <= line_time_s <= 0.01:
        raise SourceError(f"source {url!r}: line_time is {options['line_time']!r}; allowed: 0 to 0.01 s")
    with _opened(url, path):
        pass  # what is wrong with the file is told at once
    camera = options.get("camera", "camera")
    return Imported(url, lambda faults: _frames(url, path, camera, line_time_s, faults))


def _opened(url: str, path: Path) -> av.container.InputContainer:
    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, OSError) as error:
        reason = getattr(error, "strerror", None) or one_line(error)
        raise SourceError(f"source {url!r}: {str(path)!r} cannot be read as a video: {reason}") from error
    if not container.streams.video:
        container.close()
        raise SourceError(f"source {url!r}: {str(path)!r} holds no video")
    return container


def _frames(url: str, path: Path, camera: str, line_time_s: float, faults: Faults) -> Iterator[CameraFrame]:
    shutter = Camera(camera, TimeScale.GNSS, StampPoint.MIDDLE, line_time_s)
    with _opened(url, path) as container:
        stream = container.streams.video[0]
        begin_ns = _creation_ns(container.metadata | stream.metadata)
        for frame in _decoded(container, stream, path.name, faults):
            if frame.pts is None or frame.time_base is None:
                faults.add(path.name, "a frame has no presentation time")
                continue
            image = frame.to_ndarray(format="bgr24")
            height, width = image.shape[:2]
            stamp_ns = begin_ns + round(frame.pts * frame.time_base * 1_000_000_000)
            yield shutter.frame(Shot(stamp_ns, width, height, Encoding.BGR8, image.tobytes()))


def _decoded(
    container: av.container.InputContainer, stream: VideoStream, name: str, faults: Faults
) -> Iterator[av.VideoFrame]:
    """Frames as far as they decode."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except (av.error.FFmpegError, OSError) as error:
            faults.add(name, f"cannot be read to its end: {one_line(error)}")
            return
        try:
            yield from packet.decode()
        except (av.error.FFmpegError, OSError) as error:
            faults.add(name, f"a frame does not decode: {one_line(error)}", f"at {packet.pts}")


def _creation_ns(metadata: dict[str, str]) -> int:
    """GPST of a container's creation time, 0 where there is none that can be believed."""
    try:
        moment = datetime.fromisoformat(metadata["creation_time"])
    except (KeyError, ValueError):
        return 0
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return round(moment.timestamp() * 1e6) * 1000 + GPST_MINUS_UTC_NS if moment.year >= 2000 else 0
