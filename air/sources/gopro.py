"""A GoPro's video with the telemetry in it, opened as `gopro:F.mp4`: frames, IMU and GPS, and what a Karma drone adds.

All stamps are times in the video, put on GNSS time by the GPS in the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np

from air.sources import gopro_karma, gopro_telemetry
from air.sources.gopro_telemetry import Payload, Telemetry
from air.sources.gpmf import Damage, read_series
from air.sources.imported import Faults, Imported, find_file, gpst_of_unix, in_time_order, one_line
from air.sources.source import Sensed
from common.errors import SourceError
from common.measurements import CameraFrame, Encoding

CAMERA = "gopro"


def open_gopro(url: str, rest: str) -> Imported:
    """Frames (BGR), IMU samples, solutions of the receivers and states of a Karma, by time.

    Raises SourceError for a file that is no video.
    """
    path = find_file(url, rest)
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise SourceError(f"source {url!r}: {path.name} holds no video")
    except (av.FFmpegError, ValueError) as error:
        raise SourceError(f"source {url!r}: {path.name} is no readable video: {one_line(error)}") from error
    return Imported(url, partial(_read, path))


def _read(path: Path, faults: Faults) -> Iterator[Sensed]:
    telemetry = read_telemetry(path, faults)
    return in_time_order(
        gopro_telemetry.imu_samples(telemetry),
        gopro_telemetry.solutions(telemetry),
        gopro_karma.solutions(telemetry),
        gopro_karma.vehicle_states(telemetry),
        _frames(path, telemetry, faults),
    )


def read_telemetry(path: Path, faults: Faults) -> Telemetry:
    """The telemetry of a file and the time of its start; empty where it has none."""
    telemetry, damage = Telemetry(), Damage()
    with av.open(str(path)) as container:
        tracks = [stream for stream in container.streams.data if "MET" in stream.metadata.get("handler_name", "")][:1]
        if not tracks:
            faults.add(path.name, "has no GoPro telemetry")
        for packet in _packets(container, tracks, faults):
            if packet.size and packet.pts is not None:
                start_s, duration_s = (float(t * packet.time_base) for t in (packet.pts, packet.duration or 0))
                telemetry.payloads.append(Payload(start_s, duration_s, tuple(read_series(bytes(packet), damage))))
        telemetry.start_ns = start_of_video(telemetry, container.metadata.get("creation_time", ""), faults)
    if damage.dropped_bytes or damage.refused:
        faults.add("telemetry", f"{damage.dropped_bytes} bytes dropped, {damage.refused} series refused")
    return telemetry


def start_of_video(telemetry: Telemetry, creation_time: str, faults: Faults) -> int:
    """GPST of the start of the video, ns: by GPS where it had a fix, else by the camera's own clock."""
    starts_s = gopro_telemetry.utc_of_video(telemetry) or gopro_karma.utc_of_video(telemetry)
    believed = [start_s for start_s in starts_s if 1.2e9 < start_s < 4e9]
    if believed:
        return gpst_of_unix(round(float(np.median(believed)) * 1e9))
    faults.add("gps", "gives no time; stamps follow the camera's own clock")
    try:
        return gpst_of_unix(round(datetime.fromisoformat(creation_time).timestamp() * 1e9))
    except (ValueError, OverflowError):
        return 0


def _frames(path: Path, telemetry: Telemetry, faults: Faults) -> Iterator[CameraFrame]:
    """Frames as they are shown, with the exposure time and the gain that the camera noted for each."""
    exposures, gains = ([float(row[0]) for row in telemetry.rows(key, 1)] for key in ("SHUT", "ISOG"))
    with av.open(str(path)) as container:
        video = container.streams.video[0]
        frames = (frame for packet in _packets(container, [video], faults) for frame in _decoded(packet, faults))
        for index, frame in enumerate(frames):
            yield CameraFrame(
                t_ns=telemetry.start_ns + round(float((frame.pts or 0) * frame.time_base) * 1e9),
                camera=CAMERA,
                index=index,
                width=frame.width,
                height=frame.height,
                encoding=Encoding.BGR8,
                data=frame.to_ndarray(format="bgr24").tobytes(),
                exposure_s=exposures[index] if index < len(exposures) else None,
                gain=gains[index] if index < len(gains) else None,
            )


def _packets(container: Any, streams: list[Any], faults: Faults) -> Iterator[Any]:
    try:
        if streams:
            yield from container.demux(streams)
    except av.FFmpegError as error:
        faults.add("video", f"ends early: {one_line(error)}")


def _decoded(packet: Any, faults: Faults) -> Iterator[Any]:
    try:
        yield from packet.decode()
    except av.FFmpegError as error:
        faults.add("video", f"a packet cannot be decoded: {one_line(error)}")
