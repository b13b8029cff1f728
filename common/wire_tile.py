"""A map tile ⇄ its map of images. Raises ValueError, naming the field, for what does not fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.messages import MapTile, TileId
from common.tile_images import pack_images, unpack_images
from common.wire_fields import Fields, describe

_OVERHEAD = 1_000  # bytes of a tile's map beside its images, with room to spare


def pack_tile(m: MapTile, max_bytes: int) -> Fields:
    """The map of a tile, of which the payload is at most so many bytes."""
    _check(m)
    place = {"flight": m.flight, "level": m.id.level, "x": m.id.x, "y": m.id.y}
    state = {"revision": m.revision, "t_ns": m.t_ns, "size": len(m.height), "cell": m.cell}
    return {**place, **state, **pack_images(m, max_bytes - _OVERHEAD)}


def unpack_tile(f: Fields) -> MapTile:
    """The tile of a map that fits its schema."""
    tile = TileId(f["level"], f["x"], f["y"])
    return MapTile(f["flight"], tile, f["revision"], f["t_ns"], float(f["cell"]), *unpack_images(f))


def _check(m: MapTile) -> None:
    n = len(m.height)
    planes: tuple[tuple[str, type[Any], tuple[int, ...]], ...] = (
        ("height", np.float32, (n, n)),
        ("sigma", np.float32, (n, n)),
        ("colour", np.uint8, (n, n, 3)),
        ("views", np.uint8, (n, n)),
        ("disputed", np.bool_, (n, n)),
    )
    for name, dtype, shape in planes:
        plane = getattr(m, name)
        if not isinstance(plane, np.ndarray) or plane.shape != shape:
            raise ValueError(f"{name} is {describe(plane)}, not an array of shape {shape}")
        if plane.dtype != dtype:
            raise ValueError(f"{name} is {describe(plane)}, not {dtype.__name__}")
    if np.isinf(m.height).any():
        raise ValueError("height is infinite somewhere; NaN says that a cell is unknown")
    sigma = m.sigma[np.isfinite(m.height)]
    if not (np.isfinite(sigma) & (sigma >= 0)).all():
        raise ValueError("sigma is negative or not finite where the height is known")
