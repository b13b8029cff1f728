"""What GNSS knows in the sliding window: the epochs between its keyframes, and the biases of the satellites.

A carrier of unknown ambiguity tells the way and not the place. Yet its satellite moves, and as its range changes a
little otherwise from another place, an estimator takes what orbits drift for a position and creeps there by metres. So
each carrier is held to see the antenna along the direction in which it was first seen: places then stay unknown to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from air.gnss.gnss_time import SECOND_NS
from air.gnss.orbit import geometric_range
from air.odometry.gnss_biases import BiasNode, first_node, needed, next_node
from air.odometry.gnss_factors import AntennaMotion, Misfit, antenna_motion, linearise, misfit, total
from air.odometry.gnss_fixing import fix
from air.odometry.gnss_preprocessing import CleanEpoch
from air.odometry.gnss_settings import GnssSettings
from air.odometry.mounting import ANTENNA, MOUNTING
from air.odometry.preintegration import ImuBuffer, ImuPieces
from air.odometry.quadratic import Quadratic, variable
from air.odometry.window import Frame, Window
from common.arrays import F64
from common.se3 import SE3

GYRO_NS = 20_000_000
"""The rate of turn that swings the antenna is the mean over so long."""
TURNED, SHIFTED = 0.003, 1.0
"""Epochs are linearised anew once the attitude has turned by rad, or a bias has moved by m, since."""
TRY_S = 0.5
"""Between two tries to fix whole cycles."""
LINE_S, MOST_LINES = 600.0, 500
"""A carrier begins anew after so long: the direction of its satellite has changed too much."""
GOLDEN = 0.6180339887
"""Its multiples lie evenly between whole numbers."""
MOSTLY = 0.7
"""Share of an epoch's biases that a node must have, or a new one begins at once."""


@dataclass(frozen=True, eq=False)
class _Taken:
    """An epoch, the way to it from its keyframe as the IMU felt it, and the rate of turn (3,) rad/s there."""

    epoch: CleanEpoch
    measured: gtsam.PreintegratedCombinedMeasurements
    omega: F64
    line_carrier: F64 | None


@dataclass(eq=False)
class _Stretch:
    """Epochs after keyframe k that share a node, and all that they say about both as one function.

    `weighted` is whether residuals have been looked at; those of biases that were never adjusted say nothing.
    """

    k: int
    node: BiasNode
    taken: list[_Taken] = field(default_factory=list)
    known: Quadratic | None = None
    weighted: bool = False


