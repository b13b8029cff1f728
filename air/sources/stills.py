"""Photos out of a video flight: frames far enough apart, each with the position and attitude of its moment.

They come from the odometry, once it knows where its world lies, or else from the receiver and the airframe. So whatever
has camera frames and positions can be mapped like a folder of photos.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from air.jump import Jump
from air.sensors.calibration import Calibration
from air.sources.source import Sensed
from common.arrays import F64
from common.geo import T_ecef_enu, ecef_to_geodetic, geodetic_to_ecef
from common.measurements import BASE, CameraFrame, Encoding, FixKind, ReceiverSolution, VehicleState
from common.messages import Datum, GnssFix, Photo, Pose
from common.se3 import SE3, quaternion_to_matrix, rotation_vector, rotation_vector_to_matrix

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
ODOMETRY_SIGMA = float(np.radians(0.5))
"""Of the odometry's attitude with the camera's mounting, rad."""
SILENT_S = 0.3
"""Without a pose for so long the odometry counts as lost."""
SIGMA_PER_S = 0.5
"""How fast a position that is carried on by its velocity gets worse, m/s."""
JPEG_QUALITY = 92
_CHANNELS = {Encoding.BGR8: 3, Encoding.MONO8: 1}


@dataclass(frozen=True, eq=False)
class _Sight:
    """Where a camera was and how it looked: `R_enu_cam` with its sigma rad, or None; as in `Photo`."""

    fix: GnssFix
    R_enu_cam: F64 | None
    sigma: float
    revision: int | None = None


class StillPicker:
    """Chooses the frames of one camera that make photos (core: measurements and poses in, photos out)."""

    def __init__(self, cameras: Mapping[str, Calibration]) -> None:
        self._cameras = dict(cameras)
        self._camera: str | None = None
        self._solution: ReceiverSolution | None = None
        self._lowest = np.inf
        self._height_home: float | None = None
        self._R_enu_body: F64 | None = None
        self._last_ecef: F64 | None = None
        self._datum: Datum | None = None
        self._poses: deque[Pose] = deque(maxlen=2)
        self._waiting: deque[CameraFrame] = deque()

    def feed(self, measurement: Sensed | Datum | Pose | Jump) -> Photo | None:
        """A photo, when this makes one of a frame. Measurements come in the order of time.

        After a `Datum` frames wait for the odometry's poses in its world, as long as such come.
        """
        match measurement:
            case ReceiverSolution(receiver=receiver, kind=kind) if receiver != BASE and kind is not FixKind.NONE:
                if np.isfinite(measurement.height):
                    self._solution = measurement
                    self._lowest = min(self._lowest, measurement.height)
            case VehicleState(height_home=height, q_enu_body=q):
                self._height_home = self._height_home if height is None else height
                self._R_enu_body = self._R_enu_body if q is None else quaternion_to_matrix(q)
            case Datum():
                self._datum = measurement
                self._poses.clear()
            case Jump():
                self._jump(measurement)
            case Pose():
                if self._poses and self._poses[-1].revision != measurement.revision:
                    self._poses.clear()
                self._poses.append(measurement)
                return self._passed()
            case CameraFrame():
                return self._take(measurement)
        return None

    def calibrate(self, camera: str, T_body_cam: SE3, time_offset_s: float) -> None:
        """Use what the flight has told about how a camera sits, and the clock of its frames."""
        if (calibration := self._cameras.get(camera)) is not None:
            self._cameras[camera] = replace(calibration, T_body_cam=T_body_cam, time_offset_s=time_offset_s)

    def _jump(self, jump: Jump) -> None:
        """Bring the latest poses into the new world, so that those to come can follow them."""
        assert self._datum is not None
        T = jump.at(self._datum)
        moved = [replace(p, revision=jump.revision, T_world_body=T @ p.T_world_body) for p in self._poses]
        self._poses = deque(moved, maxlen=2)

    def _take(self, frame: CameraFrame) -> Photo | None:
        self._camera = self._camera or frame.camera
        if frame.camera != self._camera:
            return None
        mounted = self._mounting(frame) is not None
        if mounted and self._poses and self._imu_ns(frame) - self._poses[-1].t_ns < SILENT_S * 1e9:
            self._waiting.append(frame)
            return None
        self._waiting.clear()
        return self._photo(frame, self._received(frame))

    def _passed(self) -> Photo | None:
        """A photo of the frames that the poses have passed by now; the others wait for the next pose."""
        photo = None
        while photo is None and self._waiting and self._imu_ns(self._waiting[0]) <= self._poses[-1].t_ns:
            frame = self._waiting.popleft()
            photo = self._photo(frame, self._estimated(frame))
        return photo

    def _photo(self, frame: CameraFrame, sight: _Sight | None) -> Photo | None:
        if sight is None or (height := self._height(sight.fix)) < LOWEST:
            return None
        fix, calibration = sight.fix, self._cameras.get(frame.camera)
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
        camera = None if calibration is None else calibration.camera
        return Photo(frame.t_ns, name, jpeg, camera, fix, sight.R_enu_cam, sight.sigma, sight.revision)

    def _height(self, fix: GnssFix) -> float:
        """Above the start, m."""
        return fix.height - self._lowest if self._height_home is None else self._height_home

    def _mounting(self, frame: CameraFrame) -> SE3 | None:
        calibration = self._cameras.get(frame.camera)
        return None if calibration is None else calibration.T_body_cam

    def _imu_ns(self, frame: CameraFrame) -> int:
        """When it was taken, by the clock of the IMU."""
        calibration = self._cameras.get(frame.camera)
        return frame.t_ns + (0 if calibration is None else round(calibration.time_offset_s * 1e9))

    def _estimated(self, frame: CameraFrame) -> _Sight | None:
        """By the odometry: between the poses before and after a frame, which are a sample of the IMU apart."""
        T_body_cam = self._mounting(frame)
        if self._datum is None or T_body_cam is None:
            return None
        before, after = self._poses[0], self._poses[-1]
        share = (self._imu_ns(frame) - before.t_ns) / max(after.t_ns - before.t_ns, 1)
        T_world_cam = _between(before.T_world_body, after.T_world_body, min(max(share, 0.0), 1.0)) @ T_body_cam
        T_ecef_world = T_ecef_enu(self._datum)
        p_ecef = T_ecef_world.apply(T_world_cam.t)
        latitude_deg, longitude_deg, height = (float(x) for x in ecef_to_geodetic(p_ecef))
        horizontal, vertical = float(np.hypot(*after.sigma[:2]) / np.sqrt(2)), float(after.sigma[2])
        R_ecef_enu = T_ecef_enu(Datum("", latitude_deg, longitude_deg, height)).R
        fix = GnssFix(latitude_deg, longitude_deg, height, horizontal, vertical)
        return _Sight(fix, R_ecef_enu.T @ T_ecef_world.R @ T_world_cam.R, ODOMETRY_SIGMA, after.revision)

    def _received(self, frame: CameraFrame) -> _Sight | None:
        """By the receiver, its latest position carried on by its velocity, and by the airframe."""
        solution = self._solution
        if solution is None or abs(dt_s := (frame.t_ns - solution.t_ns) * 1e-9) > STALE_S:
            return None
        here = Datum("", solution.latitude_deg, solution.longitude_deg, solution.height)
        v_enu = np.nan_to_num(solution.v_enu)
        latitude_deg, longitude_deg, height = (float(x) for x in ecef_to_geodetic(T_ecef_enu(here).apply(v_enu * dt_s)))
        carried = SIGMA_PER_S * abs(dt_s)
        sigmas = (float(np.hypot(s, carried)) for s in (solution.sigma_horizontal, solution.sigma_vertical))
        fix, T_body_cam = GnssFix(latitude_deg, longitude_deg, height, *sigmas), self._mounting(frame)
        if self._R_enu_body is None or T_body_cam is None:
            return _Sight(fix, None, 0.0)
        return _Sight(fix, self._R_enu_body @ T_body_cam.R, ATTITUDE_SIGMA)


def _between(before: SE3, after: SE3, share: float) -> SE3:
    """The pose a share of the way from one to the next."""
    turn = rotation_vector_to_matrix(share * rotation_vector(before.R.T @ after.R))
    return SE3(before.R @ turn, before.t + share * (after.t - before.t))


def _jpeg(frame: CameraFrame) -> bytes | None:
    """The frame as a file that photos come in, or None when it cannot be one by itself."""
    if frame.encoding in (Encoding.JPEG, Encoding.PNG):
        return frame.data
    if frame.encoding not in _CHANNELS:
        return None
    image = np.frombuffer(frame.data, np.uint8).reshape(frame.height, frame.width, _CHANNELS[frame.encoding])
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
