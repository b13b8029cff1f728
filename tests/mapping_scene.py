"""An exact scene for the mapping tests: hills and boxes with a texture, rendered by ray and surface intersection.

It shares no code with the mapper but the camera model and the messages.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from common.camera import CameraModel
from common.messages import Keyframe
from common.se3 import SE3, rotation_vector_to_matrix

# West, south, east, north, height of the roof above the hill's base level, m.
BOXES = np.array([[-6.0, -4.0, -1.0, 1.0, 3.0], [4.0, 3.0, 7.0, 8.0, 2.0], [3.0, -9.0, 8.0, -6.0, 4.0]])
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


@njit(cache=True)
def _hills(x, y, relief):
    return relief * (np.sin(0.21 * x + 0.4) * np.cos(0.17 * y) + 0.3 * np.sin(0.5 * x + 0.35 * y))


@njit(cache=True)
def _surface(x, y, boxes, relief):
    z = _hills(x, y, relief)
    for k in range(boxes.shape[0]):
        if boxes[k, 0] <= x <= boxes[k, 2] and boxes[k, 1] <= y <= boxes[k, 3]:
            z = max(z, boxes[k, 4])
    return z


@njit(cache=True)
def _enters_box(box, origin, dx, dy, dz):
    """Distance along a downward ray to where it enters a box that reaches down without end, or infinity."""
    enter, leave = (box[4] - origin[2]) / dz, np.inf
    for axis in range(2):
        d = dx if axis == 0 else dy
        if abs(d) < 1e-12:
            if not box[axis] <= origin[axis] <= box[axis + 2]:
                return np.inf
            continue
        a, b = (box[axis] - origin[axis]) / d, (box[axis + 2] - origin[axis]) / d
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter if enter <= leave else np.inf


@njit(cache=True)
def _noise(x, y, z, seed):
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    total = 0.0
    for di in range(2):
        for dj in range(2):
            for dk in range(2):
                h = np.uint32((i + di) * 73856093) ^ np.uint32((j + dj) * 19349663)
                h ^= np.uint32((k + dk) * 83492791) ^ np.uint32(seed * 2654435761)
                h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(1274126177))
                value = np.float64((h ^ (h >> np.uint32(16))) & np.uint32(0xFFFF)) / 65535
                a, b, c = abs(1 - di - (x - i)), abs(1 - dj - (y - j)), abs(1 - dk - (z - k))
                total += value * a * b * c
    return total


@njit(cache=True)
def _render(rays, origin, boxes, relief, contrast, top):
    h, w = rays.shape[:2]
    image = np.zeros((h, w, 3))
    for v in range(h):
        for u in range(w):
            dx, dy, dz = rays[v, u]
            t = (top - origin[2]) / dz
            for _ in range(60):
                gap = origin[2] + t * dz - _hills(origin[0] + t * dx, origin[1] + t * dy, relief)
                if gap < 1e-5:
                    break
                # Never beyond the surface: no hill is steeper than 0.45 times the relief.
                t += gap / (-dz + 0.45 * relief * np.sqrt(dx * dx + dy * dy))
            for k in range(boxes.shape[0]):
                t = min(t, _enters_box(boxes[k], origin, dx, dy, dz))
            x, y, z = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
            g = 0.0
            for octave in range(4):
                scale = 0.25 * 2.2**octave
                g += (_noise(x / scale, y / scale, z / scale, octave) - 0.5) * 0.45
            for channel in range(3):
                image[v, u, channel] = 120 + 110 * contrast * g + 12 * channel
    return image


@dataclass(frozen=True)
class Scene:
    """Terrain of `relief` m amplitude with `boxes`; `contrast` of its texture, 1 being that of gravel."""

    boxes: np.ndarray
    relief: float = 0.8
    contrast: float = 1.0

    def height(self, xy):
        """Height (...) m of the surface at (..., 2) m."""
        flat = np.asarray(xy, float).reshape(-1, 2)
        return np.array([_surface(x, y, self.boxes, self.relief) for x, y in flat]).reshape(np.shape(xy)[:-1])

    def photo(self, camera, T_world_cam, seed=0):
        """A photo (H, W, 3) uint8 of the scene, 2 × 2 rays a pixel, with sensor noise of 1 gray level."""
        total = np.zeros((camera.height, camera.width, 3))
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        for du in (-0.25, 0.25):
            for dv in (-0.25, 0.25):
                rays = camera.rays(np.stack([u + du, v + dv], axis=-1)) @ T_world_cam.R.T
                total += _render(rays, T_world_cam.t, self.boxes, self.relief, self.contrast, 2 * self.relief + 0.1)
        noise = np.random.default_rng(seed).normal(0, 1.0, total.shape)
        return np.clip(total / 4 + noise, 0, 255).astype(np.uint8)


CAMERA = CameraModel(480, 360, 400.0, 401.0, 242.0, 177.0, -0.05, 0.02, 0.001, -0.0005)


def keyframe(index, position, yaw_deg=0.0, tilt=(0.0, 0.0), revision=1, camera=CAMERA):
    """A keyframe looking down at `position` m, rotated by yaw (degrees) and tilt (2,) rad."""
    R = rotation_vector_to_matrix(np.array([0, 0, np.radians(yaw_deg)])) @ DOWN
    R = R @ rotation_vector_to_matrix(np.array([*tilt, 0.0]))
    pose = SE3(R, np.asarray(position, float))
    return Keyframe("flight", index, revision, index * 10**9, f"{index}.jpg", pose, camera, np.full(3, 0.01), b"")


def block(rows=2, columns=4, height=20.0, forward=5.0, side=8.0):
    """Keyframes of a block of parallel strips flown to and fro, with small tilts."""
    rng = np.random.default_rng(4)
    frames = []
    for row in range(rows):
        order = range(columns) if row % 2 == 0 else reversed(range(columns))
        for column in order:
            x, y = (row - (rows - 1) / 2) * side, (column - (columns - 1) / 2) * forward
            tilt = tuple(rng.normal(0, 0.02, 2))
            frames.append(keyframe(len(frames), [x, y, height + rng.normal(0, 0.2)], 180.0 * (row % 2), tilt))
    return frames
