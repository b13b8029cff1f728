"""The camera of one browser: framing the map, and following the aircraft."""

from __future__ import annotations

import numpy as np
import viser

from common.arrays import F64
from common.se3 import quaternion_to_matrix
from ground.viewer.detail import View

FOV = float(np.radians(50.0))
FROM_SOUTH = np.array([0.0, -0.76, 0.65])
GROWTH = 1.25


class Steering:
    """Frames the map while it grows, until the operator moves the camera; brings it back on request."""

    def __init__(self, camera: viser.CameraHandle) -> None:
        self._camera = camera
        self._home_wanted = False
        self._framed_radius = 0.0
        self._placed: F64 | None = None
        self._aircraft: F64 | None = None
        camera.fov = FOV
        camera.near, camera.far = 0.3, 20_000.0

    @property
    def view(self) -> View:
        """Where the browser looks from."""
        camera = self._camera
        R_scene_cam = quaternion_to_matrix(np.asarray(camera.wxyz, float))
        return View(np.asarray(camera.position, float), R_scene_cam, camera.fov, camera.aspect, camera.image_height)

    def go_home(self) -> None:
        """Frame the whole map at the next update."""
        self._home_wanted = True

    def update(self, box: tuple[F64, F64] | None, p_aircraft: F64 | None) -> None:
        """Move the camera: `box` is the map's (3,), (3,) m in the scene, `p_aircraft` (3,) m the aircraft to follow."""
        if box is not None:
            radius = max(float(np.linalg.norm(box[1] - box[0])) * 0.45, 5.0)
            grown = radius > GROWTH * self._framed_radius and not self._moved_by_operator()
            if self._home_wanted or grown:
                self._frame((box[0] + box[1]) / 2, radius)
        if p_aircraft is not None and self._aircraft is not None:
            self._camera.position = np.asarray(self._camera.position, float) + (p_aircraft - self._aircraft)
        self._aircraft = p_aircraft

    def _frame(self, centre: F64, radius: float) -> None:
        narrowest = min(FOV, 2 * np.arctan(np.tan(FOV / 2) * self._camera.aspect))
        self._camera.up_direction = np.array([0.0, 0.0, 1.0])
        self._camera.position = centre + FROM_SOUTH * radius / np.sin(narrowest / 2)
        self._camera.look_at = centre
        self._placed, self._framed_radius, self._home_wanted = np.asarray(self._camera.position), radius, False

    def _moved_by_operator(self) -> bool:
        """Whether the camera is no longer where it was put."""
        if self._placed is None:
            return False
        return bool(np.linalg.norm(self._camera.position - self._placed) > 0.02 * self._framed_radius)
