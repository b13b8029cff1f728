"""The simulated camera: what it sees of a world, with lens, light and sensor noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from air.sources.simulated.sites import raytrace
from air.sources.simulated.sites.scene import Light, Scene
from common.arrays import F32, F64, I32, U8
from common.camera import CameraModel
from common.se3 import SE3

SUN_AZIMUTH, SUN_ELEVATION = np.radians(150.0), np.radians(52.0)


def daylight() -> Light:
    """A clear late morning: the sun in the south-east, the sky blue."""
    horizontal = np.cos(SUN_ELEVATION)
    sun = np.array([horizontal * np.sin(SUN_AZIMUTH), horizontal * np.cos(SUN_AZIMUTH), np.sin(SUN_ELEVATION)])
    return Light(sun, np.array([1.30, 1.22, 1.10]), np.array([0.30, 0.34, 0.42]))


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera with lens, exposure and sensor; the image of a pose is a function of pose and random generator."""

    model: CameraModel
    light: Light
    exposure: float = 1.0
    vignetting: float = 0.25
    """Light lost at the corners."""
    shot_noise: float = 1.6
    """Standard deviation in a full bright pixel, of 255."""
    jpeg_quality: int = 93

    def linear_image(self, scene: Scene, T_world_cam: SE3) -> F32:
        """Light (H, W, 3) RGB that falls on the sensor behind a perfect lens, 1.0 = full scale."""
        image = np.empty((*self._rays.shape[:2], 3), np.float32)
        what: I32 = np.empty(image.shape[:2], np.int32)
        R, position = np.ascontiguousarray(T_world_cam.R), np.ascontiguousarray(T_world_cam.t)
        raytrace.expose(scene, self.light, self._rays, R, position, image, what)
        raytrace.refine_edges(scene, self.light, self._rays, R, position, image, what)
        return image

    def image(self, scene: Scene, T_world_cam: SE3, rng: np.random.Generator) -> U8:
        """Developed image (H, W, 3) uint8 RGB: vignetting, exposure, gamma 2 and noise that grows with the signal."""
        light = self.linear_image(scene, T_world_cam)
        light *= (self.exposure * self._transmission)[..., None]
        # Shot noise is ∝ √signal, so with gamma 2 it is the same in every pixel.
        signal = 255.0 * np.sqrt(np.clip(light, 0, 1))
        signal += self.shot_noise * rng.standard_normal(signal.shape, np.float32)
        return np.asarray(np.clip(np.rint(signal), 0, 255), np.uint8)

    def photograph(self, scene: Scene, T_world_cam: SE3, rng: np.random.Generator) -> bytes:
        """Encoded JPEG of the developed image."""
        bgr = cv2.cvtColor(self.image(scene, T_world_cam, rng), cv2.COLOR_RGB2BGR)
        return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])[1])

    @cached_property
    def _rays(self) -> F64:
        """Ideal normalised coordinates (H, W, 2) of the ray through every pixel centre."""
        v, u = np.mgrid[0 : self.model.height, 0 : self.model.width]
        return np.ascontiguousarray(self.model.rays(np.stack([u, v], axis=-1))[..., :2])

    @cached_property
    def _transmission(self) -> F32:
        """Relative transmission (H, W) of the lens: falls with the square of the distance from the centre."""
        height, width = self.model.height, self.model.width
        y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        return np.asarray(1 - self.vignetting * (x * x + y * y) / 2, np.float32)
