"""The GNSS epochs after one keyframe as one linear factor on that keyframe and on the biases of the satellites.

Where the antenna is at an epoch follows from the keyframe by the inertial measurements between them, so that epochs
need not coincide with frames. Ranges are linear in the antenna's position to a millimetre over some hundred metres,
and everything else here is linear, so one linearisation serves. The receiver's clock and its drift are free at each
epoch and are eliminated at once. Sources: Cao, Lu, Shen, GVINS (2022), section V; Groves, Principles of GNSS, Inertial
and Multisensor Integrated Navigation Systems, 14.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from air.gnss.gnss_time import SECOND_NS
from air.gnss.orbit import EARTH_RATE, geometric_range
from air.gnss.signals import LIGHT
from air.odometry.gnss_biases import REFERENCE_SYSTEMS, BiasNode, Kind
from air.odometry.gnss_preprocessing import CleanEpoch
from air.odometry.mounting import ANTENNA, COLUMNS
from common.arrays import F64, I64
from common.se3 import SE3, skew

STATES = 28
"""Columns of a keyframe: gtsam's tangent of its pose (rotation, translation, both in body), velocity, IMU biases; and
of the corrections of the mounting."""


@dataclass(frozen=True, eq=False)
class AntennaMotion:
    """The antenna `p_world` (3,) m and `v_world` (3,) m/s, and how they change with keyframe and mounting: (3, 28)."""

    p_world: F64
    v_world: F64
    p_by_state: F64
    v_by_state: F64


@dataclass(frozen=True, eq=False)
class Linearised:
    """Rows of one or more epochs, as ½ (f − 2 gᵀδ + δᵀ G δ) of 28 columns of keyframe and mounting and D of a node.

    `rows` were used.
    """

    G: F64
    g: F64
    f: float
    rows: int


def antenna_motion(
    pose: gtsam.Pose3,
    velocity: F64,
    bias: gtsam.imuBias.ConstantBias,
    measured: gtsam.PreintegratedCombinedMeasurements,
    p_body_antenna: F64,
    omega_body: F64,
) -> AntennaMotion:
    """The antenna at the end of pre-integrated measurements that begin at a keyframe.

    `omega_body` (3,) rad/s is the rate of turn at the end, measured, of which the bias is still to be taken.
    """
    by_state, by_bias = np.zeros((9, 9), order="F"), np.zeros((9, 6), order="F")
    nav = measured.predict(gtsam.NavState(pose, velocity), bias, by_state, by_bias)
    R_keyframe, R = pose.rotation().matrix(), nav.pose().rotation().matrix()
    # gtsam's tangent of a NavState holds position and velocity in body axes.
    by_state[:, 6:] = by_state[:, 6:] @ R_keyframe.T
    by = np.hstack([by_state, by_bias])
    omega = omega_body - bias.gyroscope()
    swing = np.cross(omega, p_body_antenna)
    p_by_state = R @ (by[3:6] - skew(p_body_antenna) @ by[:3])
    v_by_state = R @ (by[6:] - skew(swing) @ by[:3])
    v_by_state[:, 12:15] += R @ skew(p_body_antenna)
    return AntennaMotion(
        nav.pose().translation() + R @ p_body_antenna,
        nav.velocity() + R @ swing,
        np.hstack([p_by_state, _of_antenna(R)]),
        np.hstack([v_by_state, _of_antenna(R @ skew(omega))]),
    )


def _of_antenna(by_antenna: F64) -> F64:
    """Derivatives (3, 13) by the mounting of what changes with the lever arm only."""
    out = np.zeros((3, COLUMNS))
    out[:, ANTENNA] = by_antenna
    return out


def linearise(
    epoch: CleanEpoch,
    motion: AntennaMotion,
    node: BiasNode,
    u: F64,
    T_ecef_world: SE3,
    robust: float,
    line_carrier: F64 | None = None,
) -> Linearised:
    """The code, carrier and Doppler of an epoch as a factor, linear at `motion` and at the biases `u` (D,) of a node.

    Rows beyond `robust` sigmas lose weight: infinite for biases that were not adjusted yet, which explain residuals of
    metres. Rows whose biases the node does not have are left out. `line_carrier` (N, 3) are the directions, in world,
    along which carriers are held to see the antenna move.
    """
    code, carrier, rate = _rows(epoch, motion, node, u, T_ecef_world, line_carrier)
    ranging = _eliminated(
        np.vstack([code.H, carrier.H]),
        np.concatenate([code.left, carrier.left]),
        np.concatenate([code.sigma, carrier.sigma]),
        robust,
    )
    return total([ranging, _eliminated(rate.H, rate.left, rate.sigma, robust)])


@dataclass(frozen=True)
class Misfit:
    """What is left of an epoch: root mean squares of codes m, carriers m and Dopplers m/s, NaN without any.

    `clocks_s` is the receiver's clock s against the time of each system, by its letter, and `drift` how it grows, s/s:
    unknown in differences to a base station.
    """

    code: float
    carrier: float
    rate: float
    clocks_s: dict[str, float]
    drift: float


def misfit(
    epoch: CleanEpoch,
    motion: AntennaMotion,
    node: BiasNode,
    u: F64,
    T_ecef_world: SE3,
    line_carrier: F64 | None = None,
) -> Misfit:
    """How well an epoch fits; arguments as of `linearise`."""
    code, carrier, rate = _rows(epoch, motion, node, u, T_ecef_world, line_carrier)
    ranges = np.concatenate([code.left, carrier.left])
    clock, drift = (float(np.median(left)) if len(left) else np.nan for left in (ranges, rate.left))
    sizes = _rms(code.left - clock), _rms(carrier.left - clock), _rms(rate.left - drift)
    if epoch.differential:
        return Misfit(*sizes, {}, np.nan)
    delays = {name: float(u[column]) for (kind, name), column in node.biases.items() if kind is Kind.SYSTEM}
    clocks_s = {name: (clock + delays.get(name, 0.0)) / LIGHT for name in set(epoch.systems) if np.isfinite(clock)}
    return Misfit(*sizes, clocks_s, drift / LIGHT)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows (M, width) of one kind of measurement, what is `left` of them (M,), the clock in it, and sigmas (M,)."""

    H: F64
    left: F64
    sigma: F64


