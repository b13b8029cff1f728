"""The reconstruction: cameras, poses and points that hold together, and the operations that make it grow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from air.alignment.bundle import BundleProblem, BundleSolution, CameraPrior, PosePrior, adjust
from air.alignment.geometry import reprojection_error, resect, triangulate
from air.alignment.georeference import Similarity
from air.alignment.points import Points
from air.alignment.selection import select_tracks
from air.alignment.settings import AlignmentSettings
from air.alignment.tracks import Observations, Tracks
from common.arrays import F64, I64
from common.camera import CameraModel
from common.se3 import SE3

TRIALS = 3
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a two-dimensional error of sigma one."""
MIN_VIEWS = 2


@dataclass(eq=False)
class Reconstruction:
    """Photos by index, points by track; photos of one `component` share points, all lie in the world frame.

    `scale_of` gives full-image px per working px of a photo: the settings' px count on the working image, as does
    `limit_px`, the residual beyond which an observation is taken for an outlier.
    """

    settings: AlignmentSettings
    tracks: Tracks = field(default_factory=Tracks)
    uv: dict[int, F64] = field(default_factory=dict)
    scale_of: dict[int, float] = field(default_factory=dict)
    cameras: list[CameraModel] = field(default_factory=list)
    camera_priors: list[CameraPrior] = field(default_factory=list)
    camera_of: dict[int, int] = field(default_factory=dict)
    priors: dict[int, PosePrior] = field(default_factory=dict)
    poses: dict[int, SE3] = field(default_factory=dict)
    sigmas: dict[int, F64] = field(default_factory=dict)
    component: dict[int, int] = field(default_factory=dict)
    points: Points = field(default_factory=Points)
    limit_px: float = field(init=False)
    _rays: dict[int, tuple[CameraModel, F64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.limit_px = self.settings.resection_px

    def add_photo(self, photo: int, uv: F64, scale: float, camera: CameraModel, prior: PosePrior) -> None:
        """Make a photo known: its features (N, 2) px, its camera's first guess, and what is known of its pose."""
        self.uv[photo], self.scale_of[photo], self.priors[photo] = uv, scale, prior
        self.tracks.add_photo(photo, len(uv))
        self.camera_of[photo] = self._camera(camera)

    def _camera(self, guess: CameraModel) -> int:
        for i, prior in enumerate(self.camera_priors):
            if prior.guess == guess:
                return i
        s = self.settings
        self.cameras.append(guess)
        self.camera_priors.append(
            CameraPrior(guess, s.focal_sigma * guess.fx / guess.width, s.principal_sigma, s.radial_sigma)
        )
        return len(self.cameras) - 1

    def camera(self, photo: int) -> CameraModel:
        """The camera of a photo as estimated now."""
        return self.cameras[self.camera_of[photo]]

    def photos(self, component: int) -> list[int]:
        """The placed photos of a component, in order."""
        return sorted(i for i, c in self.component.items() if c == component)

    def seen_points(self, photo: int) -> tuple[I64, I64]:
        """Features (K,) of a photo whose track has a point, and those tracks (K,)."""
        of = self.tracks.of(photo)
        features = np.flatnonzero(self.points.known(of))
        return features, of[features]

    def tracks_of(self, photos: Iterable[int]) -> I64:
        """Tracks (K,) with a point that any of the photos sees."""
        seen = [self.seen_points(i)[1] for i in photos]
        return np.unique(np.concatenate(seen)) if seen else np.zeros(0, np.int64)

    def depth(self, photo: int) -> float:
        """Median distance along the optical axis of the points that a placed photo sees, m; 0 when it sees none."""
        _, tracks = self.seen_points(photo)
        if not len(tracks):
            return 0.0
        return float(np.median(self.poses[photo].inverse().apply(self.points.at(tracks))[:, 2]))

    def place(self, photo: int, pose: SE3, component: int) -> None:
        """Set the pose of a photo for the first time."""
        self.poses[photo], self.component[photo] = pose, component

    def move(self, photos: Iterable[int], similarity: Similarity) -> None:
        """Move placed photos and the points that they see."""
        photos = list(photos)
        tracks = self.tracks_of(photos)
        for photo in photos:
            self.poses[photo] = similarity.pose(self.poses[photo])
        self.points.put(tracks, similarity.points(self.points.at(tracks)))

    def dissolve(self, component: int) -> None:
        """Take back the poses and points of a component; its photos can be placed again."""
        for photo in self.photos(component):
            self.points.forget(self.seen_points(photo)[1])
            del self.poses[photo], self.component[photo]

    def resect(self, photo: int) -> int | None:
        """Place a photo on the points it shares with a component; the component, or None if too few agree."""
        features, tracks = self.seen_points(photo)
        owner = self._owners(tracks)
        components, supports = np.unique(owner, return_counts=True)
        for component in components[np.argsort(-supports, kind="stable")].tolist():
            mine = np.flatnonzero(owner == component)
            if len(mine) < self.settings.min_resection:
                return None
            p, uv = self.points.at(tracks[mine]), self.uv[photo][features[mine]]
            found = resect(self.camera(photo), p, uv, self.settings.resection_px * self.scale_of[photo])
            if found is not None and found[1].sum() >= self.settings.min_resection:
                self.place(photo, found[0], component)
                for track in tracks[mine[~found[1]]].tolist():
                    self.tracks.drop(track, photo)
                return int(component)
        return None

    def _owners(self, tracks: I64) -> I64:
        """The component (K,) of each track with a point: that of the first placed photo that sees it."""
        owner = np.full(len(tracks), -1, np.int64)
        seen = self.tracks.observations(tracks, sorted(self.component, reverse=True))
        for i in np.unique(seen.photo)[::-1].tolist():
            owner[seen.row[seen.photo == i]] = self.component[i]
        return owner

    def triangulate(self, photos: Iterable[int]) -> None:
        """Give points to the tracks of placed photos that have none yet and are seen from far enough apart.

        An observation that misses the point by more than `limit_px` and more than the others of its track leaves it;
        the rest is tried again.
        """
        seen = np.unique(np.concatenate([self.tracks.of(i) for i in photos]))
        tracks = seen[(seen >= 0) & ~self.points.known(seen)]
        for _ in range(TRIALS):
            tracks = self._triangulate(tracks)

    def _triangulate(self, tracks: I64) -> I64:
        """Set the points of tracks on which all observations agree; the tracks that lost one and may do now."""
        seen = self._observations(tracks)
        if not len(seen.photo):
            return np.zeros(0, np.int64)
        centres, directions = np.zeros((len(seen.photo), 3)), np.zeros((len(seen.photo), 3))
        errors = np.full(len(seen.photo), np.inf)
        groups = [(i, np.flatnonzero(seen.photo == i)) for i in np.unique(seen.photo).tolist()]
        for i, rows in groups:
            centres[rows] = self.poses[i].t
            directions[rows] = self._directions(i)[seen.feature[rows]] @ self.poses[i].R.T
        points, angle = triangulate(directions, centres, seen.row, len(tracks))
        for i, rows in groups:
            uv = self.uv[i][seen.feature[rows]]
            error = reprojection_error(self.camera(i), self.poses[i], points[seen.row[rows]], uv)
            errors[rows] = error / self.scale_of[i]
        worst = np.zeros(len(tracks))
        np.maximum.at(worst, seen.row, errors)
        good = (worst < self.limit_px) & (angle > np.radians(self.settings.min_angle_deg))
        self.points.put(tracks[good], points[good])
        again = set()
        for k in np.flatnonzero((errors >= self.limit_px) & (errors == worst[seen.row])).tolist():
            track = int(tracks[seen.row[k]])
            if len(self.tracks.members(track)) > MIN_VIEWS:
                self.tracks.drop(track, int(seen.photo[k]))
                again.add(track)
        return np.array(sorted(again), np.int64)

    def _observations(self, tracks: I64) -> Observations:
        """What placed photos see of each track, of those in the component that sees most of it, at least two."""
        seen = self.tracks.observations(tracks, sorted(self.poses))
        component_of = np.zeros(1 + max(self.component, default=0), np.int64)
        component_of[list(self.component)] = list(self.component.values())
        component = component_of[seen.photo]
        count = np.zeros((len(tracks), 1 + component_of.max()), np.int64)
        np.add.at(count, (seen.row, component), 1)
        owner = count.argmax(axis=1)
        return seen.only((component == owner[seen.row]) & (count.max(axis=1)[seen.row] >= MIN_VIEWS))

    def _directions(self, photo: int) -> F64:
        """Unit rays (N, 3) of all features of a photo in its camera's frame, kept until the camera changes."""
        camera, known = self.camera(photo), self._rays.get(photo)
        if known is None or known[0] is not camera:
            rays = camera.rays(self.uv[photo])
            known = self._rays[photo] = camera, rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return known[1]

    def retrack(self, matches: dict[tuple[int, int], I64]) -> None:
        """Form all tracks and points again from the matches: poses are better now, so good matches come back."""
        self.limit_px = self._judge()
        self.tracks = Tracks()
        self.points = Points()
        for photo, uv in self.uv.items():
            self.tracks.add_photo(photo, len(uv))
        for (a, b), pairs in matches.items():
            self.tracks.link(a, b, pairs)
        self.triangulate(self.poses)

    def adjust(self, free: list[int], fixed: list[int], calibrate: bool, per_photo: int, final: bool) -> None:
        """Adjust the poses of `free` photos and the points that they see, held by `fixed` photos; drop outliers."""
        photos = [*free, *fixed]
        tracks = select_tracks(self, photos, per_photo)
        seen = self.tracks.observations(tracks, photos)
        photo, uv = np.zeros(len(seen.photo), np.int64), np.zeros((len(seen.photo), 2))
        for k, i in enumerate(photos):
            rows = seen.photo == i
            photo[rows], uv[rows] = k, self.uv[i][seen.feature[rows]]
        scale = float(np.median([self.scale_of[i] for i in photos]))
        used = sorted({self.camera_of[i] for i in photos})
        try:
            solution = adjust(
                BundleProblem(
                    cameras=[self.cameras[c] for c in used],
                    camera_priors=[self.camera_priors[c] for c in used],
                    camera_of=[used.index(self.camera_of[i]) for i in photos],
                    poses=[self.poses[i] for i in photos],
                    pose_priors=[self.priors[i] for i in photos],
                    fixed=np.array([False] * len(free) + [True] * len(fixed)),
                    points=self.points.at(tracks),
                    photo=photo,
                    point=seen.row,
                    uv=uv,
                    pixel_sigma=self.settings.pixel_sigma * scale,
                    calibrate=calibrate,
                    final=final,
                )
            )
        except RuntimeError:
            # gtsam names an undetermined point or pose: keep what is there, the next photo adds what is missing.
            return
        for c, camera in zip(used, solution.cameras, strict=True):
            self.cameras[c] = camera
        self._accept(solution, free, photos, tracks)

    def _accept(self, solution: BundleSolution, free: list[int], photos: list[int], tracks: I64) -> None:
        for k, i in enumerate(photos[: len(free)]):
            self.poses[i] = solution.poses[k]
            if solution.sigma is not None:
                self.sigmas[i] = solution.sigma[k]
        self.points.forget(self.tracks_of(free))
        self.points.put(tracks, solution.points)
        self.triangulate(free)

    def prune(self, photos: Iterable[int]) -> None:
        """Drop the observations of photos that miss their point by more than `limit_px`, and lone points."""
        for photo in photos:
            _, tracks = self.seen_points(photo)
            for track in tracks[self._residuals_px(photo) > self.limit_px * self.scale_of[photo]].tolist():
                self.tracks.drop(track, photo)
                if sum(i in self.poses for i in self.tracks.members(track)) < MIN_VIEWS:
                    self.points.forget(np.array([track]))

    def _judge(self) -> float:
        """Residual, working px, beyond which an observation is an outlier: four robust sigmas, within the settings."""
        errors = self.residuals_px() / np.median(list(self.scale_of.values()))
        sigma = float(np.median(errors)) / RAYLEIGH_MEDIAN if len(errors) else 0.0
        return float(np.clip(4.0 * sigma, self.settings.max_residual_px, self.settings.resection_px))

    def residuals_px(self) -> F64:
        """Reprojection errors (M,) of all observations of placed photos, px of the full image."""
        return np.concatenate([np.zeros(0), *(self._residuals_px(photo) for photo in sorted(self.poses))])

    def _residuals_px(self, photo: int) -> F64:
        features, tracks = self.seen_points(photo)
        p, uv = self.points.at(tracks), self.uv[photo][features]
        return reprojection_error(self.camera(photo), self.poses[photo], p, uv)
