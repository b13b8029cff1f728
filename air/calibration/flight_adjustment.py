"""Bundle adjustment of a flight whose rotations are the gyroscope's (Levenberg–Marquardt, points eliminated first).

Turns and vibrations that the gyroscope has measured in radians appear in pixels: that gives focal length, mounting and
time, which images alone leave open in forward flight. Source: B. Triggs et al., Bundle adjustment – a modern
synthesis (2000), section 6; robust weights are Cauchy's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.calibration.flight_model import COUNT, DEPTH, Flight, FlightModel
from common.arrays import F64, I64

DAMPING, LEAST_DAMPING, TRIALS, ENOUGH = 1e-3, 1e-9, 8, 1e-4
BEHIND_PX = 30.0
"""Error of a point behind its camera."""


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of the unknowns (13,) beforehand, one sigma of each, and the steps that derivatives take."""

    theta: F64
    sigma: F64
    step: F64


@dataclass(frozen=True, eq=False)
class Fit:
    """An adjusted flight; what it costs; `information` is that of the free unknowns,
    whatever all else is."""

    flight: Flight
    cost: float
    information: F64


class Adjustment:
    """Adjusts flights to what was seen. `weight` (M,) is that of the observations, `robust_px` Cauchy's width."""

    def __init__(self, model: FlightModel, known: Known, weight: F64, robust_px: float) -> None:
        self._model, self._known, self._weight, self._robust = model, known, weight, robust_px

    def cost(self, flight: Flight) -> float:
        """Half the sum of squares, robust, in px²."""
        square = np.sum(np.nan_to_num(self._model.errors(flight), nan=BEHIND_PX) ** 2, axis=1)
        prior = (flight.theta - self._known.theta) / self._known.sigma
        return float(0.5 * self._robust**2 * (self._weight @ np.log1p(square / self._robust**2)) + 0.5 * prior @ prior)

    def fit(self, flight: Flight, free: I64, iterations: int) -> Fit:
        """The flight with some of the unknowns `free`, after so many steps at most."""
        cost, damping = self.cost(flight), DAMPING
        system = self._linear(flight, free)
        for _ in range(iterations):
            before = cost
            for _ in range(TRIALS):
                new = system.step(flight, damping)
                new_cost = self.cost(new)
                if new_cost < cost:
                    flight, cost = new, new_cost
                    damping = max(damping / 10, LEAST_DAMPING)
                    break
                damping *= 10
            if before - cost < ENOUGH * cost:
                break
            system = self._linear(flight, free)
        return Fit(flight, cost, system.information())

    def _linear(self, flight: Flight, free: I64) -> _System:
        """The problem linearised at a flight."""
        model, seen, known = self._model, self._model.seen, self._known
        R = model.attitudes(flight.theta)
        error = model.errors(flight)
        behind = np.isnan(error[:, 0])
        error[behind] = 0.0
        weight = self._weight / (1.0 + np.sum(error**2, axis=1) / self._robust**2)
        weight[behind] = 0.0
        root = np.sqrt(weight)[:, None, None]
        J_world = self._by_point(flight, R) * root
        X, tangent = flight.points[seen.point], np.linalg.svd(flight.points[:, None, :])[2][:, 1:]
        J_position = -X[:, 3][:, None, None] * J_world
        places = model.places(flight.theta, flight.positions)
        J_four = np.concatenate([J_world, -np.einsum("nij,nj->ni", J_world, places)[:, :, None]], axis=2)
        J_point = J_four @ tangent[seen.point].transpose(0, 2, 1)
        J_theta = np.stack([self._by_unknown(flight, int(i)) for i in free], axis=2)
        J_theta = np.where(behind[:, None, None], 0.0, np.nan_to_num(J_theta)) * root
        system = _assembled(model, free, J_theta, J_position, J_point, error * root[:, :, 0], tangent)
        at = np.arange(len(free))
        system.H[at, at] += 1.0 / known.sigma[free] ** 2
        system.b[at] += (flight.theta - known.theta)[free] / known.sigma[free] ** 2
        return system

    def _by_point(self, flight: Flight, R: F64) -> F64:
        """Derivatives (M, 2, 3) of the pixels by the points."""
        p, camera = self._model.in_camera(flight, R), self._model.camera(flight.theta)
        z = np.where(p[:, 2] > DEPTH, p[:, 2], 1.0)
        xy, h = p[:, :2] / z[:, None], 1e-6
        bend = np.stack([(camera.distort(xy + d) - camera.distort(xy - d)) / (2 * h) for d in h * np.eye(2)], axis=2)
        flat = np.zeros((len(z), 2, 3))
        flat[:, 0, 0] = flat[:, 1, 1] = 1.0 / z
        flat[:, :, 2] = -xy / z[:, None]
        return np.asarray(camera.fx * bend @ flat @ R.transpose(0, 2, 1))

    def _by_unknown(self, flight: Flight, i: int) -> F64:
        """Derivatives (M, 2) of the pixels by one unknown."""
        d = np.zeros(COUNT)
        d[i] = self._known.step[i]
        ends = [self._model.errors(Flight(flight.theta + s * d, flight.positions, flight.points)) for s in (1, -1)]
        return np.asarray((ends[0] - ends[1]) / (2 * d[i]))


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations of unknowns and positions, `H` and `b`, of points, `V` and `c`, and between them, `W`."""

    free: I64
    H: F64
    b: F64
    V: F64
    c: F64
    W: F64
    tangent: F64

    def _reduced(self, damping: float) -> tuple[F64, F64]:
        """Without the points: the matrix, and how points (P, 3, N+1) follow, the last column being their own step."""
        V = self.V + (damping * np.trace(self.V, axis1=1, axis2=2) / 3 + 1e-9)[:, None, None] * np.eye(3)
        follow = np.linalg.solve(V, np.concatenate([self.W, self.c[:, :, None]], axis=2))
        S = self.H + damping * np.diag(np.diag(self.H)) - np.tensordot(self.W, follow[:, :, :-1], ([0, 1], [0, 1]))
        return S + 1e-9 * np.diag(np.diag(S)), follow

    def step(self, flight: Flight, damping: float) -> Flight:
        """The flight one step on; its first position stays the origin."""
        S, follow = self._reduced(damping)
        rest = self.b - np.tensordot(self.W, follow[:, :, -1], ([0, 1], [0, 1]))
        n, moves = len(self.free), np.ones(len(S), bool)
        moves[n : n + 3] = False
        change = np.zeros(len(S))
        change[moves] = -np.linalg.solve(S[np.ix_(moves, moves)], rest[moves])
        theta, points = flight.theta.copy(), -(follow[:, :, -1] + follow[:, :, :-1] @ change)
        theta[self.free] += change[:n]
        X = flight.points + np.einsum("pi,pij->pj", points, self.tangent)
        X /= np.linalg.norm(X, axis=1, keepdims=True)
        return Flight(theta, flight.positions + change[n:].reshape(-1, 3), X)

    def information(self) -> F64:
        """Information of the free unknowns, whatever positions and points are."""
        S, n = self._reduced(LEAST_DAMPING)[0], len(self.free)
        others = np.arange(n + 3, len(S))
        between = S[:n, others]
        return np.asarray(S[:n, :n] - between @ np.linalg.solve(S[np.ix_(others, others)], between.T))


def _assembled(
    model: FlightModel, free: I64, J_theta: F64, J_position: F64, J_point: F64, error: F64, tangent: F64
) -> _System:
    """The normal equations of weighted derivatives (M, 2, ·) and errors (M, 2)."""
    frame, point, frames, points = model.seen.frame, model.seen.point, len(model.seen.t_s), model.seen.points
    n = len(free)
    V, c, W = np.zeros((points, 3, 3)), np.zeros((points, 3)), np.zeros((points, 3, n + 3 * frames))
    to_point = J_point.transpose(0, 2, 1)
    np.add.at(V, point, to_point @ J_point)
    np.add.at(c, point, np.einsum("nij,nj->ni", to_point, error))
    np.add.at(W[:, :, :n], point, to_point @ J_theta)
    by_frame = np.zeros((points, frames, 3, 3))
    by_frame[point, frame] = to_point @ J_position  # a frame sees a point once
    W[:, :, n:] = by_frame.transpose(0, 2, 1, 3).reshape(points, 3, 3 * frames)
    H, b = np.zeros((n + 3 * frames, n + 3 * frames)), np.zeros(n + 3 * frames)
    H[:n, :n] = np.einsum("nki,nkj->ij", J_theta, J_theta)
    b[:n] = np.einsum("nki,nk->i", J_theta, error)
    for k in range(frames):
        mine, at = frame == k, slice(n + 3 * k, n + 3 * k + 3)
        H[at, at] = np.einsum("nki,nkj->ij", J_position[mine], J_position[mine])
        H[:n, at] = np.einsum("nki,nkj->ij", J_theta[mine], J_position[mine])
        H[at, :n] = H[:n, at].T
        b[at] = np.einsum("nki,nk->i", J_position[mine], error[mine])
    return _System(free, H, b, V, c, W, tangent)