def _rows(
    epoch: CleanEpoch,
    motion: AntennaMotion,
    node: BiasNode,
    u: F64,
    T_ecef_world: SE3,
    line_carrier: F64 | None,
) -> tuple[_Rows, _Rows, _Rows]:
    """Codes, carriers and Dopplers."""
    p = T_ecef_world.apply(motion.p_world)
    v = T_ecef_world.R @ motion.v_world
    distance, line = geometric_range(epoch.p_satellite, p)
    line_world = line @ T_ecef_world.R
    width = STATES + len(node)
    by_position = np.zeros((len(line), width))
    by_position[:, :STATES] = -line_world @ motion.p_by_state
    by_velocity = np.zeros((len(line), width))
    by_velocity[:, :STATES] = -line_world @ motion.v_by_state
    by_way = by_position
    if line_carrier is not None:
        by_way = np.zeros_like(by_position)
        by_way[:, :STATES] = -line_carrier @ motion.p_by_state
    systems = _columns(node, Kind.SYSTEM, epoch.systems)
    multipath, slow = (_columns(node, kind, epoch.satellites) for kind in (Kind.MULTIPATH, Kind.SLOW))
    ambiguity = _columns(node, Kind.AMBIGUITY, epoch.arcs)
    drift = _columns(node, Kind.DRIFT, [arc or name for arc, name in zip(epoch.arcs, epoch.satellites, strict=True)])
    systems_known = (systems >= 0) | np.isin(epoch.systems, REFERENCE_SYSTEMS)

    code = np.flatnonzero(np.isfinite(epoch.code) & (multipath >= 0) & (slow >= 0) & systems_known)
    carrier = np.flatnonzero(np.isfinite(epoch.carrier) & (ambiguity >= 0) & (drift >= 0))
    rate = np.flatnonzero(np.isfinite(epoch.rate) & (drift >= 0) & ~np.isfinite(epoch.carrier))
    values, since_s = np.concatenate([np.zeros(STATES), u]), (epoch.t_ns - node.t_ns) / SECOND_NS

    def rows(which: I64, H: F64, measured: F64, expected: F64, sigma: F64, *columns: tuple[I64, float]) -> _Rows:
        H = H[which].copy()
        for column, factor in columns:
            found = column[which] >= 0
            H[np.flatnonzero(found), STATES + column[which][found]] = factor
        return _Rows(H, measured[which] - expected[which] - H[:, STATES:] @ values[STATES:], sigma[which])

    spoilt = (multipath, 1.0), (slow, 1.0), (systems, 1.0)
    return (
        rows(code, by_position, epoch.code, distance, epoch.sigma_code, *spoilt),
        rows(carrier, by_way, epoch.carrier, distance, epoch.sigma_carrier, (ambiguity, 1.0), (drift, since_s)),
        rows(rate, by_velocity, epoch.rate, _range_rates(epoch, p, v, line), epoch.sigma_rate, (drift, 1.0)),
    )


def _rms(values: F64) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def total(parts: Sequence[Linearised]) -> Linearised:
    """The sum of factors on the same keyframe and node, at least one."""
    return Linearised(
        G=np.sum([part.G for part in parts], axis=0),
        g=np.sum([part.g for part in parts], axis=0),
        f=sum(part.f for part in parts),
        rows=sum(part.rows for part in parts),
    )


def _columns(node: BiasNode, kind: Kind, names: Sequence[str]) -> I64:
    """Column of each bias in the node, −1 where it has none."""
    return np.array([node.biases.get((kind, name), -1) for name in names], np.int64)


def _range_rates(epoch: CleanEpoch, p: F64, v: F64, line: F64) -> F64:
    """Geometric range rates (N,) m/s, the turn of the earth included."""
    turn, p_sat, v_sat = EARTH_RATE / LIGHT, epoch.p_satellite, epoch.v_satellite
    sagnac = turn * (v_sat[:, 0] * p[1] + p_sat[:, 0] * v[1] - v_sat[:, 1] * p[0] - p_sat[:, 1] * v[0])
    return np.asarray(np.einsum("ij,ij->i", v_sat - v, line) + sagnac)


def _eliminated(H: F64, r: F64, sigma: F64, robust: float) -> Linearised:
    """Rows with one unknown that all share, their clock, which is eliminated."""
    width = H.shape[1]
    if len(r) < 2:
        return Linearised(np.zeros((width, width)), np.zeros(width), 0.0, 0)
    off = r - _weighted_median(r, 1 / sigma**2)
    scaled = np.abs(off) / sigma
    weight = np.minimum(1.0, robust / np.maximum(scaled, 1e-9)) / sigma**2
    mean_H, mean_r = weight @ H / weight.sum(), weight @ r / weight.sum()
    H, r = H - mean_H, r - mean_r
    WH = weight[:, None] * H
    return Linearised(H.T @ WH, WH.T @ r, float(weight @ r**2), len(r))


def _weighted_median(values: F64, weight: F64) -> float:
    order = np.argsort(values)
    below = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(below, below[-1] / 2)])
