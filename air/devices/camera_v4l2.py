"""Any V4L2 camera (UVC too) through FFmpeg's input device: frames as the camera encodes them, with the kernel's stamps.

FFmpeg hands the buffer's own time through, which is CLOCK_MONOTONIC, the clock of `time.monotonic_ns`; OpenCV's
VideoCapture gives it in ms alone, and decodes every frame.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import time
from typing import Any

import av
import av.error

from air.devices.settings import CameraConfig
from air.sensors.camera import Shot
from air.sensors.driver import TimeScale
from common.errors import DeviceError
from common.link import explained
from common.measurements import Encoding

OPEN_S, READ_S = 3.0, 2.0
ASK_AGAIN_S = 1.0

# linux/videodev2.h and linux/v4l2-controls.h
_G_CTRL = 0xC008561B
_EXPOSURE_ABSOLUTE = 0x009A0902
_EXPOSURE_UNIT_S = 1e-4
_GAIN = 0x00980913


class V4l2Capture:
    """Frames of /dev/videoN: MJPEG as it comes where the camera has it, else decoded."""

    scale = TimeScale.ARRIVAL

    def __init__(self, config: CameraConfig, form: str = "v4l2") -> None:
        """Opens the device (`form`: FFmpeg's name of the input). Raises DeviceError: what is wrong and what to do."""
        size = {"video_size": f"{config.width}x{config.height}", "framerate": f"{config.rate_hz:g}"}
        try:
            try:
                self._container = av.open(config.device, format=form, options=size | _MJPEG, timeout=(OPEN_S, READ_S))
            except av.error.InvalidDataError:  # no MJPEG: whatever it has
                self._container = av.open(config.device, format=form, options=size, timeout=(OPEN_S, READ_S))
        except (OSError, av.error.FFmpegError) as error:
            raise DeviceError(f"{config.device}: {explained(config.device, error)}") from error
        self._packets = self._container.demux(video=0)
        self._controls = _Controls(config.device)

    def read(self) -> Shot | None:
        """The next frame, stamped in ns of CLOCK_MONOTONIC; None for one that is damaged.

        Raises OSError when the camera is gone, or gives nothing for two seconds.
        """
        try:
            packet = next(self._packets)
            if packet.pts is None or packet.time_base is None:
                raise OSError("the camera gives no more frames")
            return self._shot(packet, round(packet.pts * packet.time_base * 1_000_000_000))
        except (av.error.InvalidDataError, IndexError):
            return None
        except (StopIteration, av.error.FFmpegError) as error:
            raise OSError(*getattr(error, "args", ()) or ("the camera gives no more frames",)) from error

    def close(self) -> None:
        """Let go of the camera."""
        self._controls.close()
        self._container.close()

    def _shot(self, packet: Any, stamp_ns: int) -> Shot:
        codec = packet.stream.codec_context
        exposure_s, gain = self._controls.exposure_and_gain()
        if codec.name == "mjpeg":
            return Shot(stamp_ns, codec.width, codec.height, Encoding.JPEG, bytes(packet), exposure_s, gain)
        image = packet.decode()[0].to_ndarray(format="bgr24")
        height, width = image.shape[:2]
        return Shot(stamp_ns, width, height, Encoding.BGR8, image.tobytes(), exposure_s, gain)


_MJPEG = {"input_format": "mjpeg"}


class _Controls:
    """Exposure and gain as the driver knows them, asked once a second through a handle of its own."""

    def __init__(self, device: str) -> None:
        self._handle: int | None = None
        with contextlib.suppress(OSError):
            self._handle = os.open(device, os.O_RDWR | os.O_NONBLOCK)
        self._asked_s = -float("inf")
        self._known: tuple[float | None, float | None] = (None, None)

    def exposure_and_gain(self) -> tuple[float | None, float | None]:
        """Exposure in s and gain in the driver's units, None where the camera does not tell."""
        if time.monotonic() - self._asked_s > ASK_AGAIN_S:
            self._asked_s = time.monotonic()
            exposure = self._ask(_EXPOSURE_ABSOLUTE)
            self._known = (None if exposure is None else exposure * _EXPOSURE_UNIT_S, self._ask(_GAIN))
        return self._known

    def _ask(self, control: int) -> int | None:
        if self._handle is None:
            return None
        try:
            answer = fcntl.ioctl(self._handle, _G_CTRL, struct.pack("=Ii", control, 0))
        except OSError:
            return None
        return int(struct.unpack("=Ii", answer)[1])

    def close(self) -> None:
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None
