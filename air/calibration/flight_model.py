"""What a camera on a gyroscope sees in flight: where points appear, given all that a calibration has to find."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from air.calibration.gyroscope import Gyroscope
from common.arrays import F64, I64, Bool
from common.camera import CameraModel
from common.se3 import rotation_vector_to_matrix

FOCAL, PRINCIPAL, RADIAL, MOUNTING, OFFSET, LINE, BIAS = 0, slice(1, 3), slice(3, 5), slice(5, 8), 8, 9, slice(10, 13)
COUNT = 13
"""Unknowns: log of the focal length px, principal point px, two radial terms, turn of the mounting rad, time offset s,
line time s, bias rad/s."""
DEPTH = 1e-6


@dataclass(frozen=True, eq=False)
class Sightings:
    """M observations `uv` (M, 2) px of P points in K frames at `t_s` (K,), the clock of the camera."""

    t_s: F64
    frame: I64
    point: I64
    uv: F64
    points: int

    def only(self, kept: Bool) -> Sightings:
        """The observations of some of the points (P,) alone."""
        used = kept[self.point]
        index = np.cumsum(kept) - 1
        return replace(
            self, frame=self.frame[used], point=index[self.point[used]], uv=self.uv[used], points=int(kept.sum())
        )


@dataclass(frozen=True, eq=False)
class Flight:
    """Unknowns `theta` (13,), positions (K, 3) of the camera, and points (P, 4), homogeneous and of length one, both in
    the first body frame at a scale of its own: so points at infinity are points like others."""

    theta: F64
    positions: F64
    points: F64

    def only(self, kept: Bool) -> Flight:
        """The flight with some of the points (P,) alone."""
        return replace(self, points=self.points[kept])


class FlightModel:
    """Projection of a flight's points by gyroscope and camera."""

    def __init__(self, seen: Sightings, gyro: Gyroscope, like: CameraModel, R_body_cam: F64) -> None:
        self.seen, self._gyro, self._like, self._R_body_cam = seen, gyro, like, R_body_cam
        self._row = seen.uv[:, 1] - (like.height - 1) / 2

    def only(self, kept: Bool) -> FlightModel:
        """The model of some of the points (P,) alone."""
        return FlightModel(self.seen.only(kept), self._gyro, self._like, self._R_body_cam)

    def camera(self, theta: F64) -> CameraModel:
        """The camera of the unknowns."""
        f, (cx, cy), (k1, k2) = float(np.exp(theta[FOCAL])), theta[PRINCIPAL].tolist(), theta[RADIAL].tolist()
        return replace(self._like, fx=f, fy=f, cx=cx, cy=cy, k1=k1, k2=k2)

    def R_body_cam(self, theta: F64) -> F64:
        """How the camera sits on the body (3, 3)."""
        return np.asarray(rotation_vector_to_matrix(theta[MOUNTING]) @ self._R_body_cam)

    def attitudes(self, theta: F64) -> F64:
        """`R_first_cam` (M, 3, 3) when each observation's row was exposed."""
        t_s = self.seen.t_s[self.seen.frame] + theta[OFFSET] + self._row * theta[LINE]
        return np.asarray(self._gyro.attitudes(t_s, theta[BIAS]) @ self.R_body_cam(theta))

    def places(self, theta: F64, positions: F64) -> F64:
        """Positions (M, 3) of the camera when each row was exposed."""
        velocity = np.gradient(positions, self.seen.t_s, axis=0)
        return np.asarray(positions[self.seen.frame] + velocity[self.seen.frame] * (self._row * theta[LINE])[:, None])

    def directions(self, theta: F64) -> F64:
        """Unit rays (M, 3) of the observations in the first body frame."""
        rays = self.camera(theta).rays(self.seen.uv)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return np.asarray(np.einsum("nij,nj->ni", self.attitudes(theta), rays))

    def in_camera(self, flight: Flight, R: F64) -> F64:
        """The points (M, 3) as the cameras see them, at their homogeneous scale."""
        X = flight.points[self.seen.point]
        away = X[:, :3] - X[:, 3:] * self.places(flight.theta, flight.positions)
        return np.asarray(np.einsum("nji,nj->ni", R, away))

    def errors(self, flight: Flight) -> F64:
        """Where points appear less where they were seen (M, 2) px; NaN behind the camera."""
        p = self.in_camera(flight, self.attitudes(flight.theta))
        camera = self.camera(flight.theta)
        xy = p[:, :2] / np.where(p[:, 2:] > DEPTH, p[:, 2:], np.nan)
        return np.asarray(camera.distort(xy) * camera.fx + [camera.cx, camera.cy] - self.seen.uv)
