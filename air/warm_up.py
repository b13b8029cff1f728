"""Compilation before the flight: numba compiles each loop when it is first called, for seconds, once on a machine."""

from __future__ import annotations

import cv2
import numpy as np

from air.alignment.matching import mutual_nearest
from air.alignment.prepare import Features
from air.mapping.mapper import Mapper
from air.mapping.settings import MappingSettings
from common.camera import CameraModel
from common.messages import Keyframe
from common.se3 import SE3

SIZE, HEIGHT, SHIFT = (240, 180), 20.0, 40


def warm_up() -> bool:
    """Map two small photos of a flat, speckled ground, so that no photo of the flight waits; whether that worked."""
    rng = np.random.default_rng(0)
    width, height = SIZE
    ground = cv2.GaussianBlur(rng.integers(0, 255, (height, width + SHIFT, 3), np.uint8), (0, 0), 1.5)
    camera = CameraModel(width, height, float(width), float(width), width / 2, height / 2)
    mapper = Mapper(MappingSettings())
    keyframes = []
    for index in range(2):
        place = SE3(np.diag([1.0, -1.0, -1.0]), np.array([index * SHIFT * HEIGHT / width, 0.0, HEIGHT]))
        mapper.add_image(index, np.ascontiguousarray(ground[:, index * SHIFT :][:, :width]))
        keyframes.append(Keyframe("warm-up", index, 1, 0, "", place, camera, np.ones(3), b""))
    descriptors = rng.random((8, 128), np.float32)
    features = Features(np.zeros((8, 2), np.float32), descriptors)
    mutual_nearest(features, features, 0.8)
    return any(np.isfinite(tile.height).any() for tile in mapper.update("warm-up", keyframes, 0.0))
