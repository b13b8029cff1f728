"""The reconstruction: cameras, poses and points that hold together, and the operations that make it grow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from air.alignment.bundle import BundleProblem, BundleSolution, CameraPrior, PosePrior, adjust
from air.alignment.geometry import reprojection_error, resect, triangulate
from air.alignment.selection import select_tracks
from air.alignment.settings import AlignmentSettings
from air.alignment.tracks import Tracks
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
    points: dict[int, F64] = field(default_factory=dict)
    limit_px: float = field(init=False)

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

    def seen_points(self, photo: int) -> tuple[list[int], list[int]]:
        """Features of a photo whose track has a point, and those tracks."""
        of = self.tracks.of(photo)
        features = [f for f in np.flatnonzero(of >= 0).tolist() if int(of[f]) in self.points]
        return features, [int(of[f]) for f in features]

    def depth(self, photo: int) -> float:
        """Median distance along the optical axis of the points that a placed photo sees, m; 0 when it sees none."""
        _, tracks = self.seen_points(photo)
        if not tracks:
            return 0.0
        p = np.array([self.points[t] for t in tracks])
        return float(np.median(self.poses[photo].inverse().apply(p)[:, 2]))

    def place(self, photo: int, pose: SE3, component: int) -> None:
        """Set the pose of a photo for the first time."""
        self.poses[photo], self.component[photo] = pose, component

    def dissolve(self, component: int) -> None:
        """Take back the poses and points of a component; its photos can be placed again."""
        for photo in self.photos(component):
            for track in self.seen_points(photo)[1]:
                del self.points[track]
            del self.poses[photo], self.component[photo]

    def resect(self, photo: int) -> int | None:
        """Place a photo on the points it shares with a component; the component, or None if too few agree."""
        features, tracks = self.seen_points(photo)
        owner = [self._owner(t) for t in tracks]
        for component in sorted(set(owner), key=owner.count, reverse=True):
            mine = [k for k, o in enumerate(owner) if o == component]
            if len(mine) < self.settings.min_resection:
                return None
            p = np.array([self.points[tracks[k]] for k in mine])
            uv = self.uv[photo][[features[k] for k in mine]]
            found = resect(self.camera(photo), p, uv, self.settings.resection_px * self.scale_of[photo])
            if found is not None and found[1].sum() >= self.settings.min_resection:
                self.place(photo, found[0], component)
                for k, inlier in zip(mine, found[1], strict=True):
                    if not inlier:
                        self.tracks.drop(tracks[k], photo)
                return component
        return None

    def _owner(self, track: int) -> int:
        placed = [i for i in self.tracks.members(track) if i in self.component]
        return self.component[placed[0]] if placed else -1

    def triangulate(self, photos: Iterable[int]) -> None:
        """Give points to the tracks of placed photos that have none yet and are seen from far enough apart.

        An observation that misses the point by more than `limit_px` and more than the others of its track leaves it;
        the rest is tried again.
        """
        tracks = {t for i in photos for t in np.unique(self.tracks.of(i)).tolist() if t >= 0 and t not in self.points}
        for _ in range(TRIALS):
            tracks = self._triangulate(sorted(tracks))

    def _triangulate(self, tracks: list[int]) -> set[int]:
        """Set the points of tracks on which all observations agree; the tracks that lost one and may do now."""
        photo, feature, point = self._observations(tracks)
        if not len(photo):
            return set()
        centres = np.array([self.poses[i].t for i in photo.tolist()])
        directions, errors = np.zeros((len(photo), 3)), np.full(len(photo), np.inf)
        groups = [(i, np.flatnonzero(photo == i)) for i in np.unique(photo).tolist()]
        for i, rows in groups:
            rays = self.camera(i).rays(self.uv[i][feature[rows]])
            directions[rows] = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ self.poses[i].R.T
        points, angle = triangulate(directions, centres, point, len(tracks))
        for i, rows in groups:
            uv = self.uv[i][feature[rows]]
            error = reprojection_error(self.camera(i), self.poses[i], points[point[rows]], uv)
            errors[rows] = error / self.scale_of[i]
        worst = np.zeros(len(tracks))
        np.maximum.at(worst, point, errors)
        good = (worst < self.limit_px) & (angle > np.radians(self.settings.min_angle_deg))
        for j in np.flatnonzero(good).tolist():
            self.points[tracks[j]] = points[j]
        again = set()
        for row in np.flatnonzero((errors >= self.limit_px) & (errors == worst[point])).tolist():
            track = tracks[point[row]]
            if len(self.tracks.members(track)) > MIN_VIEWS:
                self.tracks.drop(track, int(photo[row]))
                again.add(track)
        return again

    def _observations(self, tracks: list[int]) -> tuple[I64, I64, I64]:
        """Photo, feature and row of the track (M,) of all observations in the largest component that sees each."""
        rows = []
        for j, track in enumerate(tracks):
            placed = [(i, f) for i, f in self.tracks.members(track).items() if i in self.component]
            owners = [self.component[i] for i, _ in placed]
            if owners:
                owner = max(set(owners), key=lambda c: (owners.count(c), -c))
                mine = [(i, f, j) for (i, f), c in zip(placed, owners, strict=True) if c == owner]
                rows += mine if len(mine) >= MIN_VIEWS else []
        photo, feature, point = np.array(rows, np.int64).reshape(-1, 3).T
        return photo, feature, point

    def retrack(self, matches: dict[tuple[int, int], I64]) -> None:
        """Form all tracks and points again from the matches: poses are better now, so good matches come back."""
        self.limit_px = self._judge()
        self.tracks = Tracks()
        self.points = {}
        for photo, uv in self.uv.items():
            self.tracks.add_photo(photo, len(uv))
        for (a, b), pairs in matches.items():
            self.tracks.link(a, b, pairs)
        self.triangulate(self.poses)

    def adjust(self, free: list[int], fixed: list[int], calibrate: bool, per_photo: int, final: bool) -> None:
        """Adjust the poses of `free` photos and the points that they see, held by `fixed` photos; drop outliers."""
        photos = [*free, *fixed]
        tracks = select_tracks(self, photos, per_photo)
        rows = [
            (k, j, self.tracks.members(t)[i])
            for j, t in enumerate(tracks)
            for k, i in enumerate(photos)
            if i in self.tracks.members(t)
        ]
        photo, point, feature = np.array(rows, np.int64).reshape(-1, 3).T
        uv = np.array([self.uv[photos[k]][f] for k, f in zip(photo, feature, strict=True)]).reshape(-1, 2)
        scale = float(np.median([self.scale_of[i] for i in photos]))
        try:
            solution = adjust(
                BundleProblem(
                    cameras=self.cameras,
                    camera_priors=self.camera_priors,
                    camera_of=[self.camera_of[i] for i in photos],
                    poses=[self.poses[i] for i in photos],
                    pose_priors=[self.priors[i] for i in photos],
                    fixed=np.array([False] * len(free) + [True] * len(fixed)),
                    points=np.array([self.points[t] for t in tracks]).reshape(-1, 3),
                    photo=photo,
                    point=point,
                    uv=uv,
                    pixel_sigma=self.settings.pixel_sigma * scale,
                    calibrate=calibrate,
                    final=final,
                )
            )
        except RuntimeError:
            # gtsam names an undetermined point or pose: keep what is there, the next photo adds what is missing.
            return
        self._accept(solution, free, photos, tracks)

    def _accept(self, solution: BundleSolution, free: list[int], photos: list[int], tracks: list[int]) -> None:
        self.cameras = list(solution.cameras)
        for k, i in enumerate(photos[: len(free)]):
            self.poses[i] = solution.poses[k]
            if solution.sigma is not None:
                self.sigmas[i] = solution.sigma[k]
        for t in {t for i in free for t in self.seen_points(i)[1]}:
            del self.points[t]
        for t, p in zip(tracks, solution.points, strict=True):
            self.points[t] = p
        self.triangulate(free)

    def prune(self, photos: Iterable[int]) -> int:
        """Drop the observations of photos that miss their point by more than `limit_px`, and lone points.

        Returns how many were dropped.
        """
        dropped = 0
        for photo in photos:
            features, tracks = self.seen_points(photo)
            if not tracks:
                continue
            p = np.array([self.points[t] for t in tracks])
            error = reprojection_error(self.camera(photo), self.poses[photo], p, self.uv[photo][features])
            for k in np.flatnonzero(error > self.limit_px * self.scale_of[photo]).tolist():
                self.tracks.drop(tracks[k], photo)
                dropped += 1
                if sum(i in self.poses for i in self.tracks.members(tracks[k])) < 2:
                    del self.points[tracks[k]]
        return dropped

    def _judge(self) -> float:
        """Residual, working px, beyond which an observation is an outlier: four robust sigmas, within the settings."""
        errors = self.residuals_px() / np.median(list(self.scale_of.values()))
        sigma = float(np.median(errors)) / RAYLEIGH_MEDIAN if len(errors) else 0.0
        return float(np.clip(4.0 * sigma, self.settings.max_residual_px, self.settings.resection_px))

    def residuals_px(self) -> F64:
        """Reprojection errors (M,) of all observations of placed photos, px of the full image."""
        errors = [np.zeros(0)]
        for photo in sorted(self.poses):
            features, tracks = self.seen_points(photo)
            if tracks:
                p = np.array([self.points[t] for t in tracks])
                errors.append(reprojection_error(self.camera(photo), self.poses[photo], p, self.uv[photo][features]))
        return np.concatenate(errors)
