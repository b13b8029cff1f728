"""The sliding window: keyframes, points and IMU in one factor graph that is solved at each frame.

Keys: `X(k)` pose of the body in world, `V(k)` its velocity, `B(k)` the biases of the IMU at frame k, `L(i)` a point.
Source: S. Leutenegger et al., Keyframe-based visual–inertial odometry using nonlinear optimization (2015); the two ways
to marginalize are those of T. Qin et al., VINS-Mono (2018), section VI-C.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Protocol

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X

from air.odometry.adjustment import Unknowns, adjust, covariance_of, equations_of
from air.odometry.initial_prior import initial_prior
from air.odometry.landmarks import View, depths, locate, outliers, rms_px
from air.odometry.preintegration import ImuBuffer, InertialState, Preintegrator, from_pose3, to_pose3
from air.odometry.quadratic import Quadratic, by_world, carried, variable
from air.odometry.settings import ImuSettings, WindowSettings
from common.arrays import F64
from common.se3 import SE3

noise = gtsam.noiseModel
HUBER = 1.345
WEAK = 100.0
"""Sigma of the prior of a point, in distances of the point."""
TRIALS, SETTLING = 5, 6
"""How many undetermined points are removed before a solution is given up."""
STILL_SPEED, STILL_TURN, STILL_SHIFT = 0.05, 0.002, 0.005
"""How far the aircraft moves while it stands, m/s, rad and m."""


@dataclass(eq=False)
class Frame:
    """A frame in the window. `xy` are ideal image points (2,) px by id, moved to where they were at `t_ns`."""

    k: int
    t_ns: int
    xy: dict[int, F64]
    motion: gtsam.PreintegratedCombinedMeasurements | None = None
    still: bool = False
    factors: dict[int, gtsam.NonlinearFactor] = field(default_factory=dict)


@dataclass(frozen=True)
class Solution:
    """What one solution found: `rms_px` of all observations, how many points and iterations."""

    rms_px: float
    points: int
    iterations: int
    failed: bool = False


class Companion(Protocol):
    """Somebody who knows more about the frames in the window, such as GNSS.

    It keeps values of its own keys in `window.values`.
    """

    def terms(self, window: Window) -> list[Quadratic]:
        """What it knows about the frames that the window holds now."""
        ...

    def leaving(self, window: Window, k: int) -> tuple[list[int], list[Quadratic]]:
        """Own keys that leave with frame k, and all that it knows about them and that frame."""
        ...


class Window:
    """About ten keyframes and the newest frame. Add a frame, solve, slide."""

    def __init__(
        self, focal: float, T_body_cam: SE3, imu: ImuBuffer, settings: WindowSettings, imu_settings: ImuSettings
    ) -> None:
        self._focal, self._T_body_cam, self._imu = focal, T_body_cam, imu
        self._settings, self._imu_settings = settings, imu_settings
        self.preintegrator = Preintegrator(imu_settings)
        self.values = gtsam.Values()
        self.frames: list[Frame] = []
        self.points: set[int] = set()
        self.companion: Companion | None = None
        self._anchored: set[int] = set()
        self._prior: Quadratic | None = None
        self._covariance = np.eye(6)
        self._calibration = gtsam.Cal3_S2(focal, focal, 0.0, 0.0, 0.0)
        self._pose_of_camera = to_pose3(T_body_cam)
        pixel = noise.Isotropic.Sigma(2, settings.pixel_sigma)
        self._pixel = noise.Robust.Create(noise.mEstimator.Huber.Create(HUBER), pixel)

    # What is known

    def state(self, index: int = -1) -> InertialState:
        """The state of a frame, by default of the newest."""
        frame = self.frames[index]
        bias = self.values.atConstantBias(B(frame.k))
        pose, v_world = from_pose3(self.values.atPose3(X(frame.k))), self.values.atVector(V(frame.k))
        return InertialState(frame.t_ns, pose, v_world, bias.accelerometer(), bias.gyroscope())

    def state_at(self, t_ns: int) -> InertialState | None:
        """The state at a time that IMU samples cover; None before the first frame."""
        before = [i for i, frame in enumerate(self.frames) if frame.t_ns <= t_ns]
        return self.predict(t_ns, before[-1]) if before else None

    @property
    def pose_covariance(self) -> F64:
        """Covariance (6, 6) of the newest pose: rotation rad and position m, both in body axes."""
        return self._covariance

    def positions(self) -> dict[int, F64]:
        """Points (3,) m in world by id."""
        return {i: self.values.atPoint3(L(i)) for i in sorted(self.points)}

    def depths(self, state: InertialState) -> dict[int, float]:
        """Distance m along the camera's axis of the points, by id, seen from a state; those before the camera."""
        return depths(self.positions(), state.T_world_body @ self._T_body_cam)

    # Frames

    def begin(self, state: InertialState, covariance: F64, xy: dict[int, F64]) -> None:
        """Start anew from a first frame whose state is known within a covariance (15, 15), as `Sigmas` have it."""
        k = self.frames[-1].k + 1 if self.frames else 0
        self.values, self.frames, self.points, self._anchored = gtsam.Values(), [], set(), set()
        self._insert(k, state)
        self.frames.append(Frame(k, state.t_ns, xy))
        self._prior, self._covariance = initial_prior(k, state, covariance, self._imu_settings), covariance[:6, :6]

    def predict(self, t_ns: int, index: int = -1) -> InertialState:
        """Where the state of a frame, by default of the newest, leads to by the IMU."""
        state = self.state(index)
        return self.preintegrator.predict(state, self._imu.between(state.t_ns, t_ns))

    def add(self, t_ns: int, xy: dict[int, F64], state: InertialState | None = None, still: bool = False) -> None:
        """Add the newest frame, at the state that the IMU predicts unless one is given, and locate new points."""
        state = state or self.predict(t_ns)
        last = self.frames[-1]
        frame = Frame(last.k + 1, t_ns, xy, self._motion(last, t_ns), still)
        self._insert(frame.k, state)
        self.frames.append(frame)
        for i in self.points & xy.keys():
            self._observe(frame, i)
        self._locate()

    def _insert(self, k: int, state: InertialState) -> None:
        self.values.insert(X(k), to_pose3(state.T_world_body))
        self.values.insert(V(k), state.v_world)
        self.values.insert(B(k), state.bias)

    def _motion(self, begin: Frame, end_ns: int) -> gtsam.PreintegratedCombinedMeasurements:
        pieces = self._imu.between(begin.t_ns, end_ns)
        return self.preintegrator.integrate(pieces, self.values.atConstantBias(B(begin.k)))

    # Points

    def _views(self) -> list[View]:
        return [View(from_pose3(self.values.atPose3(X(f.k))) @ self._T_body_cam, f.xy) for f in self.frames]

    def _locate(self) -> None:
        s, candidates = self._settings, sorted(self.frames[-1].xy.keys() - self.points)
        limit = s.max_residual * s.pixel_sigma
        found = locate(self._views(), candidates, self._focal, np.radians(s.min_angle_deg), limit)
        for i, p_world in found.items():
            self.values.insert(L(i), p_world)
            self.points.add(i)
            for frame in self.frames:
                if i in frame.xy:
                    self._observe(frame, i)

    def _observe(self, frame: Frame, i: int) -> None:
        frame.factors[i] = gtsam.GenericProjectionFactorCal3_S2(
            frame.xy[i], self._pixel, X(frame.k), L(i), self._calibration, False, False, self._pose_of_camera
        )

    def _forget(self, i: int) -> None:
        """Remove a point with all that was seen of it."""
        for frame in self.frames:
            frame.xy.pop(i, None)
            frame.factors.pop(i, None)
        self._drop(i)

    def _drop(self, i: int) -> None:
        self.points.discard(i)
        if i not in self._anchored:
            self.values.erase(L(i))

    # Solution

    def solve(self) -> Solution:
        """Adjust everything in the window; what turns out to be an outlier leaves."""
        for _ in range(TRIALS):
            try:
                iterations = self._adjust()
                break
            except RuntimeError as error:  # gtsam names an undetermined variable
                if not self._remove_named(str(error)):
                    return Solution(np.inf, len(self.points), 0, failed=True)
            except np.linalg.LinAlgError:
                return Solution(np.inf, len(self.points), 0, failed=True)
        else:
            return Solution(np.inf, len(self.points), 0, failed=True)
        self._reintegrate()
        rms = self._prune()
        return Solution(rms, len(self.points), iterations)

    def settle(self) -> Solution:
        """Solve until nothing changes any more: what has only begun is far from its solution."""
        solution = self.solve()
        for _ in range(SETTLING):
            before, solution = solution, self.solve()
            if solution.failed or (solution.points == before.points and solution.iterations == 1):
                break
        return solution

    def move(self, T_new_world: SE3, covariance: F64) -> None:
        """Turn everything about the vertical and shift it; `covariance` (4, 4) is of the shift m and the turn rad."""
        assert self._prior is not None
        self._prior = self._prior.carried(T_new_world, covariance)
        moving = [key for f in self.frames for key in (X(f.k), V(f.k))] + [L(i) for i in self.points]
        for key in moving:
            self.values.update(key, carried(key, variable(self.values, key), T_new_world))
        newest = X(self.frames[-1].k)
        J = by_world(newest, variable(self.values, newest), T_new_world.t)
        self._covariance = self._covariance + J @ covariance @ J.T

    def _remove_named(self, error: str) -> bool:
        named = re.search(r"Symbol: l(\d+)", error)
        if named is None or int(named[1]) not in self.points or int(named[1]) in self._anchored:
            return False
        self._forget(int(named[1]))
        return True

    def _adjust(self) -> int:
        """Iterations that it took."""
        known = self._known()
        adjusted = adjust(self._graph(), known, self.values, self._unknowns(known), self._settings.iterations)
        self.values, self._covariance = adjusted.values, adjusted.covariance
        return adjusted.iterations

    def covariance_of(self, key: int) -> F64:
        """Covariance (D, D) of a companion's variable. Raises RuntimeError or LinAlgError where it is undetermined."""
        known = self._known()
        return covariance_of(key, self._graph(), known, self.values, self._unknowns(known))

    def _unknowns(self, known: list[Quadratic]) -> Unknowns:
        frames = [key for f in self.frames for key in (V(f.k), B(f.k), X(f.k))]
        anchored = [L(i) for i in self._anchored]
        others = {key for one in known for key in one.point}.difference(frames, anchored)
        return Unknowns(
            points=[L(i) for i in sorted(self.points - self._anchored)],
            chain=sorted(others),
            poses=[X(f.k) for f in self.frames],
        )

    def _known(self) -> list[Quadratic]:
        """What is known beside the factors that gtsam knows."""
        assert self._prior is not None
        return [self._prior, *(self.companion.terms(self) if self.companion is not None else [])]

    def _graph(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for last, frame in zip(self.frames, self.frames[1:], strict=False):
            self._add_motion(graph, last, frame)
        for frame in self.frames:
            for factor in frame.factors.values():
                graph.add(factor)
        for i in sorted(self.points):
            graph.add(self._weak(i))
        return graph

    def _add_motion(self, graph: gtsam.NonlinearFactorGraph, a: Frame, b: Frame) -> None:
        graph.add(gtsam.CombinedImuFactor(X(a.k), V(a.k), X(b.k), V(b.k), B(a.k), B(b.k), b.motion))
        if b.still:
            graph.add(gtsam.PriorFactorVector(V(b.k), np.zeros(3), noise.Isotropic.Sigma(3, STILL_SPEED)))
            stay = noise.Diagonal.Sigmas(np.repeat([STILL_TURN, STILL_SHIFT], 3))
            graph.add(gtsam.BetweenFactorPose3(X(a.k), X(b.k), gtsam.Pose3(), stay))

    def _weak(self, i: int) -> gtsam.NonlinearFactor:
        """So little that it only keeps the system regular: many such priors together must not hold the scale."""
        p_world = self.values.atPoint3(L(i))
        distance = float(np.linalg.norm(p_world - self.values.atPose3(X(self.frames[-1].k)).translation()))
        return gtsam.PriorFactorPoint3(L(i), p_world, noise.Isotropic.Sigma(3, WEAK * max(distance, 1e-3)))

    def _reintegrate(self) -> None:
        """Integrate the IMU again where the bias moved too far."""
        for last, frame in zip(self.frames, self.frames[1:], strict=False):
            if self.preintegrator.moved(frame.motion, self.values.atConstantBias(B(last.k))):
                frame.motion = self._motion(last, frame.t_ns)

    def _prune(self) -> float:
        """Drop outliers; the root mean square of the other residuals, px."""
        s, views, points = self._settings, self._views(), self.positions()
        limit = s.max_residual * s.pixel_sigma
        for v, i in outliers(views, points, self._focal, limit):
            self.frames[v].xy.pop(i)
            self.frames[v].factors.pop(i, None)
        self._drop_lonely()
        return rms_px(views, {i: points[i] for i in self.points & points.keys()}, self._focal)

    def _drop_lonely(self) -> None:
        for i in sorted(self.points - self._anchored):
            if sum(i in frame.factors for frame in self.frames) < 2:
                self._drop(i)
                for frame in self.frames:
                    frame.factors.pop(i, None)

    # Sliding

    def slide(self) -> bool:
        """Make room for the next frame; whether the second newest has become a keyframe.

        Where it adds little, its observations go and the IMU is integrated over it; otherwise the oldest keyframe is
        marginalized once there are enough.
        """
        if len(self.frames) < 3:
            return False
        if not self.is_keyframe(self.frames[-3], self.frames[-2]):
            self._drop_second_newest()
            return False
        if len(self.frames) > self._settings.keyframes:
            self._marginalize_oldest()
        return True

    def is_keyframe(self, last: Frame, frame: Frame) -> bool:
        """The parallax test: whether points moved far enough beyond what turning does, or too few are left."""
        common = sorted(last.xy.keys() & frame.xy.keys())
        if (frame.t_ns - last.t_ns) * 1e-9 > self._settings.longest_s:
            return True
        if not last.xy and not frame.xy:
            return (frame.t_ns - last.t_ns) * 1e-9 > self._settings.blind_s
        if len(common) < self._settings.overlap * max(len(frame.xy), 1):
            return True
        a, b = (np.array([f.xy[i] for i in common]) for f in (last, frame))
        R_a_b = (self._R_world_cam(last).T @ self._R_world_cam(frame)).T
        turned = np.column_stack([a / self._focal, np.ones(len(a))]) @ R_a_b.T
        shift = np.linalg.norm(self._focal * turned[:, :2] / turned[:, 2:] - b, axis=1)
        return bool(np.median(shift) > np.radians(self._settings.parallax_deg) * self._focal)

    def _R_world_cam(self, frame: Frame) -> F64:
        return np.asarray(self.values.atPose3(X(frame.k)).rotation().matrix() @ self._T_body_cam.R)

    def _drop_second_newest(self) -> None:
        dropped, newest = self.frames.pop(-2), self.frames[-1]
        for key in (X(dropped.k), V(dropped.k), B(dropped.k)):
            self.values.erase(key)
        newest.motion = self._motion(self.frames[-2], newest.t_ns)
        newest.still = newest.still and dropped.still
        self._drop_lonely()

    def _marginalize_oldest(self) -> None:
        oldest = self.frames[0]
        ended = self.points - self.frames[-1].xy.keys()
        gone = sorted(ended & (self._anchored | oldest.factors.keys()))
        kept = self._to_anchor(oldest, ended)
        for i in oldest.factors.keys() - kept - set(gone):  # its other observations count later, with the next oldest
            del oldest.factors[i], oldest.xy[i]
        self._drop_lonely()
        leaving = [*(L(i) for i in gone if i in self._anchored), V(oldest.k), B(oldest.k), X(oldest.k)]
        assert self._prior is not None
        known = [self._prior]
        if self.companion is not None:
            others, more = self.companion.leaving(self, oldest.k)
            leaving, known = [*others, *leaving], [*known, *more]
        points = gtsam.Ordering([L(i) for i in gone if i not in self._anchored])
        linear = self._graph_of(oldest, gone).linearize(self.values)
        rest = linear.eliminatePartialSequential(points)[1]
        self._prior = equations_of(rest, known, self.values).without(leaving, self.values)
        self._anchored = kept
        for i in gone:
            self._forget(i)
        for key in leaving:
            if self.values.exists(key):
                self.values.erase(key)
        self.frames.pop(0)
        self._imu.forget(self.frames[0].t_ns)

    def _graph_of(self, oldest: Frame, gone: list[int]) -> gtsam.NonlinearFactorGraph:
        """The factors of the oldest frame, and of points that leave with it."""
        graph, leaving = gtsam.NonlinearFactorGraph(), set(gone)
        self._add_motion(graph, oldest, self.frames[1])
        for i in gone:
            graph.add(self._weak(i))
        for frame in self.frames:
            for i, factor in frame.factors.items():
                if frame is oldest or i in leaving:
                    graph.add(factor)
        return graph

    def _to_anchor(self, oldest: Frame, ended: set[int]) -> set[int]:
        """Points that stay, with what the oldest frame knew of them: those in the prior, and the longest seen."""
        already = self._anchored - ended
        rivals = sorted((oldest.factors.keys() & self.points) - ended - already)
        rivals.sort(key=lambda i: -sum(i in frame.factors for frame in self.frames))
        return already | set(rivals[: max(0, self._settings.anchored - len(already))])
