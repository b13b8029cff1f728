"""Where camera and antenna sit on the body, how late frames are, and the lens: as the calibration says, corrected in
flight.

The corrections are one variable of the window. Each column stays where it is until the flight has told it much better
than the calibration did; what was learnt meanwhile is kept, and that it is uncertain counts all the time (a
Schmidt–Kalman filter's way: J. Farrell, Aided Navigation, 5.10). So what a flight cannot tell never moves.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import gtsam
import numpy as np

from air.odometry.quadratic import Quadratic
from common.arrays import F64, Bool
from common.config import Range
from common.se3 import SE3, rotation_vector_to_matrix

MOUNTING: int = gtsam.symbol("m", 0)
"""The key of the corrections in the window."""
TURN, SHIFT, DELAY, ANTENNA, LENS = slice(0, 3), slice(3, 6), slice(6, 7), slice(7, 10), slice(10, 13)
"""Columns: turn rad and shift m of the camera, delay s of frames, shift m of the antenna, focal length and principal
point px of the lens."""
COLUMNS = 13
EXACT = 1e-9


@dataclass(frozen=True)
class MountingSettings:
    """One sigma, on each axis, of what is known beforehand about the mounting; 0 is exact and stays.

    `camera_deg` and `camera_m`, of the camera on the body; `delay_s`, of the time of frames; `antenna_m`, of the lever
    arm; `focal_px` and `centre_px`, of the focal length and of either coordinate of the principal point. A correction
    counts once its sigma has fallen below the share `learnt` of that.
    """

    camera_deg: Annotated[float, Range(0.0, 10.0)] = 0.2
    camera_m: Annotated[float, Range(0.0, 1.0)] = 0.005
    delay_s: Annotated[float, Range(0.0, 0.1)] = 0.001
    antenna_m: Annotated[float, Range(0.0, 1.0)] = 0.015
    focal_px: Annotated[float, Range(0.0, 100.0)] = 0.5
    centre_px: Annotated[float, Range(0.0, 100.0)] = 0.5
    learnt: Annotated[float, Range(0.01, 1.0)] = 0.5


@dataclass(frozen=True, eq=False)
class Mounting:
    """`T_body_cam`, how much later than their stamps frames were exposed, and the lever arm `p_body_antenna` (3,) m.

    `lens` (3,) px is by how much focal length and principal point are larger than those of the calibration.
    """

    T_body_cam: SE3 = field(default_factory=SE3.identity)
    p_body_antenna: F64 = field(default_factory=lambda: np.zeros(3))
    delay_s: float = 0.0
    lens: F64 = field(default_factory=lambda: np.zeros(3))

    def corrected(self, u: F64) -> Mounting:
        """The mounting with corrections (13,)."""
        T = self.T_body_cam
        T = SE3(T.R @ rotation_vector_to_matrix(u[TURN]), T.t + u[SHIFT])
        return Mounting(T, self.p_body_antenna + u[ANTENNA], self.delay_s + float(u[DELAY][0]), self.lens + u[LENS])


@dataclass(frozen=True, eq=False)
class Mounted:
    """What is known of the mounting: corrections `u` (13,) of the `nominal` one, with their covariance (13, 13).

    `sigma` (13,) is what was known beforehand; of the columns `learnt` (13,) the flight knows better.
    """

    nominal: Mounting
    sigma: F64
    u: F64
    covariance: F64
    learnt: Bool
    share: float

    @classmethod
    def beforehand(cls, nominal: Mounting, settings: MountingSettings | None = None) -> Mounted:
        """As the calibration says."""
        s = settings or MountingSettings()
        each = [np.radians(s.camera_deg), s.camera_m, s.delay_s, s.antenna_m, s.focal_px, s.centre_px]
        sigma = np.repeat(each, [3, 3, 1, 3, 1, 2])
        sigma = np.maximum(sigma, EXACT)
        nothing = np.zeros(COLUMNS, bool)
        return cls(nominal, sigma, np.zeros(COLUMNS), np.diag(sigma**2), nothing, s.learnt)

    @property
    def now(self) -> Mounting:
        """The mounting as it is best known."""
        return self.nominal.corrected(self.u)

    @property
    def held(self) -> list[int]:
        """The columns that stay where they are."""
        return np.flatnonzero(~self.learnt).tolist()

    def prior(self) -> Quadratic:
        """What is known as a function of the variable."""
        return Quadratic({MOUNTING: self.u}, np.asarray(np.linalg.inv(self.covariance), float), np.zeros(COLUMNS))

    def told(self, u: F64, covariance: F64) -> Mounted:
        """What is known after a solution; what has been learnt once stays so."""
        now = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        learnt = self.learnt | ((now < self.share * self.sigma) & (self.sigma > EXACT))
        return replace(self, u=u, covariance=covariance, learnt=learnt)
