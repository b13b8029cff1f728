"""Tightly coupled GNSS and IMU without a camera: raw GNSS and IMU samples in, poses out.

A sliding window of keyframes, one for every second or so, joined by pre-integrated IMU measurements; the epochs between
them are one linear factor each. What leaves the window stays as a linear prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from air.gnss.gnss_time import SECOND_NS
from air.odometry.gnss_attitude import InitialAttitude, MeasuredVelocity, find_attitude
from air.odometry.gnss_biases import BiasNode, first_node, needed, next_node, start_values
from air.odometry.gnss_factors import Linearised, antenna_motion, as_factor, linearise, total
from air.odometry.gnss_preprocessing import CleanEpoch, GnssPreprocessor
from air.odometry.gnss_prior import Prior, marginalize, step
from air.odometry.gnss_settings import GnssSettings
from air.odometry.preintegration import ImuBuffer, InertialState, Preintegrator, from_pose3, to_pose3
from air.odometry.settings import ImuSettings
from common.arrays import F64
from common.geo import T_ecef_enu, ecef_to_geodetic
from common.gravity import normal_gravity
from common.measurements import GnssEpoch, ImuSample
from common.messages import Datum
from common.se3 import SE3

BASE = "base"
SIGMA_ANCHOR = 30.0
"""What the first single-point position is worth beside the ranges, m."""
ITERATIONS = 2
GYRO_S = 0.02
"""The rate of turn that swings the antenna is the mean over so long."""


@dataclass(frozen=True, eq=False)
class GnssInertialSettings:
    """A keyframe every `keyframe_s`, `keyframes` in the window; the attitude is sought in the last `initial_s`.

    Pseudoranges place the world for `anchor_s`, and again when the position's sigma has grown by the factor `reanchor`.
    In between, Doppler and carrier alone move the aircraft: what pseudoranges still learn about where the world lies
    would make poses creep by metres, and the map with them.
    """

    gnss: GnssSettings
    imu: ImuSettings
    keyframe_s: float = 1.0
    keyframes: int = 4
    initial_s: float = 12.0
    velocity_every_s: float = 0.5
    anchor_s: float = 15.0
    reanchor: float = 1.5


@dataclass(frozen=True, eq=False)
class GnssInertialPose:
    """State of the body in world (ENU at `datum`) at an epoch; `covariance` (15, 15) of the last keyframe.

    Its columns are rotation and position in body axes, velocity, biases. Until it is `anchored`, the world still moves.
    """

    state: InertialState
    datum: Datum
    covariance: F64
    anchored: bool


@dataclass(eq=False)
class _Keyframe:
    """A keyframe with the epochs after it, each with its pre-integrated way from the keyframe and rate of turn."""

    index: int
    t_ns: int
    epochs: list[tuple[CleanEpoch, gtsam.PreintegratedCombinedMeasurements, F64]]
    node: BiasNode | None = None
    leads_on: gtsam.PreintegratedCombinedMeasurements | None = None


class GnssInertial:
    """Core of the estimator: feed it messages in order of time."""

    def __init__(self, settings: GnssInertialSettings, base: F64 | None = None) -> None:
        """`base` (3,) m, ECEF, is where the base station stands, whose epochs name "base" as their receiver."""
        self._settings = settings
        self.preprocessor = GnssPreprocessor(settings.gnss, base)
        self._lever = np.array(settings.gnss.p_body_antenna)
        self._imu = ImuBuffer(settings.imu)
        self._felt_ns: int | None = None
        self._waiting: list[CleanEpoch] = []
        self._window: _Window | None = None
        self._velocities: list[MeasuredVelocity] = []
        self._near: F64 | None = None
        self.datum: Datum | None = None
        self.why_not = ""

    def feed(self, message: object) -> list[GnssInertialPose]:
        """The poses at the epochs that a message completes; those before initialization are not known."""
        if isinstance(message, ImuSample):
            if self._imu.add(message):
                self._felt_ns = message.t_ns
        elif isinstance(message, GnssEpoch):
            if message.receiver == BASE:
                self.preprocessor.add_base(message)
                return []
            clean = self.preprocessor.clean(message, self._near)
            if isinstance(clean, CleanEpoch):
                if clean.fix is not None:
                    self._near = clean.fix.position
                self._waiting.append(clean)
        else:
            self.preprocessor.add(message)
        poses = []
        while self._waiting and self._felt_ns is not None and self._waiting[0].t_ns <= self._felt_ns:
            epoch = self._waiting.pop(0)
            if self._imu.covers(epoch.t_ns, epoch.t_ns):  # else it was before the IMU began
                poses += self._take(epoch)
        return poses

    def _take(self, epoch: CleanEpoch) -> list[GnssInertialPose]:
        if self._window is None:
            self._initialize(epoch)
            return []
        pose = self._window.take(epoch)
        self._near = self._window.antenna_ecef(pose.state)
        self._imu.forget(self._window.oldest_ns)
        return [pose] if self._window.solved else []

    def _initialize(self, epoch: CleanEpoch) -> None:
        fix, s = epoch.fix, self._settings
        if fix is None or not np.isfinite(fix.velocity).all():
            return
        if self.datum is None:
            self.datum = Datum("gnss-inertial", *ecef_to_geodetic(fix.position).tolist())
        T_ecef_world = T_ecef_enu(self.datum)
        last_ns = self._velocities[-1].t_ns if self._velocities else 0
        if epoch.t_ns - last_ns < s.velocity_every_s * 0.9 * SECOND_NS:
            return
        sigma = np.sqrt(np.diag(T_ecef_world.R.T @ fix.velocity_covariance @ T_ecef_world.R))
        self._velocities.append(MeasuredVelocity(epoch.t_ns, T_ecef_world.R.T @ fix.velocity, sigma))
        oldest_ns = epoch.t_ns - round(s.initial_s * SECOND_NS)
        self._velocities = [v for v in self._velocities if v.t_ns >= oldest_ns]
        self._imu.forget(oldest_ns)
        gravity = normal_gravity(self.datum.latitude_deg, self.datum.height)
        imu_settings = replace(s.imu, gravity=gravity)
        found = find_attitude(self._imu, self._velocities, imu_settings)
        if isinstance(found, str):
            self.why_not = found
            return
        p_antenna = T_ecef_world.inverse().apply(fix.position)
        R = found.state.T_world_body.R
        state = replace(found.state, T_world_body=SE3(R, p_antenna - R @ self._lever))
        self._window = _Window(self._settings, imu_settings, self._imu, self.datum, replace(found, state=state))


class _Window:
    """Keyframes, what joins them, and the prior that those before them left."""

    def __init__(
        self, settings: GnssInertialSettings, imu: ImuSettings, buffer: ImuBuffer, datum: Datum, start: InitialAttitude
    ) -> None:
        self._settings, self._buffer, self._datum = settings, buffer, datum
        self._noise = settings.gnss.noise
        self._preintegrator = Preintegrator(imu)
        self._T_ecef_world = T_ecef_enu(datum)
        self._lever = np.array(settings.gnss.p_body_antenna)
        self._values = gtsam.Values()
        self.solved = False
        self._began_ns = start.state.t_ns
        self._anchor_sigma: float | None = None
        self._links: dict[int, gtsam.LinearContainerFactor] = {}
        self._keyframes = [_Keyframe(0, start.state.t_ns, [])]
        self._covariance = start.covariance
        self._insert(0, start.state)
        self._prior = self._start_prior(start)

    @property
    def oldest_ns(self) -> int:
        """When the oldest keyframe was."""
        return self._keyframes[0].t_ns

    def antenna_ecef(self, state: InertialState) -> F64:
        """Where the antenna is, (3,) m in ECEF."""
        return self._T_ecef_world.apply(state.T_world_body.apply(self._lever))

    def take(self, epoch: CleanEpoch) -> GnssInertialPose:
        """The pose at an epoch, which ends the last keyframe's stretch when it is long enough."""
        anchored = self._is_anchored(epoch.t_ns)
        if anchored:
            epoch = epoch.without_code()
        last = self._keyframes[-1]
        state, measured = self._predict(last, epoch.t_ns)
        pieces = self._buffer.between(epoch.t_ns - round(GYRO_S * SECOND_NS), epoch.t_ns)
        omega = np.average(pieces.gyro, axis=0, weights=pieces.dt_s)
        last.epochs.append((epoch, measured, omega))
        if epoch.t_ns - last.t_ns >= self._settings.keyframe_s * 0.95 * SECOND_NS:
            last.leads_on = measured
            self._keyframes.append(_Keyframe(last.index + 1, epoch.t_ns, []))
            self._insert(last.index + 1, state)
            self._node(last)
            self._solve()
            state = self._state(self._keyframes[-1])
            self._slide()
        return GnssInertialPose(state, self._datum, self._covariance, anchored)

    def _is_anchored(self, t_ns: int) -> bool:
        """Whether pseudoranges have done their work: for long enough, and the position is still as well known."""
        s, sigma = self._settings, float(np.sqrt(np.trace(self._covariance[3:6, 3:6])))
        if self._anchor_sigma is None:
            if t_ns - self._began_ns < s.anchor_s * SECOND_NS:
                return False
            self._anchor_sigma = sigma
        return sigma <= s.reanchor * self._anchor_sigma

    def _predict(self, keyframe: _Keyframe, t_ns: int) -> tuple[InertialState, gtsam.PreintegratedCombinedMeasurements]:
        state = self._state(keyframe)
        measured = self._preintegrator.integrate(self._buffer.between(keyframe.t_ns, t_ns), state.bias)
        nav = measured.predict(gtsam.NavState(to_pose3(state.T_world_body), state.v_world), state.bias)
        return replace(state, t_ns=t_ns, T_world_body=from_pose3(nav.pose()), v_world=nav.velocity()), measured

    def _state(self, keyframe: _Keyframe) -> InertialState:
        k, values = keyframe.index, self._values
        bias = values.atConstantBias(B(k))
        pose, velocity = from_pose3(values.atPose3(X(k))), values.atVector(V(k))
        return InertialState(keyframe.t_ns, pose, velocity, bias.accelerometer(), bias.gyroscope())

    def _insert(self, k: int, state: InertialState) -> None:
        self._values.insert(X(k), to_pose3(state.T_world_body))
        self._values.insert(V(k), state.v_world)
        self._values.insert(B(k), state.bias)

    def _start_prior(self, start: InitialAttitude) -> Prior:
        """What initialization knows of the first keyframe: all but where it is."""
        keep = [0, 1, 2, *range(6, 15)]
        G = np.zeros((15, 15))
        G[np.ix_(keep, keep)] = np.linalg.inv(start.covariance[np.ix_(keep, keep)])
        G[3:6, 3:6] = np.eye(3) / SIGMA_ANCHOR**2
        return Prior.at(Linearised(G, np.zeros(15), 0.0, 0, 0.0), (X(0), V(0), B(0)), self._values)

    def _node(self, keyframe: _Keyframe) -> None:
        """Give a keyframe with epochs its biases: those of the keyframe before while they are new, else the next."""
        epochs = [epoch for epoch, _, _ in keyframe.epochs]
        wanted = needed(epochs, self._noise)
        before = next((k.node for k in reversed(self._keyframes[:-2]) if k.node is not None), None)
        if before is None:
            node, factor = first_node(0, keyframe.t_ns, wanted)
            u = start_values(node)
        elif keyframe.t_ns - before.t_ns < self._settings.gnss.node_s * 0.95 * SECOND_NS:
            keyframe.node = before
            return
        else:
            node, u, factor = next_node(before, self._values.atVector(before.key), keyframe.t_ns, wanted)
        self._values.insert(node.key, u)
        self._links[node.index] = gtsam.LinearContainerFactor(factor, self._values)
        keyframe.node = node

    def _solve(self) -> None:
        nodes = {keyframe.node.key: None for keyframe in self._keyframes if keyframe.node is not None}
        keys = [*nodes, *(symbol(k.index) for k in self._keyframes for symbol in (X, V, B))]
        for iteration in range(ITERATIONS):
            graph = self._graph(self._keyframes, self._keyframes[-2] if iteration == 0 else None)
            self._values, self._covariance = step(graph, self._values, keys)
        self.solved = True

    def _graph(self, keyframes: list[_Keyframe], new: _Keyframe | None) -> gtsam.NonlinearFactorGraph:
        """The prior and all factors that begin at some keyframes; the epochs of a `new` one are not weighted down."""
        graph = gtsam.NonlinearFactorGraph()
        graph.add(self._prior.factor(self._values))
        for keyframe in keyframes:
            k = keyframe.index
            if keyframe.leads_on is not None:
                graph.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), keyframe.leads_on))
            if keyframe.node is not None:
                graph.add(self._gnss(keyframe, keyframe.node, np.inf if keyframe is new else self._noise.robust))
        for index in {keyframe.node.index for keyframe in keyframes if keyframe.node is not None}:
            if index in self._links:
                graph.add(self._links[index])
        return graph

    def _gnss(self, keyframe: _Keyframe, node: BiasNode, robust: float) -> gtsam.LinearContainerFactor:
        k, values = keyframe.index, self._values
        pose, velocity, bias = values.atPose3(X(k)), values.atVector(V(k)), values.atConstantBias(B(k))
        u = values.atVector(node.key)
        parts = []
        for epoch, measured, omega in keyframe.epochs:
            motion = antenna_motion(pose, velocity, bias, measured, self._lever, omega)
            parts.append(linearise(epoch, motion, node, u, self._T_ecef_world, robust))
        return as_factor(total(parts), (X(k), V(k), B(k), node.key), values)

    def _slide(self) -> None:
        """Marginalize the oldest keyframe, and its node when no other needs it."""
        if len(self._keyframes) <= self._settings.keyframes:
            return
        oldest, following = self._keyframes[:2]
        k, node = oldest.index, oldest.node
        leaving = [V(k), B(k), X(k)]
        graph = gtsam.NonlinearFactorGraph()
        graph.add(self._prior.factor(self._values))
        leads_on = oldest.leads_on
        graph.add(gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), leads_on))
        if node is not None:
            graph.add(self._gnss(oldest, node, self._noise.robust))
        if node is not None and following.node is not node:
            leaving.append(node.key)
            for index in (node.index, node.index + 1):
                if index in self._links:
                    graph.add(self._links.pop(index))
        assert following.node is not None
        keys = (X(k + 1), V(k + 1), B(k + 1), following.node.key)
        self._prior = marginalize(graph, self._values, leaving, keys)
        for key in leaving:
            self._values.erase(key)
        self._keyframes.pop(0)
