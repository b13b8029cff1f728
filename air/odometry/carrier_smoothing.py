"""Single-point positions joined by the carriers that two epochs share.

Pseudoranges tell where the antenna is within metres. Unbroken carriers tell how far it moved since within centimetres,
or Dopplers within decimetres where carriers are few. A Kalman smoother weighs all. Most of a single point's error
stays for minutes, and it knows that: many epochs do not make it small. Sources: van Graas and Soloviev, Precise
Velocity Estimation Using a Stand-Alone GPS Receiver (2004); Brown and Hwang, Introduction to Random Signals, chapters
6 (smoothing) and 9 (errors that wander).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS
from air.gnss.least_squares import chi_square_limit, cofactor_of, worst_residual
from air.gnss.orbit import geometric_range
from air.gnss.positioning import PointPosition
from air.gnss.settings import PositioningSettings
from air.odometry.gnss_carrier import LONGEST_GAP_S, CarrierLocks
from air.odometry.gnss_corrections import correct
from air.odometry.gnss_settings import GnssSelection
from common.arrays import F64, I64
from common.measurements import GnssEpoch

SIGMA_MOVED = 0.03
"""One sigma of the difference of a carrier between two epochs, m, as a hand-held antenna has it."""
CHANGE = 0.5
"""How far the velocity departs from the mean of two Dopplers between them, m/s for each second that takes."""
SLOW, SLOW_S = 0.9, 300.0
"""Share of a single point's variance that stays, and for how long: multipath, air and orbits."""
_LEAST_CHECKED = 1


@dataclass(frozen=True, eq=False)
class Way:
    """How far the antenna moved: `moved` (3,) m, ECEF, with its `covariance` (3, 3)."""

    moved: F64
    covariance: F64


@dataclass(frozen=True, eq=False)
class Carriers:
    """The unbroken carriers of an epoch: number of the arc (N,), m, and where the satellites were (N, 3) m, ECEF."""

    arc: I64
    carrier: F64
    p_satellite: F64


def way_by_carriers(before: Carriers, now: Carriers, near: F64) -> Way | None:
    """The way between two epochs, None where their common carriers are too few to check each other.

    `near` (3,) m, ECEF, is where the antenna was within some hundred metres. Carriers that contradict the others are
    excluded one by one, the worst first.
    """
    _, i, j = np.intersect1d(before.arc, now.arc, return_indices=True)
    here, _ = geometric_range(before.p_satellite[i], near)
    there, line = geometric_range(now.p_satellite[j], near)
    y = now.carrier[j] - there - (before.carrier[i] - here)
    H, sigma = np.column_stack([-line, np.ones(len(line))]), np.full(len(line), SIGMA_MOVED)
    excluded = 0
    while (redundancy := len(y) - 4) >= _LEAST_CHECKED + excluded:
        try:
            cofactor = cofactor_of(H, sigma)
        except np.linalg.LinAlgError:
            return None
        x = cofactor @ (H.T @ (y / sigma**2))
        v = y - H @ x
        if v / sigma @ (v / sigma) <= chi_square_limit(redundancy):
            return Way(x[:3], cofactor[:3, :3])
        worst = worst_residual(v, sigma, H, cofactor)
        if worst is None:
            return None
        H, y, sigma = (np.delete(one, worst, axis=0) for one in (H, y, sigma))
        excluded += 1
    return None


def way_by_doppler(before: PointPosition, now: PointPosition) -> Way | None:
    """The way between two positions as their velocities tell, None where one has none."""
    dt_s = (now.t_ns - before.t_ns) / SECOND_NS
    moved = (before.velocity + now.velocity) / 2 * dt_s
    if not np.isfinite(moved).all():
        return None
    noise = (before.velocity_covariance + now.velocity_covariance) / 4
    return Way(moved, noise * dt_s**2 + (CHANGE * dt_s**2) ** 2 * np.eye(3))


@dataclass(frozen=True, eq=False)
class _Joined:
    """A single point, the way to it from the one before, None where it begins anew, and how long that took."""

    fix: PointPosition
    way: Way | None
    dt_s: float


