"""Alignment: where each photo was taken, found photo by photo and improved with every further one."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from air.alignment.bundle import PosePrior
from air.alignment.geometry import relative_pose, triangulate_pair
from air.alignment.georeference import Similarity, georeference
from air.alignment.matching import match
from air.alignment.prepare import Features, PreparedPhoto, thumbnail
from air.alignment.priors import pair_prior, pose_prior, position, step
from air.alignment.reconstruction import Reconstruction
from air.alignment.settings import AlignmentSettings
from air.alignment.status import PhotoStatus, State
from air.jump import Jump
from common.arrays import F64, I64
from common.camera import CameraModel
from common.messages import Datum, GnssFix, Keyframe, Photo
from common.se3 import SE3

CALIBRATE_SPREAD = 0.15
"""Extent of the block across its strips from which the intrinsics are adjusted: one strip leaves them undetermined."""
FINAL_ROUNDS, FINAL_OBSERVATIONS = 1, 45_000
LOCAL_FREE = 6
LOCAL_FIXED = 12
MIN_PAIR_ANGLE_DEG = 2.0


@dataclass(eq=False)
class _Entry:
    photo: Photo
    thumbnail: bytes
    features: Features
    p_ecef: F64 | None
    revision: int = 0
    published: tuple[SE3, CameraModel] | None = None


class Alignment:
    """Incremental alignment of photos.

    `add` takes prepared photos in any order and returns the keyframes that are new or have moved; `move` follows the
    odometry's world; `finish` adjusts everything once more and returns what moved. Photos that fit nowhere wait, and
    are placed when others connect them.
    """

    def __init__(self, flight: str, settings: AlignmentSettings | None = None) -> None:
        self.settings = settings or AlignmentSettings()
        self.flight = flight
        self.datum: Datum | None = None
        self._entries: dict[int, _Entry] = {}
        self._faults: dict[int, str] = {}
        self._names: list[str] = []
        self._digests: dict[bytes, str] = {}
        self._matches: dict[tuple[int, int], I64] = {}
        self._block = Reconstruction(self.settings)
        self._adjusted = 0
        self._components = 0

    def add(self, prepared: PreparedPhoto) -> list[Keyframe]:
        """Keyframes that are new or moved through one more photo."""
        index = self._register(prepared)
        if index is None:
            return []
        self._match(index)
        self._grow()
        return self._moved(self.settings.moved)

    def move(self, jump: Jump) -> list[Keyframe]:
        """Keyframes that moved because the world did in which the odometry had placed their photos."""
        moved = {i for i, entry in self._entries.items() if jump.moves(entry.photo)}
        for i in moved:
            entry = self._entries[i]
            entry.photo = jump.moved(entry.photo)
            entry.p_ecef = position(entry.photo)
            self._block.priors[i] = self._prior(entry.photo)
        if self.datum is not None:
            # What stands half on other fixes as well settles between them when all photos are adjusted next.
            blocks = [self._block.photos(component) for component in range(self._components)]
            along = [i for block in blocks if 2 * len(moved & set(block)) > len(block) for i in block]
            T = jump.at(self.datum)
            self._block.move(along, Similarity(1.0, T.R, T.t))
        return self._moved(self.settings.moved)

    def finish(self) -> list[Keyframe]:
        """All keyframes after the final adjustment of all photos."""
        self._grow()
        if self.placed:
            self._adjust_all(final=True)
        return self._moved(threshold=-1.0)

    def ground_height(self) -> float | None:
        """Median height of the points of the ground, m in world; None while there are none."""
        points = self._block.points.all()
        return float(np.median(points[:, 2])) if len(points) else None

    @property
    def placed(self) -> int:
        """How many photos have a pose."""
        return len(self._block.poses)

    @property
    def cameras(self) -> list[CameraModel]:
        """The cameras of the placed photos as estimated now, the one with most photos first."""
        used = Counter(self._block.camera_of[i] for i in sorted(self._block.poses))
        return [self._block.cameras[c] for c, _ in used.most_common()]

    def residual_px(self) -> float:
        """Root mean square of the reprojection errors, px of the full image."""
        errors = self._block.residuals_px()
        return float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0

    def statuses(self) -> list[PhotoStatus]:
        """What became of every photo, in the order of arrival."""
        sizes = [len(self._block.photos(c)) for c in range(self._components)]
        return [self._status(i, sizes) for i in range(len(self._names))]

    def _status(self, i: int, sizes: list[int]) -> PhotoStatus:
        name = self._names[i]
        if i in self._faults:
            return PhotoStatus(name, State.REJECTED, self._faults[i])
        no_fix = self._entries[i].p_ecef is None
        if i not in self._block.poses:
            reason = "matches no photo that could be placed: another place, or too little overlap"
            return PhotoStatus(name, State.WAITING, reason + ("; it has no GPS position" if no_fix else ""))
        reason = "no GPS position: placed by its neighbours" if no_fix else ""
        if sizes[self._block.component[i]] < max(sizes):
            reason = "not connected with the main block: placed by GPS with the few photos that it matches"
        return PhotoStatus(name, State.PLACED, reason)

    def _register(self, prepared: PreparedPhoto) -> int | None:
        """The index of a usable photo, made known to the reconstruction; None (and the fault) for an unusable one."""
        index, photo = len(self._names), prepared.photo
        self._names.append(photo.name)
        fault = prepared.fault
        if prepared.digest in self._digests:
            fault = f"the same file as {self._digests[prepared.digest]}"
        self._digests.setdefault(prepared.digest, photo.name)
        if fault is not None or prepared.image is None or prepared.features is None or prepared.camera is None:
            self._faults[index] = fault or "no image"
            return None
        self._entries[index] = _Entry(photo, thumbnail(prepared.image), prepared.features, position(photo))
        scale = max(1.0, max(prepared.image.shape[:2]) / self.settings.working_px)
        uv = prepared.features.uv.astype(np.float64)
        self._block.add_photo(index, uv, scale, prepared.camera, self._prior(photo))
        return index

    def _prior(self, photo: Photo) -> PosePrior:
        return pose_prior(photo, self.datum, self.settings.nadir_sigma_deg)

    def _match(self, index: int) -> None:
        block, mine = self._block, self._entries[index].features
        others = self._neighbours(index)
        features = [self._entries[other].features for other in others]
        with ThreadPoolExecutor(self.settings.threads) as pool:
            found = pool.map(lambda theirs: match(theirs, mine, self.settings, block.scale_of[index]), features)
        for other, pairs in zip(others, found, strict=True):
            if len(pairs):
                self._matches[other, index] = pairs
                block.tracks.link(other, index, pairs)

    def _neighbours(self, index: int) -> list[int]:
        """Earlier photos that may show the same ground: the nearest by GPS, and the latest where there is none."""
        mine = self._entries[index].p_ecef
        others = [i for i in self._entries if i != index]
        by_time = others[-self.settings.neighbours // 2 :]
        if mine is None:
            return by_time
        located = {i: p for i in others if (p := self._entries[i].p_ecef) is not None}
        distance = {i: float(np.linalg.norm(p - mine)) for i, p in located.items()}
        reach = self._reach()
        near = sorted((i for i in located if distance[i] < reach), key=lambda i: distance[i])
        return near[: self.settings.neighbours] + [i for i in by_time if i not in located]

    def _reach(self) -> float:
        """Distance beyond which two photos cannot overlap, m: the diagonal of a footprint, once heights are known."""
        if not self._block.poses:
            return np.inf
        last = max(self._block.poses)
        camera = self._block.camera(last)
        sigma = max((e.photo.fix.sigma_horizontal for e in self._entries.values() if e.photo.fix), default=0.0)
        return self._block.depth(last) * float(np.hypot(camera.width, camera.height)) / camera.fx + 3.0 * sigma

    def _grow(self) -> None:
        """Place every photo that can be placed now, start a block where none can, and adjust."""
        while self._place_best() or self._start():
            self._adjust_if_due()

    def _place_best(self) -> bool:
        block = self._block
        support = {i: len(block.seen_points(i)[1]) for i in self._entries if i not in block.poses}
        for i in sorted(support, key=lambda i: -support[i]):
            component = block.resect(i) if support[i] >= self.settings.min_resection else None
            if component is None:
                component = self._attach(i)
            if component is not None:
                self._merge_into(component, i)
                block.triangulate([i])
                self._adjust_around(i)
                return True
        return False

    def _attach(self, photo: int) -> int | None:
        """Place a photo that shares too few points by its relative pose to the placed photo that it matches best.

        Strips with less than half overlap have no point in three photos; the length of the step then comes from GPS.
        """
        pairs = sorted((p for p in self._matches if photo in p), key=lambda p: -len(self._matches[p]))
        for a, b in pairs:
            other = a if b == photo else b
            if other not in self._block.poses:
                continue
            found = self._relative_pose(other, photo)
            length = step(self._entries[other].photo, self._entries[photo].photo)
            if found is not None and length is not None:
                T = self._block.poses[other] @ SE3(found.R, found.t * length)
                self._block.place(photo, T, self._block.component[other])
                return self._block.component[other]
        return None

    def _relative_pose(self, a: int, b: int) -> SE3 | None:
        """`T_a_b` with a translation of length one from the matches of two photos; None if they do not tell it."""
        block = self._block
        pairs = self._matches[a, b] if (a, b) in self._matches else self._matches[b, a][:, ::-1]
        uv_a, uv_b = block.uv[a][pairs[:, 0]], block.uv[b][pairs[:, 1]]
        camera_a, camera_b = block.camera(a), block.camera(b)
        threshold_px = self.settings.verify_px * block.scale_of[a]
        prior = pair_prior(self._entries[a].photo, self._entries[b].photo, self.settings.nadir_sigma_deg)
        found = relative_pose(camera_a, camera_b, uv_a, uv_b, threshold_px, prior)
        if found is None or found[1].sum() < self.settings.min_matches:
            return None
        T_a_b, good = found
        _, angles = triangulate_pair(T_a_b, camera_a.rays(uv_a[good]), camera_b.rays(uv_b[good]))
        return T_a_b if np.median(angles) > np.radians(MIN_PAIR_ANGLE_DEG) else None

    def _merge_into(self, component: int, photo: int) -> None:
        """Let a smaller component that this photo connects be placed again on the larger one."""
        linked = {
            self._block.component[i]
            for pair in self._matches
            if photo in pair
            for i in pair
            if i in self._block.component
        }
        for other in linked - {component}:
            if len(self._block.photos(other)) <= len(self._block.photos(component)):
                self._block.dissolve(other)

    def _start(self) -> bool:
        """Start a component from the best pair of photos that have none."""
        free = [p for p in self._matches if not any(i in self._block.poses for i in p)]
        for a, b in sorted(free, key=lambda p: -len(self._matches[p])):
            if self._entries[a].p_ecef is not None and self._entries[b].p_ecef is not None and self._start_with(a, b):
                return True
        return False

    def _start_with(self, a: int, b: int) -> bool:
        block, T_a_b = self._block, self._relative_pose(a, b)
        if T_a_b is None:
            return False
        self._set_datum(a)
        found = georeference([SE3.identity(), T_a_b], [block.priors[a], block.priors[b]])
        if found is None:
            return False
        similarity = found.similarity
        component = self._components
        self._components += 1
        block.place(a, similarity.pose(SE3.identity()), component)
        block.place(b, similarity.pose(T_a_b), component)
        block.triangulate([a, b])
        block.adjust([a, b], [], calibrate=False, per_photo=self.settings.observations_per_photo, final=False)
        block.prune([a, b])
        return True

    def _set_datum(self, photo: int) -> None:
        """The world begins at the first photo that matched another: a stray first photo does not decide it."""
        fix = self._entries[photo].photo.fix
        if self.datum is not None or fix is None:
            return
        self.datum = Datum(self.flight, fix.latitude_deg, fix.longitude_deg, fix.height)
        for i, entry in self._entries.items():
            self._block.priors[i] = self._prior(entry.photo)

    def _adjust_around(self, photo: int) -> None:
        """Adjust a new photo and those that share most with it, held by the others that see what these see."""
        block = self._block
        free = [photo, *self._sharing([photo])[:LOCAL_FREE]]
        fixed = self._sharing(free)[:LOCAL_FIXED]
        block.adjust(free, fixed, calibrate=False, per_photo=self.settings.observations_per_photo // 2, final=False)
        block.prune(free)
        block.triangulate(free)

    def _sharing(self, photos: list[int]) -> list[int]:
        """The placed photos that see points of some others, those that see most of them first."""
        block = self._block
        others = [i for i in sorted(block.poses) if i not in photos]
        seen = block.tracks.observations(block.tracks_of(photos), others)
        sharing, shared = np.unique(seen.photo, return_counts=True)
        return [int(i) for i in sharing[np.argsort(-shared, kind="stable")]]

    def _adjust_if_due(self) -> None:
        if self.placed >= max(self._adjusted * self.settings.growth, self._adjusted + 1):
            self._adjust_all(final=False)
            self._adjusted = self.placed

    def _adjust_all(self, final: bool) -> None:
        """Fit every component to its fixes, then adjust all photos together with the intrinsics."""
        block, s = self._block, self.settings
        for component in range(self._components):
            self._fit_to_fixes(component)
        photos = sorted(block.poses)
        calibrate = self._spread() > CALIBRATE_SPREAD
        for _ in range(FINAL_ROUNDS if final else 1):
            block.adjust(photos, [], calibrate, s.observations_per_photo, final=False)
            block.retrack(self._matches)
        if final:
            block.adjust(photos, [], calibrate, FINAL_OBSERVATIONS // len(photos), final=True)
            block.prune(photos)

    def _spread(self) -> float:
        """Extent of the block across its longest direction, in heights above ground (one sigma)."""
        block = self._block
        centres = np.array([T.t[:2] for T in block.poses.values()])
        depth = float(np.median([block.depth(i) for i in block.poses]))
        across = np.linalg.svd(centres - centres.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(centres))
        return float(across) / max(depth, 1e-6)

    def _fit_to_fixes(self, component: int) -> None:
        block = self._block
        photos = block.photos(component)
        priors = [self._prior(self._entries[i].photo) for i in photos]
        fit = georeference([block.poses[i] for i in photos], priors)
        if fit is None:
            return
        worse = np.array([fit.horizontal_factor, fit.horizontal_factor, fit.vertical_factor])
        for i, prior in zip(photos, priors, strict=True):
            block.priors[i] = replace(prior, p_sigma=prior.p_sigma * worse)
        block.move(photos, fit.similarity)

    def _moved(self, threshold: float) -> list[Keyframe]:
        """Keyframes of the photos whose ground has moved by more than a threshold, m, since they were last given."""
        keyframes = []
        for i in sorted(self._block.poses):
            entry, now = self._entries[i], (self._block.poses[i], self._block.camera(i))
            if entry.published is None or self._shift(i, entry.published, now) > threshold:
                entry.revision += 1
                entry.published = now
                keyframes.append(self._keyframe(i))
        return keyframes

    def _shift(self, i: int, before: tuple[SE3, CameraModel], now: tuple[SE3, CameraModel]) -> float:
        """How far the ground under the middle and the corners of a photo has moved, m."""
        if before[0] is now[0] and before[1] is now[1]:
            return 0.0
        w, h = now[1].width - 1.0, now[1].height - 1.0
        uv = np.array([[w / 2, h / 2], [0, 0], [w, 0], [0, h], [w, h]])
        depth = self._block.depth(i)
        ground = [T.apply(camera.rays(uv) * depth) for T, camera in (before, now)]
        return float(np.linalg.norm(ground[1] - ground[0], axis=1).max())

    def _keyframe(self, i: int) -> Keyframe:
        entry = self._entries[i]
        return Keyframe(
            flight=self.flight,
            index=i,
            revision=entry.revision,
            t_ns=entry.photo.t_ns,
            name=entry.photo.name,
            T_world_cam=self._block.poses[i],
            camera=self._block.camera(i),
            sigma=self._block.sigmas.get(i, self._fix_sigma(entry.photo.fix)),
            thumbnail=entry.thumbnail,
        )

    def _fix_sigma(self, fix: GnssFix | None) -> F64:
        """Position sigma (3,) m before an adjustment has said more: that of a mean of the fixes so far."""
        fix = fix or next(e.photo.fix for e in self._entries.values() if e.photo.fix is not None)
        sigma = np.array([fix.sigma_horizontal, fix.sigma_horizontal, fix.sigma_vertical])
        return np.asarray(sigma / np.sqrt(max(1, self.placed)))
