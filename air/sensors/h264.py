"""Camera frames ⇄ H.264, one access unit a frame: no frame waits for another, and a key frame begins each second."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import av
import numpy as np
from av.error import FFmpegError

from common.arrays import U8
from common.measurements import CameraFrame, Encoding

KEY_FRAME_EVERY = 30


class H264Encoder:
    """Turns the pixels of one camera into H.264; a change of size begins anew."""

    def __init__(self, crf: int) -> None:
        """`crf` is x264's quality: 0 loses nothing, 51 nearly everything."""
        self._crf = crf
        self._context: Any = None
        self._size = (0, 0)

    def encode(self, frame: CameraFrame) -> CameraFrame:
        """The frame (mono8 or bgr8, of even width and height) as an access unit. Raises ValueError for another."""
        if frame.width % 2 or frame.height % 2:
            raise ValueError(f"H.264 needs an even width and height, not {frame.width} x {frame.height} px")
        if self._size != (frame.width, frame.height):
            self._context, self._size = self._open(frame), (frame.width, frame.height)
        pixels = "gray" if frame.encoding is Encoding.MONO8 else "bgr24"
        image = av.VideoFrame.from_ndarray(image_of(frame), format=pixels)
        return replace(frame, encoding=Encoding.H264, data=b"".join(map(bytes, self._context.encode(image))))

    def _open(self, frame: CameraFrame) -> Any:
        context: Any = av.CodecContext.create("libx264", "w")
        context.width, context.height = frame.width, frame.height
        context.pix_fmt, context.time_base, context.thread_count = "yuv420p", Fraction(1, 30), 1
        context.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "crf": str(self._crf),
            "g": str(KEY_FRAME_EVERY),
        }
        return context


class H264Decoder:
    """Turns the access units of one camera back into pixels."""

    def __init__(self) -> None:
        self._context = self._open()

    def decode(self, frame: CameraFrame) -> CameraFrame | None:
        """The frame as bgr8, or None when it is damaged or those before it are missing."""
        try:
            images = self._context.decode(av.Packet(frame.data))
        except FFmpegError:
            self._context = self._open()
            return None
        # Rather no frame than one that hides its errors: mapping would believe it.
        good = [image for image in images if not image.is_corrupt]
        if not good:
            return None
        pixels = good[-1].to_ndarray(format="bgr24")
        height, width = pixels.shape[:2]
        return replace(frame, width=width, height=height, encoding=Encoding.BGR8, data=pixels.tobytes())

    def _open(self) -> Any:
        context: Any = av.CodecContext.create("h264", "r")
        context.thread_count = 1  # several would hold frames back
        return context


def image_of(frame: CameraFrame) -> U8:
    """Pixels of a raw frame: (height, width) uint8 for mono8, (height, width, 3) for bgr8."""
    shape = (frame.height, frame.width) if frame.encoding is Encoding.MONO8 else (frame.height, frame.width, 3)
    return np.frombuffer(frame.data, np.uint8).reshape(shape)