class CarrierSmoother:
    """Collects the single points of one receiver, in order of time, and smooths them afterwards."""

    def __init__(self, broadcast: Ephemerides, settings: PositioningSettings) -> None:
        """`broadcast` is to hold what is known by the time of each epoch that is added."""
        self._broadcast, self._settings = broadcast, settings
        self._locks = CarrierLocks(GnssSelection())
        self._last: Carriers | None = None
        self._joined: list[_Joined] = []

    def add(self, epoch: GnssEpoch, fix: PointPosition) -> Way | None:
        """Take an epoch and its position; how far the antenna moved since the last one, if that is known."""
        signals = correct(epoch, self._broadcast, fix.position)
        arcs = self._locks.step(epoch.t_ns / SECOND_NS, signals, epoch.lock_s[signals.row])
        good = (arcs >= 0) & signals.first & (signals.elevation >= np.radians(self._settings.elevation_mask_deg))
        good &= np.array([name[0] in self._settings.systems for name in signals.satellites], bool)
        carriers = Carriers(arcs[good], signals.carrier[good], signals.p_satellite[good])
        dt_s = (fix.t_ns - self._joined[-1].fix.t_ns) / SECOND_NS if self._joined else 0.0
        way = None
        if self._last is not None and 0.0 < dt_s <= LONGEST_GAP_S:
            told = way_by_carriers(self._last, carriers, fix.position), way_by_doppler(self._joined[-1].fix, fix)
            known = [one for one in told if one is not None]
            way = min(known, key=lambda one: float(np.trace(one.covariance)), default=None)
        self._last = carriers
        self._joined.append(_Joined(fix, way, dt_s))
        return way

    def smoothed(self) -> list[PointPosition]:
        """The positions added, each as all of its unbroken chain tell it."""
        starts = [i for i, one in enumerate(self._joined) if one.way is None]
        chains = [self._joined[i:j] for i, j in pairwise([*starts, len(self._joined)])]
        return [position for chain in chains for position in _smooth(chain)]


@dataclass(frozen=True, eq=False)
class _State:
    """The antenna and the error that its single points share, `x` (6,) m with covariance `P` (6, 6)."""

    x: F64
    P: F64


_BOTH = np.hstack([np.eye(3), np.eye(3)])
"""A single point shows the antenna and the error."""


def _smooth(chain: Sequence[_Joined]) -> list[PointPosition]:
    """The positions of a chain: a Kalman filter forwards, and what came later brought back (Rauch, Tung, Striebel)."""
    first = chain[0].fix
    slow = SLOW * first.covariance
    x = np.concatenate([first.position, np.zeros(3)])
    found = [_State(x, np.block([[first.covariance, -slow], [-slow, slow]]))]
    expected = [found[0]]
    for one in chain[1:]:
        expected.append(_predicted(found[-1], one))
        found.append(_corrected(expected[-1], one.fix))
    for k in range(len(chain) - 2, -1, -1):
        back = np.linalg.solve(expected[k + 1].P, _transition(chain[k + 1].dt_s) @ found[k].P).T
        x = found[k].x + back @ (found[k + 1].x - expected[k + 1].x)
        found[k] = _State(x, found[k].P + back @ (found[k + 1].P - expected[k + 1].P) @ back.T)
    return [
        replace(one.fix, position=state.x[:3], covariance=state.P[:3, :3])
        for one, state in zip(chain, found, strict=True)
    ]


def _transition(dt_s: float) -> F64:
    return np.diag(np.repeat([1.0, np.exp(-dt_s / SLOW_S)], 3))


def _predicted(state: _State, one: _Joined) -> _State:
    assert one.way is not None
    F = _transition(one.dt_s)
    x, P = F @ state.x, F @ state.P @ F.T
    x[:3] += one.way.moved
    P[:3, :3] += one.way.covariance
    P[3:, 3:] += (1 - F[3, 3] ** 2) * SLOW * one.fix.covariance
    return _State(x, P)


def _corrected(state: _State, fix: PointPosition) -> _State:
    white = (1 - SLOW) * fix.covariance
    K = np.linalg.solve(_BOTH @ state.P @ _BOTH.T + white, _BOTH @ state.P).T
    left = np.eye(6) - K @ _BOTH
    return _State(state.x + K @ (fix.position - _BOTH @ state.x), left @ state.P @ left.T + K @ white @ K.T)
