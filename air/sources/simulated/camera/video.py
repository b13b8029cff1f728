"""The simulated video camera: what it sees on a trajectory, row by row, and the frames that it sends.

Source of the nominal lens: Intel RealSense D400 series data sheet, D455 colour (90° × 65°), and calibrations of such
cameras at 1280 × 720.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import cv2
import numpy as np

from air.sources.simulated.camera import film
from air.sources.simulated.clocks import DeviceClock
from air.sources.simulated.motion.trajectory import Trajectory
from air.sources.simulated.sites import raycast
from air.sources.simulated.sites.site import Site
from common.arrays import F32, F64, I32, U8
from common.camera import CameraModel
from common.config import Range
from common.measurements import CameraFrame, Encoding
from common.se3 import SE3

_LENS, _NOISE, _FRAME = 70, 71, 72
_D455 = CameraModel(1280, 720, 641.0, 641.0, 639.5, 359.5, k1=-0.055, k2=0.045, p1=-0.0005, p2=0.0004)
_NORMALS = 1 << 20
_SENSITIVITY = 207.0
"""Light 1 for a second is so many times white at gain 1."""
_TARGET = 0.19
"""Mean of the image that the exposure control strives for, of white, before gamma."""
_SHORTEST_S, _LARGEST_GAIN = 2e-5, 16.0
_METERED = 8
_SENDING_S = 0.004


@dataclass(frozen=True)
class CameraOptions:
    """What the camera does, and its errors; 0 turns one off.

    `rolling_shutter` µs from row to row; `motion_blur` the share of the exposure over which the image moves;
    `auto_exposure` s, how slowly exposure follows light (0: always `exposure_ms`, gain 1), at most `longest_ms`;
    `vignetting` the light lost in the corners; `lens_blur` px, one sigma; `shot_noise` and `read_noise`, the first
    relative to Poisson's, the second electrons of `full_well`; `dropped` the share of frames that never come;
    `distortion` relative to the nominal lens. `focal_px`, `centre_px` are one sigma of how far the lens is from what
    the calibration says.
    """

    rate_hz: Annotated[float, Range(0.1, 120)] = 30.0
    width: Annotated[int, Range(64, 4096)] = 1280
    height: Annotated[int, Range(48, 3072)] = 720
    rolling_shutter: Annotated[float, Range(0, 200)] = 20.0
    motion_blur: Annotated[float, Range(0, 1)] = 1.0
    auto_exposure: Annotated[float, Range(0, 60)] = 0.4
    exposure_ms: Annotated[float, Range(0.02, 100)] = 4.0
    longest_ms: Annotated[float, Range(0.02, 100)] = 8.0
    vignetting: Annotated[float, Range(0, 1)] = 0.3
    lens_blur: Annotated[float, Range(0, 3)] = 0.45
    shot_noise: Annotated[float, Range(0, 10)] = 1.0
    read_noise: Annotated[float, Range(0, 1000)] = 6.0
    full_well: Annotated[float, Range(100, 1e6)] = 9000.0
    dropped: Annotated[float, Range(0, 1)] = 0.002
    distortion: Annotated[float, Range(0, 2)] = 1.0
    focal_px: Annotated[float, Range(0, 50)] = 0.3
    centre_px: Annotated[float, Range(0, 50)] = 0.3
    encoding: Literal["jpeg", "bgr8", "mono8"] = "jpeg"
    jpeg_quality: Annotated[int, Range(10, 100)] = 92

    @classmethod
    def perfect(cls) -> CameraOptions:
        """A camera without errors: a short, global exposure, and no noise."""
        errors = ("rolling_shutter", "motion_blur", "auto_exposure", "vignetting", "lens_blur", "shot_noise")
        others = ("read_noise", "dropped", "focal_px", "centre_px")
        return cls(**dict.fromkeys(errors + others, 0.0), encoding="bgr8")  # type: ignore[arg-type]


def draw_lens(options: CameraOptions, seed: int) -> tuple[CameraModel, CameraModel]:
    """The true intrinsics of a flight, and the nominal ones that the calibration says."""
    errors = np.random.default_rng([seed, _LENS]).standard_normal(3)
    o, scale = options, options.width / _D455.width
    nominal = replace(
        _D455.scaled(scale), width=o.width, height=o.height, cy=(o.height - 1) / 2,
        **{name: o.distortion * getattr(_D455, name) for name in ("k1", "k2", "p1", "p2")},
    )  # fmt: skip
    focal, cx, cy = errors * [o.focal_px, o.centre_px, o.centre_px]
    true = replace(nominal, fx=nominal.fx + focal, fy=nominal.fy + focal, cx=nominal.cx + cx, cy=nominal.cy + cy)
    return true, nominal


@dataclass(frozen=True, eq=False)
class Poses:
    """`R_world_cam` (H, 3, 3) and `p_world` (H, 3) m of the camera in each row, its velocity `v_cam` (H, 3) m/s and
    `omega_cam` (H, 3) rad/s in its own axes, and `t_s`, the true time of the middle row."""

    R_world_cam: F64
    p_world: F64
    v_cam: F64
    omega_cam: F64
    t_s: float


class Exposure:
    """Exposure time s and gain, which follow the light of the frames before."""

    def __init__(self, options: CameraOptions):
        self._options = options
        self._product: float | None = None if options.auto_exposure else options.exposure_ms * 1e-3

    def settings(self, light: float) -> tuple[float, float]:
        """Exposure time s and gain of a frame, whose mean light serves only where none is known before."""
        if self._product is None:
            self._product = self._wanted(light)
        longest = self._options.longest_ms * 1e-3 if self._options.auto_exposure else self._product
        exposure_s = min(max(self._product, _SHORTEST_S), longest)
        return exposure_s, min(max(self._product / exposure_s, 1.0), _LARGEST_GAIN)

    def learn(self, light: float) -> None:
        """Follow the mean light of a frame."""
        if self._options.auto_exposure and self._product is not None:
            kept = np.exp(-1 / (self._options.rate_hz * self._options.auto_exposure))
            self._product = float(self._product**kept * self._wanted(light) ** (1 - kept))

    def _wanted(self, light: float) -> float:
        return _TARGET / (_SENSITIVITY * max(light, 1e-4))


class SimulatedCamera:
    """The video camera of a flight over a site. `model` is the true lens, `T_body_cam` the true mounting."""

    def __init__(
        self, site: Site, trajectory: Trajectory, T_body_cam: SE3, model: CameraModel, options: CameraOptions,
        seed: int, clock: DeviceClock, name: str = "down",
    ):  # fmt: skip
        self._site, self._trajectory, self._T_body_cam = site, trajectory, T_body_cam
        self._options, self._seed, self._clock, self._name = options, seed, clock, name
        self.model = model
        height, width = model.height, model.width
        v, u = np.mgrid[0:height, 0:width]
        self._rays = np.ascontiguousarray(model.rays(np.stack([u, v], axis=-1))[..., :2], np.float32)
        x, y = 2 * u / (width - 1) - 1, 2 * v / (height - 1) - 1
        lens = np.asarray(1 - options.vignetting * (x * x + y * y) / 2, np.float32)
        self._transmission: F32 = np.repeat(lens[..., None], 3, axis=2)
        self._light: F32 = np.empty((height, width, 3), np.float32)
        self._smeared = np.empty_like(self._light)
        self._depth: F32 = np.empty((height, width), np.float32)
        self._what: I32 = np.empty((height, width), np.int32)
        blocks = -(-height // raycast.BLOCK) * -(-width // raycast.BLOCK)
        self._blocks: I32 = np.empty((blocks, raycast.CANDIDATES + 2), np.int32)
        self._starts: F32 = np.empty(len(self._blocks), np.float32)
        self._chunk: F64 = np.zeros(raycast.CHUNK_ROOM)
        self._texels: raycast.U64 = np.zeros(raycast.TEXEL_ROOM, np.uint64)
        self._normals = np.random.default_rng([seed, _NOISE]).standard_normal(_NORMALS + 3 * width, np.float32)

    @property
    def line_time_s(self) -> float:
        """Time from one row to the next."""
        return self._options.rolling_shutter * 1e-6

    def frames(self) -> Iterator[tuple[float, CameraFrame]]:
        """Frames of the flight, each with the true time s at which its last byte leaves the camera."""
        exposure, first_s = Exposure(self._options), float(self._clock.device_s(np.zeros(1))[0])
        half_s = self.line_time_s * self.model.height / 2 + self._options.longest_ms * 1e-3
        period_s, count = 1 / self._options.rate_hz, int(self._trajectory.duration_s * self._options.rate_hz)
        for index in range(count):
            device_s = np.array([first_s + half_s + (index + 0.5) * period_s])
            t_s = float(self._clock.true_s(device_s)[0])
            rng = np.random.default_rng([self._seed, _FRAME, index])
            if rng.random() < self._options.dropped:
                continue
            image, exposure_s, gain = self.expose(t_s, exposure, rng)
            yield t_s + half_s + _SENDING_S, CameraFrame(
                t_ns=round(float(device_s[0]) * 1e9), camera=self._name, index=index, width=self.model.width,
                height=self.model.height, encoding=Encoding(self._options.encoding), data=self._encoded(image),
                exposure_s=exposure_s, gain=gain, line_time_s=self.line_time_s,
            )  # fmt: skip

    def expose(self, t_s: float, exposure: Exposure, rng: np.random.Generator) -> tuple[U8, float, float]:
        """Image (H, W, 3) uint8 BGR whose middle row is exposed around a true time s; exposure time s and gain."""
        options, poses = self._options, self.poses(t_s)
        light = self.look(poses)
        metered = slice(_METERED // 2, None, _METERED)
        mean = float((light[metered, metered] * self._transmission[metered, metered]).mean())
        exposure_s, gain = exposure.settings(mean)
        exposure.learn(mean)
        if options.motion_blur:
            moving_s = options.motion_blur * exposure_s
            film.smear(
                light, self._depth, self._rays, poses.v_cam, poses.omega_cam, self.model.fx, moving_s, self._smeared
            )
            light = self._smeared
        if options.lens_blur:
            light = cv2.GaussianBlur(light, (3, 3) if options.lens_blur < 0.6 else (0, 0), options.lens_blur)
        image = np.empty(light.shape, np.uint8)
        row = 3 * self.model.width
        film.develop(
            light.reshape(-1, row), self._transmission.reshape(-1, row), _SENSITIVITY * exposure_s * gain,
            options.full_well / gain, options.shot_noise, options.read_noise, self._normals,
            rng.integers(0, _NORMALS, len(light)), image.reshape(-1, row),
        )  # fmt: skip
        return image, exposure_s, gain

    def poses(self, t_s: float) -> Poses:
        """Where the camera is while each row is exposed, the middle of the image at a true time s."""
        height = self.model.height
        rows = t_s + self.line_time_s * (np.arange(height, dtype=float) - (height - 1) / 2)
        motion, mount = self._trajectory.at(rows), self._T_body_cam
        R = motion.R_world_body @ mount.R
        v_body = np.einsum("nji,nj->ni", motion.R_world_body, motion.v_world) + np.cross(motion.omega_body, mount.t)
        p = motion.p_world + motion.R_world_body @ mount.t
        return Poses(R, p, v_body @ mount.R, motion.omega_body @ mount.R, t_s)

    def look(self, poses: Poses) -> F32:
        """Light (H, W, 3) BGR that falls on the sensor behind a perfect lens; overwritten by the next."""
        surface, pace = self._site.at(poses.t_s)
        view = raycast.View(
            self._rays, np.ascontiguousarray(poses.R_world_cam), np.ascontiguousarray(poses.p_world),
            1 / self.model.fx, self.line_time_s, poses.t_s, pace, self._depth, self._what, self._blocks, self._starts,
            self._chunk, self._texels,
        )  # fmt: skip
        raycast.render(surface, self._site.light, view, self._site.sway, self._light)
        return self._light

    def _encoded(self, image: U8) -> bytes:
        if self._options.encoding == "jpeg":
            return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._options.jpeg_quality])[1])
        return (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if self._options.encoding == "mono8" else image).tobytes()
