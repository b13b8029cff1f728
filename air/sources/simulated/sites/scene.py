"""What a ray can meet, as plain arrays that compiled code takes.

The numbers of kinds, faces and patterns are compiled into `raytrace.py`: whoever changes one touches that file too,
or numba's cache keeps the old ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from common.arrays import F32, F64, I32, U8

HOUSE, DOME = 0, 1
"""A house is a box under a gable (slope 0: a flat roof); a dome is half an ellipsoid on a cylinder."""
EAST_WALL, WEST_WALL, NORTH_WALL, SOUTH_WALL, NORTH_ROOF, SOUTH_ROOF, DOME_TOP, DOME_SIDE, GROUND = range(9)
"""Faces; a house's own east is along its `a`, its own north along its `b`."""
PLAIN, TILES, RIBS, PLASTER, FACADE, CONCRETE = range(6)
"""Patterns on the surface of a house; domes have leaves. The photo survey knows the first four."""


SOLID = np.dtype(
    [
        ("kind", np.int32),
        ("x", np.float64),
        ("y", np.float64),
        ("cos", np.float64),
        ("sin", np.float64),
        ("a", np.float64),
        ("b", np.float64),
        ("top", np.float64),
        ("slope", np.float64),
        ("roof", np.float64, 3),
        ("wall", np.float64, 3),
        ("roof_pattern", np.int32),
        ("wall_pattern", np.int32),
        ("seed", np.int32),
    ],
    align=True,
)
"""A convex solid that reaches down into the ground, metres in world.

`a`, `b` are half the length and width of a house along its own axes (`cos`, `sin` of its heading from east),
or radius and vertical radius of a dome; `top` is the height of ridge or crown; `slope` is that of the roof.
`roof` and `wall` are linear reflectances RGB. `seed` chooses the piece of texture.
"""
Solids = npt.NDArray[np.void]
"""Records of SOLID."""


class Scene(NamedTuple):
    """All that a ray can meet.

    `terrain` (h, w) m on a grid of `terrain_cell` and `paint` (H, W, 4) uint8 on one of `paint_cell`, both with
    node [0, 0] at (`west`, `south`) and rows to the north; paint is RGB (gamma 2) and the strength of the detail.
    `detail` (2, D, D) float32 are periodic textures of zero mean and unit deviation. Solids are listed per cell of
    an index grid: those of cell c are `listed[first[c]:first[c + 1]]`, none higher than `cell_top[c]`.
    """

    west: float
    south: float
    terrain: F64
    terrain_cell: float
    paint: U8
    paint_cell: float
    detail: F32
    solids: Solids
    index_cell: float
    index_width: int
    index_height: int
    first: I32
    listed: I32
    cell_top: F64
    highest: float


class Light(NamedTuple):
    """Sun direction (3,) in world, and linear colours (3,) of sun and sky light."""

    sun: F64
    sun_colour: F64
    sky_colour: F64
