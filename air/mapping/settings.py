"""What the mapper may be told; every default works."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from common.errors import ConfigError


@dataclass(frozen=True)
class MappingSettings:
    """Settings of the mapper, lengths in m.

    `cell` is the size of a map cell and `tile_cells` the cells along a tile's side. `method` finds the first,
    coarse disparities: "block" is equation 2 of seed 000, "semi-global" OpenCV's SGM. `partners` photos are matched
    with each photo. Baselines are given as a share of the height above the ground, overlap as a share of the photo's
    footprint. `images_kept` working copies of at most `image_pixels` px stay in memory, and a pair is matched on a
    grid of at most `match_pixels` px. A pair is triangulated again when new poses or intrinsics move its surface by
    more than `move_tolerance`, at most `moves_per_update` pairs at a time, those that moved most first. `threads` pairs
    are worked on at once; the result does not depend on it. Without `revisable` nothing is kept to triangulate pairs
    anew: half the memory, for poses that are final.
    """

    cell: float = 0.10
    tile_cells: int = 256
    method: Literal["block", "semi-global"] = "block"
    partners: int = 3
    min_baseline_ratio: float = 0.08
    best_baseline_ratio: float = 0.25
    max_baseline_ratio: float = 0.70
    min_overlap: float = 0.30
    image_pixels: int = 2_200_000
    match_pixels: int = 700_000
    images_kept: int = 150
    move_tolerance: float = 0.03
    moves_per_update: int = 16
    threads: int = 2
    revisable: bool = True

    def __post_init__(self) -> None:
        """Raises ConfigError for a value that no map can be made with."""
        limits = {
            "cell": (0.005, 10.0),
            "tile_cells": (16, 1024),
            "partners": (1, 8),
            "min_baseline_ratio": (0.01, self.best_baseline_ratio),
            "max_baseline_ratio": (self.best_baseline_ratio, 2.0),
            "min_overlap": (0.1, 0.95),
            "image_pixels": (10_000, 100_000_000),
            "match_pixels": (10_000, 100_000_000),
            "images_kept": (2, 100_000),
            "move_tolerance": (0.0, 100.0),
            "moves_per_update": (1, 100_000),
            "threads": (1, 64),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"mapping.{name} = {value!r} is impossible: it must lie between {low} and {high}")
        if self.method not in ("block", "semi-global"):
            raise ConfigError(f'mapping.method = {self.method!r} is unknown: use "block" or "semi-global"')
