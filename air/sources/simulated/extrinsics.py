"""How camera and GNSS antenna sit on the body: as it is, and as the calibration says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from common.arrays import F64
from common.config import Range
from common.se3 import SE3, rotation_vector_to_matrix

_EXTRINSICS = 39
R_BODY_NADIR = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Camera that looks straight down, the top of its image ahead."""
_CAMERA = np.array([0.10, 0.0, -0.08])
_ANTENNA = np.array([-0.12, 0.02, 0.22])


@dataclass(frozen=True)
class ExtrinsicsOptions:
    """How the sensors are mounted, and one sigma of what the calibration misses, for every axis.

    `mount_deg` is how far the camera leans away from nadir.
    """

    mount_deg: Annotated[float, Range(0, 30)] = 2.0
    camera_deg: Annotated[float, Range(0, 5)] = 0.1
    camera_m: Annotated[float, Range(0, 0.5)] = 0.003
    antenna_m: Annotated[float, Range(0, 0.5)] = 0.01

    @classmethod
    def perfect(cls) -> ExtrinsicsOptions:
        """A calibration without errors."""
        return cls(camera_deg=0.0, camera_m=0.0, antenna_m=0.0)


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """Camera pose and antenna phase centre (3,) m in the body frame."""

    T_body_cam: SE3
    p_body_antenna: F64


def draw_extrinsics(options: ExtrinsicsOptions, seed: int) -> tuple[Extrinsics, Extrinsics]:
    """The true extrinsics of a flight, and the nominal ones that the calibration says."""
    rng = np.random.default_rng([seed, _EXTRINSICS])
    mount, camera_turn, camera_shift, antenna_shift = rng.standard_normal((4, 3))
    R = R_BODY_NADIR @ rotation_vector_to_matrix(np.radians(options.mount_deg) * mount)
    nominal = Extrinsics(SE3(R, _CAMERA), _ANTENNA)
    R_true = R @ rotation_vector_to_matrix(np.radians(options.camera_deg) * camera_turn)
    T_true = SE3(R_true, _CAMERA + options.camera_m * camera_shift)
    return Extrinsics(T_true, _ANTENNA + options.antenna_m * antenna_shift), nominal
