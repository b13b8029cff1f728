"""The mapper: keyframes and photos in, changed map tiles out. No clock, no file, no stream."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from air.mapping.ground import Ground, estimate_ground
from air.mapping.layer import Layer, layers
from air.mapping.matching import match
from air.mapping.pairs import choose_partners
from air.mapping.rectification import rectify, resample
from air.mapping.settings import MappingSettings
from air.mapping.tiles import Photos, Tiles
from air.mapping.triangulation import Correspondences, PointGrid, largest_move, triangulate
from common.arrays import U8
from common.messages import Keyframe, MapTile, TileId

# Pairs matched in one go before what they found narrows the search of the next ones.
BATCH = 4
# Matched pixels of a pair must be at least this share of its canvas: fewer are chance, the pose is wrong.
MIN_SHARE = 0.10
# Pixels between the samples with which a pair is asked whether its surface moved.
MOVE_STEP = 32


@dataclass(frozen=True, eq=False)
class Contribution:
    """What a pair gave to the map: its correspondences, the keyframes it is triangulated with, samples of it."""

    matches: Correspondences
    left: Keyframe
    right: Keyframe
    samples: PointGrid


class Mapper:
    """Grows a map of tiles from keyframes. Photos without usable geometry contribute nothing and do no harm."""

    def __init__(self, settings: MappingSettings | None = None) -> None:
        self._settings = settings or MappingSettings()
        self._images: dict[int, U8] = {}
        self._keyframes: dict[int, Keyframe] = {}
        self._tried: set[Photos] = set()
        self._contributions: dict[Photos, Contribution] = {}
        self._ground = Ground()
        self._touched: set[TileId] = set()
        self._tiles = Tiles(self._settings.cell, self._settings.tile_cells)

    def add_image(self, index: int, image: U8) -> None:
        """Keeps a working copy of the photo (H, W, 3) uint8 RGB of keyframe `index`, until forgotten."""
        shrink = np.sqrt(self._settings.image_pixels / (image.shape[0] * image.shape[1]))
        if shrink < 1:
            image = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        self._images[index] = image
        while len(self._images) > self._settings.images_kept:
            self.forget(next(iter(self._images)))

    def forget(self, index: int) -> None:
        """Drops the photo's working copy: it is matched with no further photos, its part of the map stays."""
        self._images.pop(index, None)

    def update(
        self,
        flight: str,
        keyframes: Sequence[Keyframe],
        ground_height: float | None = None,
        moves: int | None = None,
    ) -> list[MapTile]:
        """The tiles that these keyframes change, each with a revision one higher than before: `place`, then `fuse`."""
        self.place(keyframes, ground_height, moves)
        return self.fuse(flight)

    def place(
        self, keyframes: Sequence[Keyframe], ground_height: float | None = None, moves: int | None = None
    ) -> None:
        """Puts what these keyframes show into the map, to be fused when somebody wants to see it.

        A keyframe never seen is matched with its best partners; one with a higher revision whose new pose or
        intrinsics move the surface is triangulated anew. Surfaces that moved beyond what one call does follow in
        the next: without keyframes it only does that, and touches nothing once nothing is left. `ground_height` m in
        world says roughly where the ground is as long as the map does not know it; `moves` replaces the setting
        `moves_per_update`: with 0 what is new comes first, and what moved is left for later.
        """
        if ground_height is not None:
            self._ground.suppose(ground_height)
        newer = [k for k in keyframes if self._is_news(k)]
        fresh = [k.index for k in newer if k.index not in self._keyframes]
        self._keyframes.update((k.index, k) for k in newer)
        self._touched |= self._place(self._moved(self._settings.moves_per_update if moves is None else moves))
        for start in range(0, len(fresh), BATCH):
            pairs = self._new_pairs(fresh[start : start + BATCH])
            self._touched |= self._place(self._matched(pairs))

    def fuse(self, flight: str) -> list[MapTile]:
        """The tiles touched since the last time, each with a revision one higher than before."""
        t_ns = max((k.t_ns for k in self._keyframes.values()), default=0)
        tiles = self._tiles.fuse(flight, t_ns, self._touched, self._settings.threads)
        self._touched = set()
        return tiles

    def tiles(self) -> list[MapTile]:
        """All tiles at their current revision."""
        return self._tiles.all()

    def _is_news(self, keyframe: Keyframe) -> bool:
        known = self._keyframes.get(keyframe.index)
        if not np.isfinite(keyframe.T_world_cam.matrix).all():
            return False
        if known is None:
            return keyframe.index in self._images
        return keyframe.revision > known.revision

    def _moved(self, limit: int) -> dict[Photos, Contribution]:
        """Contributions at their new poses and intrinsics, of the pairs whose surface these move most.

        Where to look for the next photos follows every move at once.
        """
        moved: list[tuple[float, Photos, Contribution]] = []
        for photos, old in self._contributions.items():
            left, right = (self._keyframes[p] for p in photos)
            if left is old.left and right is old.right:
                continue
            samples = triangulate(old.matches, left, right, MOVE_STEP)
            distance = largest_move(old.samples, samples)
            if distance > self._settings.move_tolerance:
                self._ground.learn(photos, samples)
                moved.append((distance, photos, Contribution(old.matches, left, right, samples)))
        moved.sort(key=lambda m: (-m[0], m[1]))
        return {photos: new for _, photos, new in moved[:limit]}

    def _new_pairs(self, indices: Iterable[int]) -> list[Photos]:
        """Pairs of these keyframes with their best partners that were not matched yet, older photo first."""
        pairs: dict[Photos, None] = {}
        with_image = [k for i, k in self._keyframes.items() if i in self._images]
        for index in indices:
            keyframe = self._keyframes[index]
            ground = self._ground.under(keyframe)
            if ground is None:
                ground = estimate_ground(keyframe, with_image, self._images)
                if ground is None:
                    continue
                self._ground.suppose(ground)
            for partner in choose_partners(keyframe, with_image, ground, self._settings):
                pairs[min(index, partner.index), max(index, partner.index)] = None
        untried = [p for p in pairs if p not in self._tried]
        self._tried.update(untried)
        return untried

    def _matched(self, pairs: Sequence[Photos]) -> dict[Photos, Contribution]:
        """What the new pairs give; each is matched on its own, so threads change nothing but the time."""
        with ThreadPoolExecutor(self._settings.threads) as pool:
            contributions = list(pool.map(self._contribution, pairs))
        return {p: c for p, c in zip(pairs, contributions, strict=True) if c is not None}

    def _contribution(self, photos: Photos) -> Contribution | None:
        left, right = (self._keyframes[p] for p in photos)
        ground = self._ground.under(left)
        if ground is None:
            return None
        rectification = rectify(left, right, ground, 0.5 * self._settings.cell, self._settings.match_pixels)
        if rectification is None:
            return None
        images = resample(rectification, self._images[left.index], self._images[right.index])
        low, high = self._ground.disparities(rectification, left, right)
        found = match(
            images.left, images.right, images.left_valid, images.right_valid, low, high, self._settings.method
        )
        matches = Correspondences.of(rectification, found, images.colour)
        if matches.share < MIN_SHARE:
            return None
        return Contribution(matches, left, right, triangulate(matches, left, right, MOVE_STEP))

    def _place(self, contributions: Mapping[Photos, Contribution]) -> set[TileId]:
        """Tiles touched by putting the surfaces of these pairs into the map, in place of what they gave before."""
        with ThreadPoolExecutor(self._settings.threads) as pool:
            found = list(pool.map(self._layers, contributions, contributions.values()))
        touched: set[TileId] = set()
        for (photos, contribution), stack in zip(contributions.items(), found, strict=True):
            if self._settings.revisable:
                self._contributions[photos] = contribution
            self._ground.learn(photos, contribution.samples)
            touched |= self._tiles.replace(photos, stack)
        return touched

    def _layers(self, photos: Photos, contribution: Contribution) -> dict[TileId, Layer]:
        points = triangulate(contribution.matches, contribution.left, contribution.right)
        return layers(contribution.matches, points, photos, self._settings.cell, self._settings.tile_cells)
