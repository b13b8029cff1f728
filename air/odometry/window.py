"""The sliding window: keyframes, points and IMU in one adjustment that is solved at each frame.

Keys: `X(k)` pose of the body in world, `V(k)` its velocity, `B(k)` the biases of the IMU at frame k, `L(i)` a point,
`MOUNTING` the corrections of where camera and antenna sit. Source: S. Leutenegger et al., Keyframe-based
visual–inertial odometry using nonlinear optimization (2015); the two ways to marginalize are those of T. Qin et al.,
VINS-Mono (2018), section VI-C.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X

from air.odometry.adjustment import Adjusted, Problem, adjust, equations_of
from air.odometry.companion import Companion, History
from air.odometry.initial_prior import initial_prior
from air.odometry.landmarks import View, depths, locate, misses
from air.odometry.mounting import MOUNTING, Mounted
from air.odometry.parallax import parallax
from air.odometry.preintegration import ImuBuffer, InertialState, Preintegrator, from_pose3, to_pose3
from air.odometry.quadratic import Quadratic, by_world, carried, variable
from air.odometry.settings import ImuSettings, WindowSettings
from air.odometry.sightings import Lens, Seen, Sightings
from common.arrays import F64, I64
from common.se3 import SE3

noise = gtsam.noiseModel
WEAK = 100.0
"""Sigma of the prior of a point, in distances of the point: many such priors together must not hold the scale."""
SETTLING = 6
STILL_SPEED, STILL_TURN, STILL_SHIFT = 0.05, 0.002, 0.005
"""How far the aircraft moves while it stands, m/s, rad and m."""


@dataclass(eq=False)
class Frame:
    """A frame in the window."""

    k: int
    t_ns: int
    seen: Seen
    motion: gtsam.PreintegratedCombinedMeasurements | None = None
    still: bool = False


@dataclass(frozen=True)
class Solution:
    """What one solution found: `rms_px` of all observations, how many points and iterations."""

    rms_px: float
    points: int
    iterations: int
    failed: bool = False


class Window:
    """About ten keyframes and the newest frame. Add a frame, solve, slide."""

    def __init__(
        self, focal: float, mounted: Mounted, imu: ImuBuffer, settings: WindowSettings, imu_settings: ImuSettings
    ) -> None:
        self._focal, self._imu = focal, imu
        self.mounted = mounted
        """What is known of the mounting."""
        self._lens = Lens(focal, settings.pixel_sigma, mounted.nominal)
        self._settings, self._imu_settings = settings, imu_settings
        self.preintegrator = Preintegrator(imu_settings)
        self.values = gtsam.Values()
        self.frames: list[Frame] = []
        self.points: set[int] = set()
        self.companion: Companion | None = None
        self.history: History | None = None
        self._anchored: set[int] = set()
        self._prior: Quadratic | None = None
        self._covariance = np.eye(6)
        self._adjusted: Adjusted | None = None

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
        return depths(self.positions(), state.T_world_body @ self.mounted.now.T_body_cam)

    # Frames

    def begin(self, state: InertialState, covariance: F64, seen: Seen) -> None:
        """Start anew from a first frame whose state is known within a covariance (15, 15), as `Sigmas` have it.

        What has been learnt of the mounting stays.
        """
        if self.history is not None and self.frames:
            self.history.ended(self)
        k = self.frames[-1].k + 1 if self.frames else 0
        self.values, self.frames, self.points, self._anchored = gtsam.Values(), [], set(), set()
        self._insert(k, state)
        self.values.insert(MOUNTING, self.mounted.u)
        self.frames.append(Frame(k, state.t_ns, seen))
        self._prior = initial_prior(k, state, covariance, self._imu_settings).beside(self.mounted.prior())
        self._covariance, self._adjusted = covariance[:6, :6], None

    def predict(self, t_ns: int, index: int = -1) -> InertialState:
        """Where the state of a frame, by default of the newest, leads to by the IMU."""
        state = self.state(index)
        return self.preintegrator.predict(state, self._imu.between(state.t_ns, t_ns))

    def add(self, t_ns: int, seen: Seen, state: InertialState | None = None, still: bool = False) -> None:
        """Add the newest frame, at the state that the IMU predicts unless one is given, and locate new points."""
        state = state or self.predict(t_ns)
        last = self.frames[-1]
        frame = Frame(last.k + 1, t_ns, seen, self._motion(last, t_ns), still)
        self._insert(frame.k, state)
        self.frames.append(frame)
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
        now = self.mounted.now
        poses = [from_pose3(self.values.atPose3(X(frame.k))) @ now.T_body_cam for frame in self.frames]
        seen = [frame.seen for frame in self.frames]
        return [View(T, s.ids, s.corrected(now, self._focal)) for T, s in zip(poses, seen, strict=True)]

    def _ids(self) -> I64:
        return np.array(sorted(self.points), np.int64)

    def _locate(self) -> None:
        s, candidates = self._settings, np.setdiff1d(self.frames[-1].seen.ids, self._ids())
        limit = s.max_residual_px
        found = locate(self._views(), candidates, self._focal, np.radians(s.min_angle_deg), limit)
        for i, p_world in found.items():
            self.values.insert(L(i), p_world)
            self.points.add(i)

    def _forget(self, ids: Iterable[int]) -> None:
        """Remove points with all that was seen of them."""
        gone = np.array(sorted(ids), np.int64)
        for frame in self.frames:
            frame.seen = frame.seen.without(gone)
        for i in gone.tolist():
            self._drop(i)

    def _drop(self, i: int) -> None:
        self.points.discard(i)
        if i not in self._anchored:
            self.values.erase(L(i))

    def _drop_lonely(self) -> None:
        """Points that a single frame sees have no place, until another one sees them too."""
        free = np.array(sorted(self.points - self._anchored), np.int64)
        times = sum((np.isin(free, frame.seen.ids).astype(int) for frame in self.frames), np.zeros(len(free), int))
        for i in free[times < 2].tolist():
            self._drop(i)

    # Solution

    def solve(self) -> Solution:
        """Adjust everything in the window; what turns out to be an outlier leaves."""
        try:
            iterations = self._adjust()
        except np.linalg.LinAlgError:
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
        if self.history is not None:
            self.history.moving(self)
        self._prior = self._prior.carried(T_new_world, covariance)
        moving = [key for f in self.frames for key in (X(f.k), V(f.k))] + [L(i) for i in self.points]
        for key in moving:
            self.values.update(key, carried(key, variable(self.values, key), T_new_world))
        newest = X(self.frames[-1].k)
        J = by_world(newest, variable(self.values, newest), T_new_world.t)
        self._covariance = self._covariance + J @ covariance @ J.T

    def _adjust(self) -> int:
        """Iterations that it took."""
        adjusted = adjust(self._problem(), self.values, self._settings.iterations)
        self._adjusted, self.values, self._covariance = adjusted, adjusted.values, adjusted.pose_covariance
        self.mounted = self.mounted.told(self.values.atVector(MOUNTING), adjusted.mounting_covariance)
        return adjusted.iterations

    def covariance_of(self, key: int) -> F64:
        """Covariance (D, D) of a companion's variable in the last solution.

        Raises LinAlgError where it is undetermined, KeyError where it was not there.
        """
        if self._adjusted is None:
            raise KeyError(key)
        return self._adjusted.covariance_of(key)

    def _problem(self) -> Problem:
        known = self._known()
        frames = [key for f in self.frames for key in (V(f.k), B(f.k), X(f.k))]
        anchored = [L(i) for i in self._anchored]
        others = {key for one in known for key in one.point}.difference(frames, anchored, [MOUNTING])
        free = self.points - self._anchored
        return Problem(
            inertial=self._inertial(self.frames),
            sightings=self._sightings(self.frames, free, self.points - free),
            known=known,
            chain=sorted(others),
            poses=[X(f.k) for f in self.frames],
            held=self.mounted.held,
        )

    def _known(self) -> list[Quadratic]:
        """What is known as quadratic functions."""
        assert self._prior is not None
        return [self._prior, *(self.companion.terms(self) if self.companion is not None else [])]

    def _inertial(self, frames: list[Frame]) -> gtsam.NonlinearFactorGraph:
        """What the IMU felt from frame to frame."""
        graph = gtsam.NonlinearFactorGraph()
        for a, b in pairwise(frames):
            graph.add(gtsam.CombinedImuFactor(X(a.k), V(a.k), X(b.k), V(b.k), B(a.k), B(b.k), b.motion))
            if b.still:
                graph.add(gtsam.PriorFactorVector(V(b.k), np.zeros(3), noise.Isotropic.Sigma(3, STILL_SPEED)))
                stay = noise.Diagonal.Sigmas(np.repeat([STILL_TURN, STILL_SHIFT], 3))
                graph.add(gtsam.BetweenFactorPose3(X(a.k), X(b.k), gtsam.Pose3(), stay))
        return graph

    def _sightings(self, frames: list[Frame], free: set[int], kept: set[int], weak: float = 1.0) -> Sightings:
        """What frames see of some points: the `free` are eliminated, the `kept` held by `weak` times the usual."""
        order = np.array([*sorted(free), *sorted(kept)], np.int64)
        rank = np.argsort(order)
        seen = [frame.seen.among(order) for frame in frames]
        ids = np.concatenate([s.ids for s in seen])
        p_world = np.array([self.values.atPoint3(L(i)) for i in order.tolist()]).reshape(-1, 3)
        away = np.linalg.norm(p_world - self.values.atPose3(X(self.frames[-1].k)).translation(), axis=1)
        return Sightings(
            lens=self._lens,
            frames=[X(frame.k) for frame in frames],
            points=[L(i) for i in order.tolist()],
            free=len(free),
            frame=np.repeat(np.arange(len(frames)), [len(s.ids) for s in seen]),
            point=rank[np.searchsorted(order[rank], ids)],
            xy=np.concatenate([s.xy for s in seen]),
            rate=np.concatenate([s.rate for s in seen]),
            weak=np.repeat([1.0, weak], [len(free), len(kept)]) * (WEAK * np.maximum(away, 1e-3)) ** -2.0,
        )

    def _reintegrate(self) -> None:
        """Integrate the IMU again where the bias moved too far."""
        for last, frame in zip(self.frames, self.frames[1:], strict=False):
            if self.preintegrator.moved(frame.motion, self.values.atConstantBias(B(last.k))):
                frame.motion = self._motion(last, frame.t_ns)

    def _prune(self) -> float:
        """Drop outliers; the root mean square of the other residuals, px."""
        ids = self._ids()
        p_world = np.array([self.values.atPoint3(L(i)) for i in ids.tolist()]).reshape(-1, 3)
        missed = misses(self._views(), ids, p_world, self._focal)
        far = ~(missed.error <= self._settings.max_residual_px)
        for v in set(missed.view[far].tolist()):
            self.frames[v].seen = self.frames[v].seen.without(missed.id[far & (missed.view == v)])
        self._drop_lonely()
        return float(np.sqrt(np.mean(missed.error[~far] ** 2))) if (~far).any() else 0.0

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
        span_s = (frame.t_ns - last.t_ns) * 1e-9
        if span_s > self._settings.longest_s:
            return True
        if not len(last.seen.ids) and not len(frame.seen.ids):
            return span_s > self._settings.blind_s
        a, b = last.seen.among(frame.seen.ids), frame.seen.among(last.seen.ids)
        if len(a.ids) < self._settings.overlap * max(len(frame.seen.ids), 1):
            return True
        R_world_last, R_world_frame = (self.values.atPose3(X(f.k)).rotation().matrix() for f in (last, frame))
        R_body_cam = self.mounted.now.T_body_cam.R
        R_last_frame = R_body_cam.T @ R_world_last.T @ R_world_frame @ R_body_cam
        return parallax(a, b, R_last_frame, self._focal) > float(np.radians(self._settings.parallax_deg))

    def _drop_second_newest(self) -> None:
        dropped, newest = self.frames.pop(-2), self.frames[-1]
        for key in (X(dropped.k), V(dropped.k), B(dropped.k)):
            self.values.erase(key)
        newest.motion = self._motion(self.frames[-2], newest.t_ns)
        newest.still = newest.still and dropped.still
        self._drop_lonely()

    def _marginalize_oldest(self) -> None:
        oldest = self.frames[0]
        mine = self.points & set(oldest.seen.ids.tolist())
        ended = self.points - set(self.frames[-1].seen.ids.tolist())
        gone = ended & (self._anchored | mine)
        kept = self._to_anchor(mine, ended)
        # What else the oldest saw counts later, with what the next oldest saw of it.
        oldest.seen = oldest.seen.among(np.array(sorted(kept | gone), np.int64))
        self._drop_lonely()
        leaving = [*(L(i) for i in sorted(gone & self._anchored)), V(oldest.k), B(oldest.k), X(oldest.k)]
        assert self._prior is not None
        known = [self._prior]
        if self.companion is not None:
            others, more = self.companion.leaving(oldest.k)
            leaving, known = [*others, *leaving], [*known, *more]
        seen = self._leaving(oldest, gone, kept).linearised(self.values)
        equations = equations_of(self._inertial(self.frames[:2]), seen, known, self.values)
        self._prior, conditional = equations.without(leaving, self.values)
        if self.history is not None:
            self.history.left(self, conditional)
        self._anchored = kept
        self._forget(gone)
        for key in leaving:
            if self.values.exists(key):
                self.values.erase(key)
        self.frames.pop(0)
        self._imu.forget(self.frames[0].t_ns)

    def _leaving(self, oldest: Frame, gone: set[int], kept: set[int]) -> Sightings:
        """What the oldest frame sees, and all frames of the points that leave with it."""
        gone, kept = gone & self.points, kept & set(oldest.seen.ids.tolist())
        ids = np.array(sorted(gone), np.int64)
        others = [Frame(frame.k, frame.t_ns, frame.seen.among(ids)) for frame in self.frames[1:]]
        frames = [oldest, *(frame for frame in others if len(frame.seen.ids))]
        return self._sightings(frames, gone - self._anchored, kept | (gone & self._anchored), weak=0.0)

    def _to_anchor(self, mine: set[int], ended: set[int]) -> set[int]:
        """Points that stay, with what the oldest frame knew of them: those in the prior, and the longest seen."""
        already = self._anchored - ended
        rivals = np.array(sorted(mine - ended - already), np.int64)
        times = sum((np.isin(rivals, frame.seen.ids).astype(int) for frame in self.frames), np.zeros(len(rivals), int))
        longest = rivals[np.argsort(-times, kind="stable")]
        return already | set(longest[: max(0, self._settings.anchored - len(already))].tolist())
