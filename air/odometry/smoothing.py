"""A flight's path as all of its measurements tell it, those that came later too: for a map made afterwards.

A variable that leaves the window is known given those that stay. So, once the flight is over, all that left follows
one after the other, the last first, from what is known then. Source: H. Rauch, F. Tung, C. Striebel, Maximum
likelihood estimates of linear dynamic systems (1965), for which a sliding window is no obstacle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from air.odometry.preintegration import ImuBuffer, ImuPieces, InertialState, Preintegrator, Propagation, from_pose3
from air.odometry.quadratic import Conditional, Variable, carried, moved, retracted, variable
from air.odometry.window import Window
from common.arrays import F64
from common.se3 import SE3, level_between, rotation_vector, rotation_vector_to_matrix


@dataclass(frozen=True, eq=False)
class _Left:
    """Frame k left at t_ns; `felt` is what the IMU felt from there to the next one."""

    k: int
    t_ns: int
    conditional: Conditional
    felt: ImuPieces


@dataclass(frozen=True, eq=False)
class _Moving:
    """Where frame k was in the world that then ended."""

    k: int
    T_world_body: SE3


@dataclass(frozen=True, eq=False)
class _Ended:
    """All variables that a window held at its end, and its frames: number, time, what the IMU felt until the next."""

    known: Mapping[int, Variable]
    frames: list[tuple[int, int, ImuPieces]]


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A state of the path, and what the IMU felt from there to the next one."""

    state: InertialState
    felt: ImuPieces


@dataclass(eq=False)
class Smoother:
    """The history of a flight's windows. Some 0.2 MB for each second of flight: for recordings, not on board."""

    imu: ImuBuffer
    _integrator: Preintegrator | None = None
    _records: list[_Left | _Moving | _Ended] = field(default_factory=list)

    def left(self, window: Window, conditional: Conditional) -> None:
        """The oldest frame is about to leave."""
        oldest, after = window.frames[:2]
        self._records.append(_Left(oldest.k, oldest.t_ns, conditional, self.imu.between(oldest.t_ns, after.t_ns)))

    def moving(self, window: Window) -> None:
        """Another world is about to begin."""
        self._records.append(_Moving(window.frames[0].k, window.state(0).T_world_body))

    def ended(self, window: Window) -> None:
        """What the window holds stays as it is."""
        self._integrator = window.preintegrator
        known = {key: variable(window.values, key) for key in window.values.keys()}  # noqa: SIM118
        ends_ns = [*(frame.t_ns for frame in window.frames[1:]), window.frames[-1].t_ns]
        frames = [
            (f.k, f.t_ns, self.imu.between(f.t_ns, end_ns)) for f, end_ns in zip(window.frames, ends_ns, strict=True)
        ]
        self._records.append(_Ended(known, frames))

    def path(self) -> list[Smoothed]:
        """The states at keyframes, in order of time, in the world in which the flight ended."""
        out: list[Smoothed] = []
        known: dict[int, Variable] = {}
        T_last_world = SE3.identity()
        for record in reversed(self._records):
            if isinstance(record, _Ended):
                known, T_last_world = dict(record.known), SE3.identity()
                found = [(k, t_ns, felt) for k, t_ns, felt in reversed(record.frames)]
            elif isinstance(record, _Moving):
                T_before_world = level_between(from_pose3(known[X(record.k)]), record.T_world_body)
                known = {key: carried(key, value, T_before_world) for key, value in known.items()}
                T_last_world = T_last_world @ T_before_world.inverse()
                continue
            else:
                known |= _given(record.conditional, known)
                found = [(record.k, record.t_ns, record.felt)]
            out += [Smoothed(_state(known, k, t_ns, T_last_world), felt) for k, t_ns, felt in found]
        return out[::-1]

    def states(self) -> Iterator[InertialState]:
        """The states at the rate of the IMU: carried on from each keyframe, and bent to end at the next."""
        path, integrator = self.path(), self._integrator
        if integrator is None:
            return
        for here, after in pairwise(path):
            states = list(_carried_on(here, integrator))
            yield from _bent(states[:-1], states[-1], after.state)
        yield path[-1].state


def _carried_on(here: Smoothed, integrator: Preintegrator) -> Iterator[InertialState]:
    """A keyframe, and where the IMU leads from it piece by piece."""
    propagation, felt = Propagation(integrator, here.state), here.felt
    yield here.state
    for i in range(len(felt.dt_s)):
        one = slice(i, i + 1)
        propagation.advance(ImuPieces(felt.dt_s[one], felt.accel[one], felt.gyro[one], felt.doubtful[one]))
        yield propagation.state


def _given(conditional: Conditional, known: Mapping[int, Variable]) -> dict[int, Variable]:
    """The variables that left, given those that stayed."""
    step = np.concatenate([moved(then, known[key]) for key, then in conditional.left.items()])
    change, begin, out = conditional.shift - conditional.by @ step, 0, {}
    for key, then in conditional.gone.items():
        size = 6 if isinstance(then, gtsam.Pose3) else len(then)
        out[key] = retracted(then, change[begin : begin + size])
        begin += size
    return out


def _state(known: Mapping[int, Variable], k: int, t_ns: int, T_last_world: SE3) -> InertialState:
    biases = known[B(k)]
    pose = T_last_world @ from_pose3(known[X(k)])
    return InertialState(t_ns, pose, T_last_world.R @ known[V(k)], biases[:3], biases[3:])


def _bent(states: list[InertialState], end: InertialState, wanted: InertialState) -> Iterator[InertialState]:
    """States on the way to an end, with their share of what brings that to where it should be."""
    span_ns = max(end.t_ns - states[0].t_ns, 1)
    turn = rotation_vector(wanted.T_world_body.R @ end.T_world_body.R.T)
    shift, faster = wanted.T_world_body.t - end.T_world_body.t, wanted.v_world - end.v_world
    for state in states:
        share: float = (state.t_ns - states[0].t_ns) / span_ns
        T = state.T_world_body
        R: F64 = rotation_vector_to_matrix(share * turn) @ T.R
        pose = SE3(R, T.t + share * shift)
        yield InertialState(state.t_ns, pose, state.v_world + share * faster, state.accel_bias, state.gyro_bias)