class GnssWindow:
    """A companion of the window. Add epochs in order of time."""

    def __init__(self, settings: GnssSettings, imu: ImuBuffer, T_ecef_world: SE3) -> None:
        self._differential = False
        self._lines: dict[str, tuple[int, F64]] = {}
        self._settings, self._imu, self._T_ecef_world = settings, imu, T_ecef_world
        self._lever = np.array(settings.p_body_antenna)
        self._stretches: list[_Stretch] = []
        self._nodes: list[BiasNode] = []
        self._links: list[Quadratic] = []
        self._adjusted = self._fixed = -1
        self._tried_ns = 0

    def add(self, window: Window, epoch: CleanEpoch) -> bool:
        """Take an epoch that IMU samples cover; whether a keyframe lies before it, and the IMU tells the way there."""
        keyframe = _before(window.frames, epoch.t_ns)
        if keyframe is None:
            return False
        way = self._imu.between(keyframe.t_ns, epoch.t_ns)
        if way.doubtful.any():
            return False
        # Differences to a base station drift so little that their carriers do tell the place.
        self._differential = epoch.differential
        if not self._differential:
            epoch = self._renewed(epoch)
        stretch = self._stretch(window.values, keyframe.k, epoch)
        taken = self._taken(window, keyframe, epoch, way)
        stretch.taken.append(taken)
        own = self._linearised(window.values, stretch, [taken])
        stretch.known = own if stretch.known is None else _sum(stretch.known.at(window.values), own)
        return True

    def fix(self, window: Window) -> bool:
        """Whether ambiguities of differences to a base station have just become whole cycles, once for each node."""
        newest_ns = window.frames[-1].t_ns
        if not self._differential or not self._nodes or newest_ns - self._tried_ns < TRY_S * SECOND_NS:
            return False
        node = self._nodes[-1]
        if node.index == self._fixed or node.index > self._adjusted:
            return False
        self._tried_ns = newest_ns
        try:
            covariance = window.covariance_of(node.key)
        except (KeyError, np.linalg.LinAlgError):
            return False
        found = fix(node, window.values.atVector(node.key), covariance)
        if isinstance(found, str):
            return False
        self._links.append(found)
        self._fixed = node.index
        return True

    def terms(self, window: Window) -> list[Quadratic]:
        """What epochs and processes say about keyframes and biases."""
        for stretch in self._stretches:
            if self._is_stale(window.values, stretch):
                stretch.weighted = stretch.node.index <= self._adjusted
                stretch.known = self._linearised(window.values, stretch, stretch.taken)
        if self._nodes:
            self._adjusted = self._nodes[-1].index
        return [*self._links, *(s.known for s in self._stretches if s.known is not None)]

    def leaving(self, k: int) -> tuple[list[int], list[Quadratic]]:
        """The nodes that no later keyframe needs, and all that is known about them and keyframe k."""
        mine = [s for s in self._stretches if s.k == k]
        self._stretches = [s for s in self._stretches if s.k != k]
        kept = {s.node.key for s in self._stretches} | {node.key for node in self._nodes[-1:]}
        keys = [node.key for node in self._nodes if node.key not in kept]
        self._nodes = [node for node in self._nodes if node.key in kept]
        links = [link for link in self._links if not set(keys).isdisjoint(link.point)]
        self._links = [link for link in self._links if link not in links]
        return keys, [*links, *(s.known for s in mine if s.known is not None)]

    def _stretch(self, values: gtsam.Values, k: int, epoch: CleanEpoch) -> _Stretch:
        """The stretch that an epoch belongs to."""
        node = self._node(values, epoch)
        for stretch in self._stretches:
            if stretch.k == k and stretch.node is node:
                return stretch
        stretch = _Stretch(k, node, weighted=node.index <= self._adjusted)
        self._stretches.append(stretch)
        return stretch

    def _node(self, values: gtsam.Values, epoch: CleanEpoch) -> BiasNode:
        """The biases of an epoch: those of the newest node while they are new, else a next one's."""
        wanted = needed([epoch], self._settings.noise)
        if not self._nodes:
            node, known = first_node(0, epoch.t_ns, wanted)
        else:
            last = self._nodes[-1]
            shared = len(wanted.keys() & last.biases.keys()) / max(len(wanted), 1)
            if epoch.t_ns - last.t_ns < self._settings.node_s * SECOND_NS and shared >= MOSTLY:
                return last
            node, known = next_node(last, values.atVector(last.key), epoch.t_ns, wanted)
        self._nodes.append(node)
        self._links.append(known)
        values.insert(node.key, known.point[node.key])
        return node

    def _renewed(self, epoch: CleanEpoch) -> CleanEpoch:
        """The epoch with its carriers named anew when the directions in which they were first seen are old."""
        return replace(epoch, arcs=tuple(arc and f"{arc}@{_age(arc, epoch.t_ns)}" for arc in epoch.arcs))

    def _line_carrier(self, epoch: CleanEpoch, p_world: F64) -> F64:
        """The direction (N, 3) in world in which each carrier was first seen."""
        line = geometric_range(epoch.p_satellite, self._T_ecef_world.apply(p_world))[1] @ self._T_ecef_world.R
        for i, arc in enumerate(epoch.arcs):
            if arc:
                line[i] = self._lines.setdefault(arc, (epoch.t_ns, line[i]))[1]
        if len(self._lines) > MOST_LINES:
            oldest_ns = epoch.t_ns - round(LINE_S * SECOND_NS)
            self._lines = {arc: one for arc, one in self._lines.items() if one[0] >= oldest_ns}
        return line

    def _taken(self, window: Window, keyframe: Frame, epoch: CleanEpoch, way: ImuPieces) -> _Taken:
        bias = window.values.atConstantBias(B(keyframe.k))
        measured = window.preintegrator.integrate(way, bias)
        omega = self._imu.between(epoch.t_ns - GYRO_NS, epoch.t_ns).rate
        p_world = window.values.atPose3(X(keyframe.k)).translation()
        line = None if epoch.differential else self._line_carrier(epoch, p_world)
        return _Taken(epoch, measured, omega, line)

    def misfit(self, values: gtsam.Values) -> Misfit | None:
        """How well the newest epoch fits; None without one."""
        if not self._stretches:
            return None
        stretch = self._stretches[-1]
        one, node = stretch.taken[-1], stretch.node
        motion = self._motion(values, stretch.k, one)
        return misfit(one.epoch, motion, node, values.atVector(node.key), self._T_ecef_world, one.line_carrier)

    def _motion(self, values: gtsam.Values, k: int, one: _Taken) -> AntennaMotion:
        pose, velocity, bias = values.atPose3(X(k)), values.atVector(V(k)), values.atConstantBias(B(k))
        lever = self._lever + values.atVector(MOUNTING)[ANTENNA]
        return antenna_motion(pose, velocity, bias, one.measured, lever, one.omega)

    def _linearised(self, values: gtsam.Values, stretch: _Stretch, taken: Sequence[_Taken]) -> Quadratic:
        k, node, u = stretch.k, stretch.node, values.atVector(stretch.node.key)
        robust = self._settings.noise.robust if stretch.weighted else np.inf
        parts = [
            linearise(one.epoch, self._motion(values, k, one), node, u, self._T_ecef_world, robust, one.line_carrier)
            for one in taken
        ]
        whole = total(parts)
        point = {key: variable(values, key) for key in (X(k), V(k), B(k), MOUNTING, node.key)}
        return Quadratic(point, whole.G, whole.g, whole.f)

    def _is_stale(self, values: gtsam.Values, stretch: _Stretch) -> bool:
        if stretch.known is None or (not stretch.weighted and stretch.node.index <= self._adjusted):
            return True
        pose, u = (stretch.known.point[key] for key in (X(stretch.k), stretch.node.key))
        turned = gtsam.Rot3.Logmap(pose.rotation().between(values.atPose3(X(stretch.k)).rotation()))
        shifted = np.abs(variable(values, stretch.node.key) - u)
        return bool(np.linalg.norm(turned) > TURNED or np.max(shifted, initial=0.0) > SHIFTED)


def _before(frames: Sequence[Frame], t_ns: int) -> Frame | None:
    """The last frame before a time that is sure to stay: the newest one may be dropped yet."""
    sure: Iterable[Frame] = frames[:-1] if len(frames) > 1 else frames
    return next((frame for frame in reversed(list(sure)) if frame.t_ns <= t_ns), None)


def _age(arc: str, t_ns: int) -> int:
    """How often a carrier has begun anew because its direction was old; each satellite at another time."""
    share = int(arc[1:3]) * GOLDEN % 1.0
    return int(t_ns / (LINE_S * SECOND_NS) + share)


def _sum(a: Quadratic, b: Quadratic) -> Quadratic:
    return Quadratic(b.point, a.G + b.G, a.g + b.g, a.f + b.f)
