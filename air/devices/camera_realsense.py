"""The colour camera of a RealSense (D455) through pyrealsense2, which is imported when such a camera is configured."""

from __future__ import annotations

from typing import Any

from air.devices.settings import CameraConfig
from air.sensors.camera import Counter, Shot
from air.sensors.driver import TimeScale
from common.errors import DeviceError
from common.measurements import Encoding

READ_MS = 2000


class RealsenseCapture:
    """Colour frames, stamped by the device in the middle of the exposure (its metadata `sensor_timestamp`, µs)."""

    scale = TimeScale.DEVICE

    def __init__(self, config: CameraConfig) -> None:
        """Opens the camera. Raises DeviceError: what is wrong and what to do."""
        try:
            import pyrealsense2
        except ImportError as error:
            text = "needs pyrealsense2; install luojia[realsense], or name its /dev/videoN"
            raise DeviceError(f"{config.device}: {text}") from error
        self._rs: Any = pyrealsense2
        settings = self._rs.config()
        if serial := config.device.partition(":")[2]:
            settings.enable_device(serial)
        rate_hz = round(config.rate_hz)
        settings.enable_stream(self._rs.stream.color, config.width, config.height, self._rs.format.bgr8, rate_hz)
        self._pipeline = self._rs.pipeline()
        try:
            self._pipeline.start(settings)
        except RuntimeError as error:
            text = f"cannot be opened with {config.width}×{config.height} at {rate_hz} Hz: {error}"
            raise DeviceError(f"{config.device}: {' '.join(text.split())}") from error
        self._counter = Counter(32)

    def read(self) -> Shot | None:
        """The next frame, stamped in ns of the camera's clock; None for one without its metadata.

        Raises OSError when the camera is gone, or gives nothing for two seconds.
        """
        try:
            frame = self._pipeline.wait_for_frames(READ_MS).get_color_frame()
        except RuntimeError as error:
            raise OSError(" ".join(str(error).split())) from error
        kinds = self._rs.frame_metadata_value
        stamp_us = _metadata(frame, kinds.sensor_timestamp)
        if stamp_us is None:
            return None
        exposure_us, gain = _metadata(frame, kinds.actual_exposure), _metadata(frame, kinds.gain_level)
        return Shot(
            stamp_ns=self._counter.unwrap(stamp_us) * 1000,
            width=frame.get_width(),
            height=frame.get_height(),
            encoding=Encoding.BGR8,
            data=bytes(frame.get_data()),
            exposure_s=None if exposure_us is None else exposure_us * 1e-6,
            gain=gain,
        )

    def close(self) -> None:
        """Let go of the camera."""
        self._pipeline.stop()


def _metadata(frame: Any, kind: Any) -> int | None:
    return int(frame.get_frame_metadata(kind)) if frame.supports_frame_metadata(kind) else None
