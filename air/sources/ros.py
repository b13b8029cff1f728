"""Standard messages of ROS 1 and 2 as our measurements: images, IMU, positions."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from PIL import Image

from common.arrays import F64
from common.errors import SourceError
from common.measurements import CameraFrame, Encoding, FixKind, ImuSample, Measurement, ReceiverSolution

_TO_GREY_OR_BGR: Mapping[str, tuple[int, list[int]]] = {
    "mono8": (1, [0]),
    "8UC1": (1, [0]),
    "bgr8": (3, [0, 1, 2]),
    "8UC3": (3, [0, 1, 2]),
    "rgb8": (3, [2, 1, 0]),
    "bgra8": (4, [0, 1, 2]),
    "rgba8": (4, [2, 1, 0]),
}
"""Channels of an encoding, and which of them are ours, in our order."""
_FILES = {"PNG": Encoding.PNG, "JPEG": Encoding.JPEG}
_KINDS = {0: FixKind.FIX_3D, 1: FixKind.DIFFERENTIAL, 2: FixKind.DIFFERENTIAL}


def image(message: Any, camera: str, t_ns: int) -> CameraFrame:
    """The frame of a sensor_msgs/Image as grey or BGR. Raises SourceError for another encoding or a wrong size."""
    if message.encoding not in _TO_GREY_OR_BGR:
        raise SourceError(f"encoding {str(message.encoding)[:20]!r}; read are {', '.join(_TO_GREY_OR_BGR)}")
    channels, ours = _TO_GREY_OR_BGR[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8)
    if width < 1 or height < 1 or step < width * channels or len(data) < step * height:
        raise SourceError("size and data of an image do not fit together")
    rows = data[: step * height].reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    encoding = Encoding.MONO8 if len(ours) == 1 else Encoding.BGR8
    return CameraFrame(t_ns, camera, 0, width, height, encoding, rows[..., ours].tobytes())


def compressed_image(message: Any, camera: str, t_ns: int) -> CameraFrame:
    """The frame of a sensor_msgs/CompressedImage, its file as it is. Raises SourceError for no JPEG or PNG."""
    data = bytes(message.data)
    try:
        with Image.open(io.BytesIO(data)) as opened:
            (width, height), kind = opened.size, str(opened.format)
    except Exception as error:  # Pillow raises nearly every built-in exception on damaged headers.
        raise SourceError(f"a compressed image is unreadable ({type(error).__name__})") from error
    if kind not in _FILES:
        raise SourceError(f"a compressed image is {kind}; read are JPEG and PNG")
    return CameraFrame(t_ns, camera, 0, width, height, _FILES[kind], data)


def imu(message: Any, _device: str, t_ns: int) -> ImuSample:
    """The sample of a sensor_msgs/Imu, in the frame of its header. Raises SourceError where a value is not finite.

    An orientation is taken where the message claims one: a unit quaternion whose covariance does not begin with −1.
    """
    accel, gyro = _vector(message.linear_acceleration), _vector(message.angular_velocity)
    if not np.isfinite([accel, gyro]).all():
        raise SourceError("a sample is not finite")
    q, covariance = message.orientation, message.orientation_covariance
    wxyz = np.array([q.w, q.x, q.y, q.z], float)
    claimed = covariance[0] > 0 and math.isfinite(norm := float(np.linalg.norm(wxyz))) and abs(norm - 1) < 1e-3
    return ImuSample(t_ns, accel=accel, gyro=gyro, q_enu_body=wxyz * (-1 if wxyz[0] < 0 else 1) if claimed else None)


def fix(message: Any, receiver: str, t_ns: int) -> ReceiverSolution:
    """The position of a sensor_msgs/NavSatFix, NaN for accuracies that it does not know."""
    variance = np.asarray(message.position_covariance, float)
    known = message.position_covariance_type > 0
    sigma = np.sqrt(np.maximum(variance[[0, 4, 8]], 0.0)) if known else np.full(3, np.nan)
    return ReceiverSolution(
        t_ns=t_ns,
        receiver=receiver,
        kind=_KINDS.get(int(message.status.status), FixKind.NONE),
        latitude_deg=float(message.latitude),
        longitude_deg=float(message.longitude),
        height=float(message.altitude),
        sigma_horizontal=float(np.hypot(sigma[0], sigma[1]) / math.sqrt(2)),
        sigma_vertical=float(sigma[2]),
        v_enu=np.full(3, np.nan),
        sigma_velocity=math.nan,
        sigma_time=math.nan,
        satellites=0,
    )


def _vector(v: Any) -> F64:
    return np.array([v.x, v.y, v.z], float)


CONVERTERS: Mapping[str, Callable[[Any, str, int], Measurement | None]] = {
    "Image": image,
    "CompressedImage": compressed_image,
    "Imu": imu,
    "NavSatFix": fix,
}
"""By the last part of the type's name. A converter takes the message, the device's name and the stamp, GPST ns."""
