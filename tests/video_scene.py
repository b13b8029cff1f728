"""A small site with fiducials, and a motion that is known in closed form, for tests of the video camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.sources.simulated.camera.camera import daylight
from air.sources.simulated.camera.video import CameraOptions, Poses, SimulatedCamera, draw_lens
from air.sources.simulated.clocks import ClockOptions, Device, DeviceClock
from air.sources.simulated.extrinsics import R_BODY_NADIR
from air.sources.simulated.motion.trajectory import Motion
from air.sources.simulated.sites.baking import fill_levels, periodic_textures
from air.sources.simulated.sites.layout import Bounds, Box
from air.sources.simulated.sites.noise import fractal
from air.sources.simulated.sites.scene import PLAIN
from air.sources.simulated.sites.site import Site
from air.sources.simulated.sites.solids import box_solid, solid_table
from air.sources.simulated.sites.surface import CELL, build_surface, texture_level
from common.camera import CameraModel
from common.se3 import SE3, rotation_vector_to_matrix

BOUNDS = Bounds(-60.0, -45.0, 60.0, 45.0)
TEXEL, BLOB = 0.03, 0.14
MOUNT = SE3(R_BODY_NADIR @ rotation_vector_to_matrix(np.array([0.03, -0.02, 0.01])), np.array([0.1, 0.0, -0.08]))


@dataclass(frozen=True)
class Gliding:
    """Constant velocity m/s and a constant rate of turn rad/s in body axes, from a place on."""

    p: np.ndarray
    v: np.ndarray
    omega: np.ndarray
    duration_s: float = 2.0

    def at(self, t_s: np.ndarray) -> Motion:
        """Motion at times (N,) s."""
        n = len(t_s)
        R = np.stack([rotation_vector_to_matrix(self.omega * t) for t in t_s])
        still = np.zeros((n, 3))
        p = self.p + np.asarray(t_s)[:, None] * self.v
        return Motion(p, np.tile(self.v, (n, 1)), still, R, np.tile(self.omega, (n, 1)), still)


def fiducial_site(blobs: np.ndarray, relief: float = 1.0, boxes: tuple[Box, ...] = ()) -> Site:
    """Dark, rolling ground with a bright spot, a Gaussian of BLOB m, at each of (N, 2) m."""
    rng = np.random.default_rng(3)
    coarse = fractal(rng, BOUNDS.grid(CELL), CELL, ((40.0, relief), (12.0, 0.2 * relief)))
    solids = solid_table(
        [box_solid(b, 0.0, (250, 250, 250), (250, 250, 250), (PLAIN, PLAIN), k) for k, b in enumerate(boxes)]
    )
    surface = build_surface(
        BOUNDS, np.ascontiguousarray(coarse), solids, solid_table([]), TEXEL, daylight(), -np.inf,
        np.zeros(coarse.shape, np.uint8), periodic_textures(rng),
    )  # fmt: skip
    paint = texture_level(surface.colour, surface.colour_at, 0)
    light = np.full(paint.shape[:2], 0.02)
    reach = int(4 * BLOB / TEXEL)
    for x, y in blobs:
        column, row = np.round(BOUNDS.pixels(np.array([x, y]), TEXEL)).astype(int)
        rows, columns = np.mgrid[row - reach : row + reach + 1, column - reach : column + reach + 1]
        dx, dy = BOUNDS.west + columns * TEXEL - x, BOUNDS.south + rows * TEXEL - y
        light[rows, columns] += np.exp(-(dx**2 + dy**2) / (2 * BLOB**2))
    paint[..., :3], paint[..., 3] = np.rint(np.sqrt(light / 1.5) * 255)[..., None], 0
    fill_levels(surface)
    return Site(BOUNDS, surface, daylight(), surface.height)


def camera(site: Site, motion: Gliding, options: CameraOptions, seed: int = 1, clocks: ClockOptions | None = None):
    """A camera on a motion."""
    clock = DeviceClock.draw(clocks or ClockOptions.perfect(), seed, Device.CAMERA, motion.duration_s)
    return SimulatedCamera(site, motion, MOUNT, draw_lens(options, seed)[0], options, seed, clock)


def project(model: CameraModel, poses: Poses, p_world: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of points (N, 3) m, each with the pose of the row that it falls on."""
    rows = np.full(len(p_world), (model.height - 1) / 2)
    for _ in range(6):
        low = np.clip(np.floor(rows), 0, model.height - 2).astype(int)
        part = rows - low
        uv = [
            model.project(np.einsum("nji,nj->ni", poses.R_world_cam[k], p_world - poses.p_world[k]))
            for k in (low, low + 1)
        ]
        pixels = uv[0] + part[:, None] * (uv[1] - uv[0])
        rows = np.clip(pixels[:, 1], 0, model.height - 1.001)
    return pixels
