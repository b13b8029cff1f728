"""The mapper: keyframes and photos in, changed map tiles out. No clock, no file, no stream."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from air.mapping.ground import Ground, estimate_ground
from air.mapping.layer import layers
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
        self._contributions: dict[Photos, Contribution] = {}
        self._ground = Ground()
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

    def update(self, flight: str, keyframes: Sequence[Keyframe], ground_height: float | None = None) -> list[MapTile]:
        """The tiles that these keyframes change, each with a revision one higher than before.

        A keyframe never seen is matched with its best partners; one with a higher revision whose new pose or
        intrinsics move the surface is triangulated anew. `ground_height` m in world, if known, says where the ground
        roughly is as long as the map does not know it.
        """
        newer = [k for k in keyframes if self._is_news(k)]
        fresh = [k.index for k in newer if k.index not in self._keyframes]
        self._keyframes.update((k.index, k) for k in newer)
        touched = self._move({k.index for k in newer})
        if ground_height is not None:
            self._ground.suppose(ground_height)
        for start in range(0, len(fresh), BATCH):
            pairs = self._new_pairs(fresh[start : start + BATCH])
            touched |= self._match(pairs)
        t_ns = max((k.t_ns for k in self._keyframes.values()), default=0)
        return self._tiles.fuse(flight, t_ns, touched)

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

    def _move(self, changed: set[int]) -> set[TileId]:
        """Tiles touched by pairs whose surface the new poses and intrinsics move by more than the tolerance."""
        touched: set[TileId] = set()
        for photos, old in list(self._contributions.items()):
            if changed.isdisjoint(photos):
                continue
            left, right = (self._keyframes[p] for p in photos)
            samples = triangulate(old.matches, left, right, MOVE_STEP)
            if largest_move(old.samples, samples) > self._settings.move_tolerance:
                touched |= self._place(photos, Contribution(old.matches, left, right, samples))
        return touched

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
        return [p for p in pairs if p not in self._contributions]

    def _match(self, pairs: Sequence[Photos]) -> set[TileId]:
        """Tiles touched by the new pairs; each is matched on its own, so threads change nothing but the time."""
        with ThreadPoolExecutor(self._settings.threads) as pool:
            contributions = list(pool.map(self._contribution, pairs))
        touched: set[TileId] = set()
        for photos, contribution in zip(pairs, contributions, strict=True):
            if contribution is not None:
                touched |= self._place(photos, contribution)
        return touched

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

    def _place(self, photos: Photos, contribution: Contribution) -> set[TileId]:
        """Tiles touched by putting the pair's surface at its present poses."""
        self._contributions[photos] = contribution
        self._ground.learn(photos, contribution.samples)
        points = triangulate(contribution.matches, contribution.left, contribution.right)
        found = layers(contribution.matches, points, photos, self._settings.cell, self._settings.tile_cells)
        return self._tiles.replace(photos, found)
