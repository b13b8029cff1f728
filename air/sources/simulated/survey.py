"""The simulated photo survey, opened as `sim:survey?seed=1&photos=60`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from urllib.parse import parse_qsl

import numpy as np

from air.sources.simulated.camera.camera import Camera, daylight
from air.sources.simulated.motion.flight import plan_survey
from air.sources.simulated.sites.layout import Bounds
from air.sources.simulated.sites.world import generate_world
from air.sources.simulated.truth import SurveyTruth
from air.sources.source import Problem
from common.camera import CameraModel
from common.errors import SourceError
from common.geo import enu_to_geodetic
from common.messages import Datum, GnssFix, Photo
from common.se3 import rotation_vector_to_matrix

HEIGHT, ALONG, ACROSS = 40.0, 8.4, 17.0
"""Above ground, between photos and between lines, m: 78 % forward and 67 % side overlap."""
MARGIN = 45.0
"""How much of the world reaches beyond the outermost cameras, m."""
START_NS = 1_717_232_400 * 1_000_000_000
"""2024-06-01 09:00 GPST."""
ATTITUDE_SIGMA = float(np.radians(2.0))
_FLIGHT, _CAMERA, _GNSS, _GIMBAL, _SENSOR = range(10, 15)


@dataclass(frozen=True)
class SurveyOptions:
    """What the URL may set.

    `gps_noise` is the standard deviation of each coordinate, m, white from photo to photo; `focal_error` the
    relative error of the first guess of the focal length; `angles` whether photos carry the gimbal's attitude.
    """

    seed: int = 1
    photos: int = 60
    gps_noise: float = 1.5
    focal_error: float = 0.03
    angles: int = 1


_RANGES: dict[str, tuple[Callable[[str], float], float, float]] = {
    "seed": (int, 0, 2**31 - 1),
    "photos": (int, 2, 500),
    "gps_noise": (float, 0.001, 100.0),
    "focal_error": (float, -0.5, 1.0),
    "angles": (int, 0, 1),
}


class Survey:
    """A simulated flight over a simulated village. Photos are rendered while they are read, the same every time."""

    def __init__(self, url: str, options: SurveyOptions):
        self._url = url
        self.options = options

    @property
    def url(self) -> str:
        """The URL that opened the survey."""
        return self._url

    @property
    def problems(self) -> Sequence[Problem]:
        """None: simulated photos are sound."""
        return ()

    def __len__(self) -> int:
        return self.options.photos

    def __iter__(self) -> Iterator[Photo]:
        return map(self.photo, range(len(self)))

    @cached_property
    def truth(self) -> SurveyTruth:
        """Datum, camera, poses and world; generated when first asked for."""
        seed, photos = self.options.seed, self.options.photos
        flight = plan_survey(np.random.default_rng([seed, _FLIGHT]), photos, START_NS, HEIGHT, ALONG, ACROSS)
        p_cam = np.array([pose.t[:2] for pose in flight.T_world_cam])
        (west, south), (east, north) = p_cam.min(0) - MARGIN, p_cam.max(0) + MARGIN
        return SurveyTruth(
            datum=Datum(f"2024-06-01T09-00-00-sim{seed}", 30.5355, 114.3655, 62.0),
            camera=_true_camera(np.random.default_rng([seed, _CAMERA])),
            t_ns=flight.t_ns,
            T_world_cam=flight.T_world_cam,
            world=generate_world(seed, Bounds(float(west), float(south), float(east), float(north))),
        )

    def photo(self, i: int) -> Photo:
        """Photo `i` of the flight."""
        return Photo(
            t_ns=self.truth.t_ns[i],
            name=f"SIM_{i + 1:04d}.jpg",
            jpeg=self._camera.photograph(self.truth.world.scene, self.truth.T_world_cam[i], self._rng(_SENSOR, i)),
            camera=self._first_guess,
            fix=self.fix(i),
            R_enu_cam=self._gimbal(i) if self.options.angles else None,
            attitude_sigma=ATTITUDE_SIGMA if self.options.angles else 0.0,
        )

    @cached_property
    def _camera(self) -> Camera:
        return Camera(self.truth.camera, daylight())

    @cached_property
    def _first_guess(self) -> CameraModel:
        width, height = self.truth.camera.width, self.truth.camera.height
        focal = self.truth.camera.fx * (1 + self.options.focal_error)
        return CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    def fix(self, i: int) -> GnssFix:
        """The GNSS position of photo `i`: truth and white noise."""
        sigma = self.options.gps_noise
        p_world = self.truth.T_world_cam[i].t + sigma * self._rng(_GNSS, i).standard_normal(3)
        latitude, longitude, height = (float(value) for value in enu_to_geodetic(self.truth.datum, p_world))
        return GnssFix(latitude, longitude, height, sigma, sigma)

    def _gimbal(self, i: int) -> np.typing.NDArray[np.float64]:
        error = ATTITUDE_SIGMA * self._rng(_GIMBAL, i).standard_normal(3)
        return np.asarray(self.truth.T_world_cam[i].R @ rotation_vector_to_matrix(error))

    def _rng(self, part: int, i: int) -> np.random.Generator:
        return np.random.default_rng([self.options.seed, part, i])


def open_survey(url: str, rest: str) -> Survey:
    """The survey of a URL `sim:survey?key=value&…`. Raises SourceError for an unknown flight or option."""
    flight, _, query = rest.partition("?")
    if flight != "survey":
        raise SourceError(f"source {url!r}: there is no simulated flight {flight!r}; there is sim:survey")
    return Survey(url, _parse_options(url, query))


def _parse_options(url: str, query: str) -> SurveyOptions:
    values: dict[str, float] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in _RANGES:
            known = ", ".join(field.name for field in fields(SurveyOptions))
            raise SourceError(f"source {url!r}: unknown option {key!r} (value {text!r}); allowed are {known}")
        if key in values:
            raise SourceError(f"source {url!r}: option {key!r} is given twice; give it once")
        kind, low, high = _RANGES[key]
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            what = "a whole number" if kind is int else "a number"
            raise SourceError(f"source {url!r}: option {key!r} is {text!r}, must be {what} from {low} to {high}")
        values[key] = value
    return SurveyOptions(**values)  # type: ignore[arg-type]  # the parsers give the fields' types


def _true_camera(rng: np.random.Generator) -> CameraModel:
    """A lens like those of small drones: a little distorted, a few pixels off centre."""
    focal = 1000.0 + rng.uniform(-15, 15)
    cx, cy = 639.5 + rng.uniform(-6, 6), 479.5 + rng.uniform(-6, 6)
    return CameraModel(
        1280, 960, focal, focal, cx, cy, k1=-0.06 + rng.uniform(-0.01, 0.01), k2=0.04 + rng.uniform(-0.01, 0.01)
    )
