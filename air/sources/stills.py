"""Photos out of a video flight: frames far enough apart, each with the receiver's position at its moment.

So whatever has camera frames and a receiver's solutions can be mapped like a folder of photos.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from air.sensors.calibration import Calibration
from air.sources.source import Problem, Sensed, Source, Truth
from common.arrays import F64
from common.geo import T_ecef_enu, ecef_to_geodetic, geodetic_to_ecef
from common.measurements import CameraFrame, Encoding, FixKind, ReceiverSolution, VehicleState
from common.messages import Datum, GnssFix, Photo
from common.se3 import quaternion_to_matrix

STEP = 0.2
"""From photo to photo, of what an image shows along its height: four fifths of it are seen again."""
LOWEST = 10.0
"""Height above the start, m, from which on photos are worth while."""
ORDINARY_FOCAL = 0.8
"""Focal length, image widths, of a camera without calibration."""
STALE_S = 1.0
"""Age of a position beyond which it says nothing about a frame."""
ATTITUDE_SIGMA = float(np.radians(3.0))
"""Of the airframe's attitude at the moment of a frame, rad: telemetry comes late, and a gust tilts quickly."""
SIGMA_PER_S = 0.5
"""How fast a position that is carried on by its velocity gets worse, m/s."""
JPEG_QUALITY = 92
_CHANNELS = {Encoding.BGR8: 3, Encoding.MONO8: 1}


class StillPicker:
    """Chooses the frames of one camera that make photos (core: measurements in, photos out)."""

    def __init__(self, cameras: Mapping[str, Calibration]) -> None:
        self._cameras = cameras
        self._camera: str | None = None
        self._solution: ReceiverSolution | None = None
        self._lowest = np.inf
        self._height_home: float | None = None
        self._R_enu_body: F64 | None = None
        self._last_ecef: F64 | None = None

    def feed(self, measurement: Sensed) -> Photo | None:
        """A photo, when this measurement is a frame that makes one. Measurements come in the order of time."""
        match measurement:
            case ReceiverSolution(receiver=receiver, kind=kind) if receiver != "base" and kind is not FixKind.NONE:
                if np.isfinite(measurement.height):
                    self._solution = measurement
                    self._lowest = min(self._lowest, measurement.height)
            case VehicleState(height_home=height, q_enu_body=q):
                self._height_home = self._height_home if height is None else height
                self._R_enu_body = self._R_enu_body if q is None else quaternion_to_matrix(q)
            case CameraFrame():
                return self._photo(measurement)
        return None

    def _photo(self, frame: CameraFrame) -> Photo | None:
        self._camera = self._camera or frame.camera
        fix = self._fix(frame.t_ns)
        if fix is None or frame.camera != self._camera or (height := self._height(fix)) < LOWEST:
            return None
        calibration = self._cameras.get(frame.camera)
        focal = calibration.camera.fy if calibration is not None else ORDINARY_FOCAL * frame.width
        p_ecef = geodetic_to_ecef(fix.latitude_deg, fix.longitude_deg, fix.height)
        step = STEP * height * frame.height / focal
        if self._last_ecef is not None and np.linalg.norm(p_ecef - self._last_ecef) < step:
            return None
        jpeg = _jpeg(frame)
        if jpeg is None:
            return None
        self._last_ecef = p_ecef
        name = f"{frame.camera}-{frame.index:06d}"
        if calibration is None:
            return Photo(frame.t_ns, name, jpeg, None, fix)
        if self._R_enu_body is None or calibration.T_body_cam is None:
            return Photo(frame.t_ns, name, jpeg, calibration.camera, fix)
        R_enu_cam = self._R_enu_body @ calibration.T_body_cam.R
        return Photo(frame.t_ns, name, jpeg, calibration.camera, fix, R_enu_cam, ATTITUDE_SIGMA)

    def _height(self, fix: GnssFix) -> float:
        """Above the start, m."""
        return fix.height - self._lowest if self._height_home is None else self._height_home

    def _fix(self, t_ns: int) -> GnssFix | None:
        """The position at a time: the latest one, carried on by its velocity."""
        solution = self._solution
        if solution is None or abs(dt_s := (t_ns - solution.t_ns) * 1e-9) > STALE_S:
            return None
        here = Datum("", solution.latitude_deg, solution.longitude_deg, solution.height)
        v_enu = np.nan_to_num(solution.v_enu)
        latitude_deg, longitude_deg, height = (float(x) for x in ecef_to_geodetic(T_ecef_enu(here).apply(v_enu * dt_s)))
        carried = SIGMA_PER_S * abs(dt_s)
        sigmas = (float(np.hypot(s, carried)) for s in (solution.sigma_horizontal, solution.sigma_vertical))
        return GnssFix(latitude_deg, longitude_deg, height, *sigmas)


def _jpeg(frame: CameraFrame) -> bytes | None:
    """The frame as a file that photos come in, or None when it cannot be one by itself."""
    if frame.encoding in (Encoding.JPEG, Encoding.PNG):
        return frame.data
    if frame.encoding not in _CHANNELS:
        return None
    image = np.frombuffer(frame.data, np.uint8).reshape(frame.height, frame.width, _CHANNELS[frame.encoding])
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())


@dataclass(frozen=True)
class Stills:
    """The photos in a source of camera frames and a receiver's solutions."""

    source: Source
    cameras: Mapping[str, Calibration]

    @property
    def url(self) -> str:
        """The URL of the source."""
        return self.source.url

    @property
    def truth(self) -> Truth | None:
        """The truth of the source."""
        return self.source.truth

    @property
    def problems(self) -> Sequence[Problem]:
        """The problems of the source."""
        return self.source.problems

    def __iter__(self) -> Iterator[Photo]:
        picker = StillPicker(self.cameras)
        for measurement in self.source:
            if (photo := picker.feed(measurement)) is not None:
                yield photo


def stills_of(source: Source) -> Stills:
    """The photos in a source, with the calibrations that come with it."""
    known = getattr(source, "known", None)
    cameras = known.cameras if known is not None else getattr(source, "calibrations", {})
    return Stills(source, cameras)
