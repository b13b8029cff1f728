"""Shots of a camera → `CameraFrame`: when the middle of the exposure was, and how it was exposed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from air.sensors.driver import TimeScale
from common.measurements import CameraFrame, Encoding


class StampPoint(StrEnum):
    """What moment of a frame a camera's stamp marks.

    START: the first row begins its exposure (V4L2's flag TSTAMP_SRC_SOE). READOUT: the first row ends its exposure
    (UVC: the first packet of the frame). END: the last row was read (V4L2's TSTAMP_SRC_EOF). MIDDLE: the middle of
    the exposure of the middle row (RealSense's sensor timestamp).
    """

    START = "start"
    READOUT = "readout"
    END = "end"
    MIDDLE = "middle"


@dataclass(frozen=True)
class Shot:
    """What a camera hands out: encoded or plain pixels, the stamp in ns of its clock, exposure and gain where known."""

    stamp_ns: int
    width: int
    height: int
    encoding: Encoding
    data: bytes
    exposure_s: float | None = None
    gain: float | None = None


def mid_exposure_ns(stamp_ns: int, point: StampPoint, exposure_s: float, rows: int, line_time_s: float) -> int:
    """The middle of the exposure of the middle row, in ns of the stamp's clock.

    An unknown exposure is given as 0: what is then wrong is constant with a constant exposure, and part of the time
    offset that `luojia-air calibrate imu-camera` finds. The readout of a global shutter is not known either.
    """
    half_frame_s = 0.5 * (rows - 1) * line_time_s
    after_s = {
        StampPoint.START: half_frame_s + 0.5 * exposure_s,
        StampPoint.READOUT: half_frame_s - 0.5 * exposure_s,
        StampPoint.END: -half_frame_s - 0.5 * exposure_s,
        StampPoint.MIDDLE: 0.0,
    }
    return stamp_ns + round(after_s[point] * 1e9)


class Camera:
    """The driver of a camera: counts its frames, whose stamps it moves to the middle of the exposure."""

    def __init__(
        self, name: str, scale: TimeScale, point: StampPoint, line_time_s: float = 0.0, time_offset_s: float = 0.0
    ) -> None:
        """`time_offset_s` is what calibration found: it is added to every stamp."""
        self._name, self.scale, self._point = name, scale, point
        self._line_time_s, self._offset_ns = line_time_s, round(time_offset_s * 1e9)
        self._index = 0

    def frame(self, shot: Shot) -> CameraFrame:
        """The frame of a shot, stamped in the clock of the shot."""
        t_ns = mid_exposure_ns(shot.stamp_ns, self._point, shot.exposure_s or 0.0, shot.height, self._line_time_s)
        index, self._index = self._index, self._index + 1
        return CameraFrame(
            t_ns=t_ns + self._offset_ns,
            camera=self._name,
            index=index,
            width=shot.width,
            height=shot.height,
            encoding=shot.encoding,
            data=shot.data,
            exposure_s=shot.exposure_s,
            gain=shot.gain,
            line_time_s=self._line_time_s,
        )


class Counter:
    """A counter of `bits` bits that wraps, made into one that does not."""

    def __init__(self, bits: int = 32) -> None:
        self._size = 1 << bits
        self._last: int | None = None

    def unwrap(self, value: int) -> int:
        """The full count, at most half a turn from the one before, the first one as it is."""
        if self._last is None:
            self._last = value
        else:
            half = self._size // 2
            self._last += (value - self._last + half) % self._size - half
        return self._last
