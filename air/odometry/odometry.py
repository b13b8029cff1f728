"""Camera frames, IMU samples and GNSS epochs in, poses and keyframes out: the odometry of one flight."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import cv2
import numpy as np

from air.alignment.prepare import thumbnail
from air.jump import Jump
from air.odometry.estimator import Estimate, Estimator
from air.odometry.initial import KnownSpeed, Refusal
from air.odometry.mounting import ANTENNA, DELAY, LENS, SHIFT, TURN
from air.odometry.preintegration import InertialState
from air.odometry.settings import OdometrySettings
from air.odometry.tracker import Tracker
from air.sensors.calibration import Calibration
from common.arrays import F64, U8
from common.camera import CameraModel
from common.gravity import normal_gravity
from common.measurements import (
    BASE,
    CameraFrame,
    Encoding,
    FixKind,
    GnssEpoch,
    ImuSample,
    Measurement,
    ReceiverSolution,
)
from common.messages import Datum, EstimatorState, Keyframe, Mode, Photo, Pose
from common.se3 import SE3

Output = Pose | Keyframe | EstimatorState | Datum | Jump
Stage = Callable[[str], AbstractContextManager[None]]
"""What is entered for each of the named parts of the work."""
WAITING = 60
"""Frames that wait for the IMU; older ones are given up."""
MIN_SIGMA_SPEED, UNKNOWN_SIGMA_SPEED = 0.1, 0.5
"""m/s, of what a receiver says: some are confident, some do not tell."""
EVERY_NS = 1_000_000_000
"""Between two `EstimatorState`."""


def unwatched(_: str) -> AbstractContextManager[None]:
    """A stage that nobody watches."""
    return nullcontext()


class Odometry:
    """Feed it measurements in the order in which they came; it answers with what they tell.

    One camera is followed, whose calibration it is given; without one, GNSS and IMU alone tell the motion, and frames
    are refused. `world` is level; its origin and heading are those of the first pose until GNSS has told where it lies:
    from then on it is east, north, up at the `Datum` that is told.
    """

    def __init__(
        self,
        calibration: Calibration | None,
        flight: str,
        settings: OdometrySettings | None = None,
        base: F64 | None = None,
        stage: Stage = unwatched,
    ) -> None:
        """`base` (3,) m, ECEF, is where a base station stands; `stage` watches the parts of the work. Raises ValueError
        for a calibration that does not say where the camera sits on the body."""
        T_body_cam = SE3.identity() if calibration is None else calibration.T_body_cam
        if T_body_cam is None:
            raise ValueError("the calibration lacks T_body_cam")
        self._settings = settings or OdometrySettings()
        self._calibration, self._flight, self._stage = calibration, flight, stage
        self._time_offset_s = 0.0 if calibration is None else calibration.time_offset_s
        self._tracker = None if calibration is None else Tracker(calibration.camera, self._settings.tracker)
        focal = 1.0 if calibration is None else calibration.camera.fx
        self.estimator = Estimator(focal, T_body_cam, self._settings, flight, base)
        self._datum: Datum | None = None
        self._waiting: deque[tuple[int, CameraFrame]] = deque(maxlen=WAITING)
        self._tracked_ns: int | None = None
        self._solved_ns = self._told_ns = -(10**18)
        self._images: deque[tuple[int, U8]] = deque(maxlen=2)
        self._keyframes = 0
        self._mode = Mode.INITIALIZING
        self._sigma = np.zeros(3)
        self.first_ns: int | None = None
        """Of the first frame or IMU sample."""
        self.refused_frames = 0
        self.notes: list[tuple[int, str]] = []
        """What happened when, ns."""

    def feed(self, message: Measurement | Photo) -> list[Output]:
        """A pose for each IMU sample once it has begun; keyframes, and the estimator's state every second."""
        if self.first_ns is None and isinstance(message, CameraFrame | ImuSample):
            self.first_ns = message.t_ns
        if isinstance(message, CameraFrame):
            return self._receive(message)
        if isinstance(message, ImuSample):
            with self._stage("imu"):
                state = self.estimator.add_imu(message)
            poses: list[Output] = [] if state is None else [self._pose(state)]
            return poses + self._frames() + self._epochs()
        if isinstance(message, ReceiverSolution):
            if message.receiver != BASE:
                self._learn(message)
        elif isinstance(message, GnssEpoch):
            self._hear_base(message) if message.receiver == BASE else self.estimator.gnss.add_epoch(message)
        else:
            self.estimator.gnss.add(message)
        return []

    @property
    def in_world(self) -> bool:
        """Whether poses are in the world of the datum now; after a window was lost they may not be, for a while."""
        return self.estimator.window is not None and self.estimator.window.companion is not None

    def _receive(self, frame: CameraFrame) -> list[Output]:
        if self._tracker is None:
            self.refused_frames += 1
            return []
        self._waiting.append((frame.t_ns + round(self._time_offset_s * 1e9), frame))
        return self._frames()

    def _learn(self, solution: ReceiverSolution) -> None:
        """What a receiver's own solution says about gravity and the speed: of use until it has begun."""
        place = (solution.latitude_deg, solution.height)
        if solution.kind is not FixKind.NONE and np.isfinite(place).all():
            self.estimator.set_gravity(normal_gravity(*place))
        if np.isfinite(solution.v_enu[:2]).all():
            sigma = solution.sigma_velocity if np.isfinite(solution.sigma_velocity) else UNKNOWN_SIGMA_SPEED
            speed = float(np.linalg.norm(np.nan_to_num(solution.v_enu)))  # some tell nothing about the vertical
            self.estimator.add_speed(KnownSpeed(solution.t_ns, speed, max(sigma, MIN_SIGMA_SPEED)))

    def _hear_base(self, epoch: GnssEpoch) -> None:
        gnss = self.estimator.gnss
        well = not gnss.base_fault
        gnss.add_base(epoch)
        if gnss.base_fault and well:
            self.notes.append((epoch.t_ns, gnss.base_fault))

    def _frames(self) -> list[Output]:
        """What the waiting frames tell that IMU samples cover by now."""
        out: list[Output] = []
        last_ns = self.estimator.buffer.last_ns
        while self._waiting and last_ns is not None and self._waiting[0][0] <= last_ns:
            out += self._frame(*self._waiting.popleft())
        return out

    def _epochs(self) -> list[Output]:
        """What the waiting GNSS epochs tell that IMU samples cover by now."""
        with self._stage("gnss"):
            estimates = self.estimator.take_epochs()
        return [output for estimate in estimates for output in self._tell(estimate)]

    def _frame(self, t_ns: int, frame: CameraFrame) -> list[Output]:
        assert self._calibration is not None
        assert self._tracker is not None
        camera = self._calibration.camera
        with self._stage("tracker"):
            image = decoded(frame)
            if image is None or image.shape[:2] != (camera.height, camera.width):
                self.refused_frames += 1
                return []
            if self._tracked_ns is not None and t_ns <= self._tracked_ns:
                self.refused_frames += 1
                return []
            gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            line_time_s = frame.line_time_s or self._calibration.line_time_s
            tracked = self._tracker.track(np.asarray(gray, np.uint8), t_ns, self._turn(t_ns), line_time_s)
        self._tracked_ns = t_ns
        if t_ns - self._solved_ns < 0.9e9 / self._settings.rate_hz:
            return []
        self._solved_ns = t_ns
        self._images.append((t_ns, image))
        with self._stage("window"):
            outcome = self.estimator.add_frame(tracked)
        if isinstance(outcome, Refusal):
            self._mode = Mode.INITIALIZING
            return []
        return self._tell(outcome)

    def _turn(self, t_ns: int) -> F64:
        """`R_last_now` (3, 3) of the camera since the last frame, by the gyroscope."""
        if self._tracked_ns is None:
            return np.eye(3)
        R_body = self.estimator.buffer.between(self._tracked_ns, t_ns).turn(self.estimator.gyro_bias())
        R_body_cam = self.estimator.mounted.now.T_body_cam.R
        return R_body_cam.T @ R_body @ R_body_cam

    # What is told

    def _tell(self, estimate: Estimate) -> list[Output]:
        self._mode = estimate.mode
        R = estimate.state.T_world_body.R
        self._sigma = np.sqrt(np.maximum(np.diag(R @ estimate.covariance[3:, 3:] @ R.T), 0.0))
        if estimate.note:
            self.notes.append((estimate.state.t_ns, estimate.note))
        out: list[Output] = []
        if (datum := self.estimator.gnss.datum) is not None and datum is not self._datum:
            self._datum = datum
            out.append(datum)
        if estimate.jump is not None and self._datum is not None:
            out.append(Jump(estimate.state.t_ns, estimate.revision, self._datum, estimate.jump))
        if estimate.keyframe is not None and self._calibration is not None:
            out.append(self._keyframe(estimate.keyframe, self._calibration.camera))
        if estimate.state.t_ns - self._told_ns >= EVERY_NS:
            self._told_ns = estimate.state.t_ns
            out.append(self._state(estimate))
        return out

    def _pose(self, state: InertialState) -> Pose:
        return Pose(
            flight=self._flight,
            t_ns=state.t_ns,
            revision=self.estimator.revision,
            T_world_body=state.T_world_body,
            v_world=state.v_world,
            sigma=self._sigma,
            mode=self._mode,
        )

    def _keyframe(self, state: InertialState, camera: CameraModel) -> Keyframe:
        index, self._keyframes = self._keyframes, self._keyframes + 1
        images, mounting = [image for t_ns, image in self._images if t_ns == state.t_ns], self.estimator.mounted.now
        return Keyframe(
            flight=self._flight,
            index=index,
            revision=self.estimator.revision,
            t_ns=state.t_ns,
            name=f"frame-{state.t_ns}",
            T_world_cam=state.T_world_body @ mounting.T_body_cam,
            camera=with_lens(camera, mounting.lens),
            sigma=self._sigma,
            thumbnail=thumbnail(_rgb(images[0])) if images else b"",
        )

    def _state(self, estimate: Estimate) -> EstimatorState:
        state, mounted, window = estimate.state, self.estimator.mounted, self.estimator.window
        sigma = np.sqrt(np.maximum(np.diag(mounted.covariance), 0.0))
        told = EstimatorState(
            flight=self._flight,
            t_ns=state.t_ns,
            revision=estimate.revision,
            mode=estimate.mode,
            accel_bias=state.accel_bias,
            gyro_bias=state.gyro_bias,
            T_body_cam=mounted.now.T_body_cam,
            time_offset_s=self._time_offset_s + mounted.now.delay_s,
            points=estimate.solution.points,
            satellites=self.estimator.gnss.satellites(state.t_ns),
            reprojection_rms_px=estimate.solution.rms_px,
            lever_arm=mounted.now.p_body_antenna,
            rotation_sigma=sigma[TURN],
            translation_sigma=sigma[SHIFT],
            time_offset_sigma_s=float(sigma[DELAY][0]),
            lever_arm_sigma=sigma[ANTENNA],
        )
        if self._calibration is not None:
            camera = with_lens(self._calibration.camera, mounted.now.lens)
            told = replace(told, lens=np.array([camera.fx, camera.cx, camera.cy]), lens_sigma=sigma[LENS])
        misfit = None if window is None else self.estimator.gnss.misfit(window)
        if misfit is None:
            return told
        return replace(
            told,
            clock_s=misfit.clocks_s,
            clock_drift=misfit.drift,
            code_rms_m=misfit.code,
            carrier_rms_m=misfit.carrier,
            doppler_rms_mps=misfit.rate,
        )


def with_lens(camera: CameraModel, lens: F64) -> CameraModel:
    """The camera with corrections (3,), in px of its horizontal focal length, of that and of its principal point."""
    focal, cx, cy = lens.tolist()
    along_y = camera.fy / camera.fx
    fx, fy = camera.fx + focal, camera.fy + focal * along_y
    return replace(camera, fx=fx, fy=fy, cx=camera.cx + cx, cy=camera.cy + cy * along_y)


def decoded(frame: CameraFrame) -> U8 | None:
    """Pixels (H, W) or (H, W, 3) BGR of a frame; None for damaged ones and for H.264, which its source decodes."""
    data = np.frombuffer(frame.data, np.uint8)
    if frame.encoding in (Encoding.JPEG, Encoding.PNG):
        image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
        return None if image is None else np.asarray(image, np.uint8)
    shape = (frame.height, frame.width) if frame.encoding is Encoding.MONO8 else (frame.height, frame.width, 3)
    if frame.encoding is Encoding.H264 or data.size != int(np.prod(shape)):
        return None
    return data.reshape(shape)


def _rgb(image: U8) -> U8:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB if image.ndim == 2 else cv2.COLOR_BGR2RGB), np.uint8)
