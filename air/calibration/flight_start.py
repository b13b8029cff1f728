"""A first guess of a flight, once the rotations are known: positions and points are linear then."""

from __future__ import annotations

import numpy as np

from air.calibration.flight_model import Flight, FlightModel, Sightings
from common.arrays import F64
from common.errors import CalibrationError

ROUNDS = 8
MIN_ANGLE = np.radians(1.0)
MIN_POINTS = 30
NEAREST, FURTHEST = 0.1, 20.0
"""Points nearer or further, in median distances, count as being there."""


def first_flight(model: FlightModel, theta: F64) -> Flight:
    """Positions and points to the unknowns `theta` (13,). Raises CalibrationError where too few points move."""
    direction = model.directions(theta)
    positions = _positions(model.seen, direction)
    return Flight(theta, positions, _points(model, theta, positions, direction))


def _positions(seen: Sightings, direction: F64) -> F64:
    """Positions (K, 3) that bring the rays of each point together, at a mean distance of about one.

    Least squares of the distances of points from rays in units of how far they are, robust, without the points.
    """
    mean = np.zeros((seen.points, 3))
    np.add.at(mean, seen.point, direction)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    opened = np.zeros(seen.points)
    np.maximum.at(opened, seen.point, np.arccos(np.clip(np.sum(direction * mean[seen.point], axis=1), -1.0, 1.0)))
    near = opened > MIN_ANGLE
    if near.sum() < MIN_POINTS:
        raise CalibrationError(f"only {near.sum()} points are near enough to show that the camera moves; fly lower")
    d, kept = direction[near[seen.point]], seen.only(near)
    towards, weight, count = np.eye(3) - d[:, :, None] * d[:, None, :], np.ones(len(d)), len(seen.t_s)
    positions = np.zeros((count, 3))
    for _ in range(ROUNDS):
        P = towards * weight[:, None, None]
        A = np.zeros((kept.points, 3, 3))
        np.add.at(A, kept.point, P)
        by_frame = np.zeros((kept.points, count, 3, 3))
        by_frame[kept.point, kept.frame] = P
        b = by_frame.transpose(0, 2, 1, 3).reshape(kept.points, 3, 3 * count)
        points = np.linalg.solve(A + 1e-12 * np.eye(3), b)  # how they follow the positions
        H = -np.tensordot(b, points, axes=([0, 1], [0, 1]))
        for k in range(count):
            H[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += P[kept.frame == k].sum(axis=0)
        toward, away = np.zeros((kept.points, 3)), np.zeros((count, 3))
        closer = d * np.sqrt(weight)[:, None]
        np.add.at(toward, kept.point, closer)
        np.add.at(away, kept.frame, closer)
        mean_depth = (np.einsum("pi,pij->j", toward, points) - away.ravel())[3:] / len(d)
        regular = 1e-9 * np.trace(H) / len(H) * np.eye(len(H) - 3)
        x = np.linalg.solve(H[3:, 3:] + regular, mean_depth)  # the first position is the origin
        positions = np.concatenate([np.zeros(3), x / (mean_depth @ x)]).reshape(-1, 3)
        apart = np.einsum("pij,j->pi", points, positions.ravel())[kept.point] - positions[kept.frame]
        depth = np.sum(d * apart, axis=1)
        usual = float(np.median(np.abs(depth)))
        distance = np.clip(np.abs(depth) / usual, NEAREST, FURTHEST)
        off = np.linalg.norm(np.einsum("nij,nj->ni", towards, apart), axis=1) / distance
        weight = 1.0 / (distance**2 * (1.0 + (off / (3.0 * np.median(off) + 1e-12)) ** 2))
        positions = positions / usual
    return positions


def _points(model: FlightModel, theta: F64, positions: F64, direction: F64) -> F64:
    """Homogeneous points (P, 4) of length one, on the side to which the rays go."""
    seen, places = model.seen, model.places(theta, positions)
    towards = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    B = np.concatenate([towards, -np.einsum("nij,nj->ni", towards, places)[:, :, None]], axis=2)
    H = np.zeros((seen.points, 4, 4))
    np.add.at(H, seen.point, B.transpose(0, 2, 1) @ B)
    X = np.linalg.eigh(H)[1][:, :, 0]
    along = np.zeros(seen.points)
    np.add.at(along, seen.point, np.sum((X[seen.point, :3] - X[seen.point, 3:] * places) * direction, axis=1))
    return np.asarray(X * np.where(along < 0, -1.0, 1.0)[:, None])
