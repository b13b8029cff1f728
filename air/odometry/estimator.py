"""The estimator: IMU samples, tracked frames and GNSS epochs in, states out.

It begins, adjusts its window at each frame, watches itself, and starts its window anew where it has gone astray.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from air.odometry.companion import History
from air.odometry.degradation import Monitor
from air.odometry.gnss_coupling import GnssCoupling
from air.odometry.gnss_preprocessing import CleanEpoch
from air.odometry.initial import KnownSpeed, Refusal
from air.odometry.initial_prior import Sigmas
from air.odometry.initial_rest import moving
from air.odometry.initialization import Initialization
from air.odometry.mounting import Mounted, Mounting
from air.odometry.preintegration import ImuBuffer, InertialState, Preintegrator, Propagation
from air.odometry.row_times import ideal_points
from air.odometry.settings import OdometrySettings
from air.odometry.sightings import Seen
from air.odometry.tracker import TrackedFrame
from air.odometry.window import Solution, Window
from common.arrays import F64
from common.measurements import ImuSample
from common.messages import Mode
from common.se3 import SE3, level_between

AGAIN = Sigmas(tilt=0.02, yaw=0.02, position=0.5, velocity=0.5, accel_bias=0.05, gyro_bias=0.005)
"""How well the IMU's prediction is known where the window starts anew."""
JOINED = np.diag([1e-3, 1e-3, 1e-3, 1e-4]) ** 2
"""Of where what began anew is placed: the world is where that is."""
HALF_GYRO_NS = 10_000_000
RETRY_S = 5.0
JUMP = 0.1
"""By so many metres the world may move without being told."""
SILENT_S = 1.0
"""Without a frame for so long, an epoch stands in for one that shows nothing."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """The state at a frame; covariance (6, 6) of its pose: rotation rad and position m in body axes.

    `keyframe` is the state at the frame before when that has become a keyframe. A higher `revision` says that the
    world frame has jumped, by `jump` (`T_new_old`) where that is known. `note` tells what happened, if anything did.
    """

    state: InertialState
    covariance: F64
    mode: Mode
    revision: int
    solution: Solution
    keyframe: InertialState | None = None
    note: str = ""
    jump: SE3 | None = None


class Estimator:
    """Odometry of tracked frames. Feed it samples and frames in order of time, and epochs to its `gnss`."""

    def __init__(
        self,
        focal: float = 1.0,
        T_body_cam: SE3 | None = None,
        settings: OdometrySettings | None = None,
        flight: str = "",
        base: F64 | None = None,
    ) -> None:
        """`base` (3,) m, ECEF, is where a base station stands. Without a camera neither its focal length px nor where
        it sits matters."""
        self._settings = settings or OdometrySettings()
        self._focal = focal
        lever_arm = np.array(self._settings.gnss.p_body_antenna)
        self.mounted = Mounted.beforehand(Mounting(T_body_cam or SE3.identity(), lever_arm), self._settings.mounting)
        """What is known of the mounting; it outlives the window."""
        self.buffer = ImuBuffer(self._settings.imu)
        self.gnss = GnssCoupling(self._settings.gnss, self.buffer, flight, base)
        self._integrator = Preintegrator(self._settings.imu)
        self._window: Window | None = None
        self._initialization = self._new_initialization()
        self._monitor = Monitor(self._settings.degradation)
        self._propagation: Propagation | None = None
        self._frame_ns = self._sighted_ns = 0
        self._recent: list[TrackedFrame] = []
        self._repaired_ns = -(10**18)
        self.revision = 0
        self.history: History | None = None
        """Who remembers what leaves the window; set before the flight begins."""

    def _new_initialization(self) -> Initialization:
        return Initialization(self._focal, self.mounted.now.T_body_cam, self.buffer, self._settings)

    @property
    def window(self) -> Window | None:
        """The window; None while there is none."""
        return self._window

    def gyro_bias(self) -> F64:
        """Bias (3,) rad/s of the gyroscope as known now."""
        return np.zeros(3) if self._propagation is None else self._propagation.state.gyro_bias

    # IMU

    def add_imu(self, sample: ImuSample) -> InertialState | None:
        """The state at a sample, by the IMU from the last frame on; None while there is none."""
        if not self.buffer.add(sample) or self._propagation is None:
            return None
        if (sample.t_ns - self._frame_ns) * 1e-9 > self._settings.degradation.alone_s:
            self._propagation = None
            self._lose_window()
            self.revision += 1
            return None
        pieces = self.buffer.between(self._propagation.state.t_ns, sample.t_ns)
        self._propagation.advance(pieces)
        return self._propagation.state

    def set_gravity(self, gravity: float) -> None:
        """Use gravity m/s² as it is at this place; it stays once the estimate has begun.

        In steady flight a hundredth of a m/s² weighs as much as all that tells the scale.
        """
        if self._propagation is None:
            self._settings = replace(self._settings, imu=replace(self._settings.imu, gravity=gravity))
            self._integrator = Preintegrator(self._settings.imu)
            self._initialization.settings = self._settings

    def add_speed(self, speed: KnownSpeed) -> None:
        """Note how fast the aircraft moves: of use where it begins in flight."""
        if self._window is None:
            self._initialization.add_speed(speed)

    # GNSS

    def take_epochs(self) -> list[Estimate]:
        """Estimates that epochs bring about: the world has been found, or the camera is silent."""
        out = []
        for epoch in self.gnss.ready():
            estimate = None
            if self._window is None:
                estimate = self._begin_without_frames(epoch)
            elif epoch.t_ns - self._frame_ns > SILENT_S * 1e9:
                outcome = self.add_frame(blind_frame(epoch.t_ns))
                estimate = outcome if isinstance(outcome, Estimate) else None
            if self._window is not None:
                estimate = self._couple(self._window, epoch) or estimate
            if estimate is not None:
                out.append(estimate)
        return out

    def _couple(self, window: Window, epoch: CleanEpoch) -> Estimate | None:
        if not self.gnss.couple(window, epoch):
            return None
        solution = window.settle()
        if self.gnss.fix(window):
            solution = window.settle()
        self.revision += 1
        self._monitor.found_gnss()
        self._propagate_from(window.state())
        return self._estimate(window, solution, note="the world has been found by GNSS")

    def _begin_without_frames(self, epoch: CleanEpoch) -> Estimate | None:
        if epoch.t_ns - self._sighted_ns < SILENT_S * 1e9:
            return None
        found = self.gnss.start.add(epoch, self.buffer, self._settings.imu)
        if isinstance(found, str):
            self.gnss.why_not = found
            return None
        assert self.gnss.start.datum is not None
        window = self._new_window()
        window.begin(found.state, found.covariance, Seen.nothing())
        self.gnss.join(window, self.gnss.start.datum)
        self._window, self._monitor = window, Monitor(self._settings.degradation, visual=False, gnss=True)
        self._frame_ns = max(self._frame_ns, epoch.t_ns)
        self.revision += 1
        self._propagate_from(found.state)
        return self._estimate(window, Solution(0.0, 0, 0), note="begins in motion, without a camera")

    def _new_window(self) -> Window:
        window = Window(self._focal, self.mounted, self.buffer, self._settings.window, self._settings.imu)
        window.history = self.history
        return window

    def _lose_window(self) -> None:
        """What follows begins from nothing, but for what satellites broadcast and what was learnt of the mounting."""
        if self.history is not None and self._window is not None:
            self.history.ended(self._window)
        self._window, self._initialization = None, self._new_initialization()
        self.gnss.leave()

    def _propagate_from(self, state: InertialState) -> None:
        self._propagation = Propagation(self._integrator, state)
        if (last_ns := self.buffer.last_ns) is not None:
            self._propagation.advance(self.buffer.between(state.t_ns, last_ns))

    # Frames

    def add_frame(self, frame: TrackedFrame) -> Estimate | Refusal:
        """The estimate at a frame that IMU samples cover, or why there is none."""
        if frame.t_ns <= self._frame_ns:
            return Refusal("a frame is older than the last one")
        self._frame_ns = frame.t_ns
        if not frame.blind:
            self._sighted_ns = frame.t_ns
        self._remember(frame)
        return self._begin(frame) if self._window is None else self._continue(self._window, frame)

    def _begin(self, frame: TrackedFrame) -> Estimate | Refusal:
        initial = self._initialization.feed(frame)
        if isinstance(initial, Refusal):
            return initial
        window = self._new_window()
        first = initial.states[0]
        covariance = initial.sigmas.covariance(first.T_world_body.R)
        window.begin(first, covariance, self._points_at(initial.frames[0], first, {}, initial.depth))
        for state, seen in list(zip(initial.states, initial.frames, strict=True))[1:]:
            window.add(seen.t_ns, self._points_at(seen, state, {}, initial.depth), state)
        solution = Solution(0.0, 0, 0)
        if len(initial.states) > 1:
            solution = window.settle()
            if why := self._unsure(window, solution):
                return Refusal(why)
        self._window, self._monitor = window, Monitor(self._settings.degradation)
        note = "begins in motion" if len(initial.states) > 1 else "begins at rest"
        if self._propagation is not None:  # it flew on by the IMU alone
            self._join(window, self._propagation.state)
        self._propagate_from(window.state())
        return self._estimate(window, solution, note=note)

    def _unsure(self, window: Window, solution: Solution) -> str:
        """Why what began in motion is no good yet; empty when it is."""
        s = self._settings
        if solution.failed or solution.points < s.degradation.enough_points:
            return f"only {solution.points} points agree"
        if solution.rms_px > s.window.max_residual_px / 2:
            return f"points miss their places by {solution.rms_px:.1f} px"
        state = window.state()
        travelled = state.T_world_body.R.T @ (state.T_world_body.t - window.state(0).T_world_body.t)
        length = float(np.linalg.norm(travelled))
        along = travelled / max(length, 1e-9)
        sigma = float(np.sqrt(along @ window.pose_covariance[3:, 3:] @ along)) / max(length, 1e-9)
        if not sigma < s.initialization.scale_sigma:
            return f"the scale is known within {100 * sigma:.0f} % so far"
        return ""

    def _join(self, window: Window, before: InertialState) -> None:
        """Place what began anew where the IMU says that the aircraft is."""
        window.move(level_between(window.state().T_world_body, before.T_world_body), JOINED)
        self.revision += 1

    def _continue(self, window: Window, frame: TrackedFrame) -> Estimate | Refusal:
        predicted = window.predict(frame.t_ns)
        still = self._is_still(frame)
        depths = window.depths(predicted)
        usual = float(np.median(list(depths.values()))) if depths else np.inf
        window.add(frame.t_ns, self._points_at(frame, predicted, depths, usual), predicted, still)
        fixed = self.gnss.fix(window)
        solution = window.solve()
        if why := self._astray(window, solution, predicted):
            return self._repair(window, frame, predicted, why)
        jump = self._jump(window, predicted, fixed)
        keyframe = window.state(-2) if window.slide() else None
        self._propagate_from(window.state())
        estimate = self._estimate(window, solution, keyframe, still)
        if jump is None:
            return estimate
        moved = np.linalg.norm(jump.apply(predicted.T_world_body.t) - predicted.T_world_body.t)
        return replace(estimate, jump=jump, note=f"GNSS moves the world by {moved:.2f} m")

    def _jump(self, window: Window, predicted: InertialState, fixed: bool) -> SE3 | None:
        """How GNSS has moved the world at this frame, where it has.

        A camera that followed the ground to this frame does not err by so much: what moved is where the ground lies.
        """
        last, newest = window.frames[-2:]
        followed = window.points.intersection(last.seen.ids.tolist()).intersection(newest.seen.ids.tolist())
        by_codes = self.gnss.places_anew(newest.t_ns) and len(followed) >= self._settings.degradation.enough_points
        moved = np.linalg.norm(window.state().T_world_body.t - predicted.T_world_body.t)
        if moved < JUMP or not (fixed or by_codes):
            return None
        self.revision += 1
        return level_between(predicted.T_world_body, window.state().T_world_body)

    def _estimate(
        self,
        window: Window,
        solution: Solution,
        keyframe: InertialState | None = None,
        still: bool = False,
        note: str = "",
    ) -> Estimate:
        newest, self.mounted = window.frames[-1], window.mounted
        # An aircraft that stands needs no points to know where it is.
        seen = len(window.points.intersection(newest.seen.ids.tolist()))
        points = self._settings.degradation.enough_points if still else seen
        mode = self._monitor.update(newest.t_ns, points, self.gnss.satellites(newest.t_ns))
        return Estimate(window.state(), window.pose_covariance, mode, self.revision, solution, keyframe, note)

    def _points_at(self, frame: TrackedFrame, state: InertialState, depths: dict[int, float], usual: float) -> Seen:
        """What a frame sees, moved from the times of its rows to its own."""
        pieces = self.buffer.between(frame.t_ns - HALF_GYRO_NS, frame.t_ns + HALF_GYRO_NS)
        omega, T_body_cam = pieces.rate - state.gyro_bias, self.mounted.now.T_body_cam
        v_body = state.T_world_body.R.T @ state.v_world + np.cross(omega, T_body_cam.t)
        R = T_body_cam.R.T
        return ideal_points(frame, self._focal, R @ omega, R @ v_body, depths, usual)

    def _remember(self, frame: TrackedFrame) -> None:
        """Keep the frames since just before the time that tells whether the aircraft stands."""
        self._recent.append(frame)
        begin_ns = frame.t_ns - round(self._settings.initialization.still_s * 1e9)
        while self._recent[1:] and self._recent[1].t_ns <= begin_ns:
            self._recent.pop(0)

    def _is_still(self, frame: TrackedFrame) -> bool:
        """Whether the aircraft stood for long enough: over a shorter time slow flight looks alike."""
        s, first_ns = self._settings.initialization, self._recent[0].t_ns
        if frame.t_ns - first_ns < round(s.still_s * 1e9):
            return False
        return not moving(self.buffer.samples(first_ns, frame.t_ns), self._recent, self._focal, s)

    # When it goes wrong

    def _astray(self, window: Window, solution: Solution, predicted: InertialState) -> str:
        """Why a solution cannot be believed; empty when it can."""
        s, state = self._settings, window.state()
        if solution.failed or not np.isfinite(state.T_world_body.t).all():
            return "the window has no solution"
        jump = float(np.linalg.norm(state.v_world - predicted.v_world))
        if jump > s.degradation.velocity_jump:
            return f"the velocity jumps by {jump:.1f} m/s"
        if np.linalg.norm(state.accel_bias) > s.degradation.bias_sigmas * s.imu.accel_bias_sigma:
            return "the accelerometer's bias is impossible"
        if np.linalg.norm(state.gyro_bias) > s.degradation.bias_sigmas * s.imu.gyro_bias_sigma:
            return "the gyroscope's bias is impossible"
        return ""

    def _repair(self, window: Window, frame: TrackedFrame, predicted: InertialState, why: str) -> Estimate | Refusal:
        """Start the window anew from what the IMU predicts; when that fails soon after, from nothing."""
        self._propagate_from(predicted)
        again = (frame.t_ns - self._repaired_ns) * 1e-9 < RETRY_S
        self._repaired_ns = frame.t_ns
        if again or not np.isfinite(predicted.T_world_body.t).all():
            self._lose_window()
            return Refusal(f"begins anew, because {why}")
        state = self._plausible(predicted)
        window.begin(state, AGAIN.covariance(state.T_world_body.R), self._points_at(frame, state, {}, np.inf))
        if self.gnss.datum is not None:
            self.gnss.join(window, self.gnss.datum)
        self._propagate_from(state)
        return self._estimate(window, Solution(0.0, 0, 0), note=f"window started anew: {why}")

    def _plausible(self, state: InertialState) -> InertialState:
        """The state with biases within what the device may have."""
        s = self._settings.imu
        accel = np.clip(state.accel_bias, -s.accel_bias_sigma, s.accel_bias_sigma)
        gyro = np.clip(state.gyro_bias, -2 * s.gyro_bias_sigma, 2 * s.gyro_bias_sigma)
        return replace(state, accel_bias=accel, gyro_bias=gyro)


def blind_frame(t_ns: int) -> TrackedFrame:
    """A frame that shows nothing."""
    none = np.zeros(0)
    return TrackedFrame(t_ns, none.astype(np.int64), np.zeros((0, 2)), np.zeros((0, 3)), none, none.astype(bool), True)
