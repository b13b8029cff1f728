"""Light baked into the texture of a surface, its coarser levels, and the periodic textures, once per world."""

from __future__ import annotations

import cv2
import numpy as np

from air.sources.simulated.sites.noise import periodic_detail
from air.sources.simulated.sites.raytrace import compiled
from air.sources.simulated.sites.scene import CONCRETE, FACADE, PLAIN, PLASTER, RIBS, TILES, Light
from air.sources.simulated.sites.surface import (
    CELL,
    DETAIL_MIPS,
    DETAIL_TEXELS,
    LIGHT_SCALE,
    PATTERN_MIPS,
    PATTERN_TEXELS,
    Surface,
    texture_level,
)
from common.arrays import F32, F64, I32, U8

_SKY_SCALES = ((1.0, 0.35), (4.0, 0.30), (12.0, 0.20))
"""How far around, m, ground that is higher hides the sky, and how much of it at a slope of one."""
_LEAFY = 0.12
"""Plants of at least this height, m, have the colour of their leaves."""


def bake(surface: Surface, plants: F32, leaves: U8, light: Light, fine: F32) -> None:
    """Turn the paint in the finest level of a surface's texture into light, and fill the other levels.

    `plants` (h, w) m of height above the bare ground and their colour `leaves` (h, w, 3) uint8 on the surface's raster;
    `fine` (2, D, D) float32, periodic noise of zero mean and unit deviation, texels as wide as the texture's.
    """
    sun, sky = illumination(surface, light)
    paint = texture_level(surface.colour, surface.colour_at, 0)
    turn = np.array([light.sun_colour, light.sky_colour])
    _bake(paint, surface.texel / CELL, sun, sky, plants, leaves, fine, np.ascontiguousarray(turn), LIGHT_SCALE)
    fill_levels(surface)


def fill_levels(surface: Surface) -> None:
    """Fill the coarser levels of a surface's texture from the finest."""
    for level in range(1, len(surface.colour_at)):
        coarse = texture_level(surface.colour, surface.colour_at, level)
        _halve(texture_level(surface.colour, surface.colour_at, level - 1), coarse)


def illumination(surface: Surface, light: Light) -> tuple[F32, F32]:
    """What share (h, w) of sun and sky light the raster of a surface gets."""
    z = surface.height
    east, north = (
        cv2.Sobel(z, cv2.CV_32F, 1, 0, scale=1 / (8 * CELL)),
        cv2.Sobel(z, cv2.CV_32F, 0, 1, scale=1 / (8 * CELL)),
    )
    up = 1 / np.sqrt(1 + east**2 + north**2)
    cosine = np.maximum((light.sun[2] - east * light.sun[0] - north * light.sun[1]) * up, 0)
    sun = cosine * np.clip((z + 0.12 - surface.shadow) * 4, 0, 1)
    hidden = np.zeros_like(z)
    for reach, share in _SKY_SCALES:
        around = cv2.GaussianBlur(z, (0, 0), reach / CELL, borderType=cv2.BORDER_REPLICATE)
        hidden += share * np.clip((around - z) / reach, 0, 1)
    sky = (0.5 + 0.5 * up) * np.clip(1 - hidden, 0.15, 1)
    return np.asarray(sun, np.float32), np.asarray(sky, np.float32)


@compiled
def _noise(texture: F32, x: float, y: float) -> float:
    """Value of a periodic texture (D, D), D a power of two, bilinear at texel coordinates."""
    n = texture.shape[0] - 1
    j, i = int(np.floor(x)), int(np.floor(y))
    u, v = x - j, y - i
    j0, i0, j1, i1 = j & n, i & n, (j + 1) & n, (i + 1) & n
    low = texture[i0, j0] * (1.0 - u) + texture[i0, j1] * u
    high = texture[i1, j0] * (1.0 - u) + texture[i1, j1] * u
    return float(low * (1.0 - v) + high * v)


@compiled
def _bake(
    paint: U8, per_cell: float, sun: F32, sky: F32, plants: F32, leaves: U8, fine: F32, light: F64, scale: float
) -> None:
    """Multiply paint (H, W, 4) by the light (2, 3) of sun and sky that falls on it, and by fine noise."""
    h, w = sun.shape
    n = fine.shape[1] - 1
    for i in range(paint.shape[0]):
        v = min(i * per_cell, h - 1.001)
        a = int(v)
        fv = v - a
        for j in range(paint.shape[1]):
            u = min(j * per_cell, w - 1.001)
            b = int(u)
            fu = u - b
            w00, w01, w10, w11 = (1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv
            direct = w00 * sun[a, b] + w01 * sun[a, b + 1] + w10 * sun[a + 1, b] + w11 * sun[a + 1, b + 1]
            open_sky = w00 * sky[a, b] + w01 * sky[a, b + 1] + w10 * sky[a + 1, b] + w11 * sky[a + 1, b + 1]
            high = w00 * plants[a, b] + w01 * plants[a, b + 1] + w10 * plants[a + 1, b] + w11 * plants[a + 1, b + 1]
            x, y = 0.79863551 * j + 0.60181502 * i, 0.79863551 * i - 0.60181502 * j
            noise = 0.7071 * (fine[0, i & n, j & n] + _noise(fine[1], 0.83 * x, 0.83 * y))
            r, g, blue, strength = (
                float(paint[i, j, 0]),
                float(paint[i, j, 1]),
                float(paint[i, j, 2]),
                float(paint[i, j, 3]),
            )
            if high > _LEAFY:
                # The nearest colour that belongs to a plant.
                a1, b1 = (a + 1 if fv > 0.5 else a), (b + 1 if fu > 0.5 else b)
                r, g, blue, strength = (
                    float(leaves[a1, b1, 0]),
                    float(leaves[a1, b1, 1]),
                    float(leaves[a1, b1, 2]),
                    100.0,
                )
                paint[i, j, 3] = 60
            gain = max(1.0 + strength / 255.0 * noise, 0.12) * scale / 255.0
            paint[i, j, 0] = min(r * gain * np.sqrt(light[0, 0] * direct + light[1, 0] * open_sky), 255.0)
            paint[i, j, 1] = min(g * gain * np.sqrt(light[0, 1] * direct + light[1, 1] * open_sky), 255.0)
            paint[i, j, 2] = min(blue * gain * np.sqrt(light[0, 2] * direct + light[1, 2] * open_sky), 255.0)


@compiled
def _halve(fine: U8, coarse: U8) -> None:
    """Average 2 × 2 texels: light, of which colours are the root, and the strength of detail as it is."""
    for i in range(coarse.shape[0]):
        for j in range(coarse.shape[1]):
            for c in range(3):
                p, q = float(fine[2 * i, 2 * j, c]), float(fine[2 * i, 2 * j + 1, c])
                r, s = float(fine[2 * i + 1, 2 * j, c]), float(fine[2 * i + 1, 2 * j + 1, c])
                coarse[i, j, c] = int(np.sqrt(0.25 * (p * p + q * q + r * r + s * s)) + 0.5)
            total = int(fine[2 * i, 2 * j, 3]) + int(fine[2 * i, 2 * j + 1, 3])
            total += int(fine[2 * i + 1, 2 * j, 3]) + int(fine[2 * i + 1, 2 * j + 1, 3])
            coarse[i, j, 3] = total // 4


def periodic_textures(rng: np.random.Generator) -> tuple[U8, U8]:
    """The patterns of solids and the finest detail, each level by level in one row; 128 is 1."""
    room = PATTERN_TEXELS * PATTERN_TEXELS * 4 // 3
    patterns = [_levels(pattern, PATTERN_MIPS, room) for pattern in _patterns(rng)]
    detail = np.asarray(128 + 38 * periodic_detail(rng, DETAIL_TEXELS, 2.5, 40.0), np.float32)
    return np.concatenate(patterns), _levels(detail, DETAIL_MIPS, DETAIL_TEXELS * DETAIL_TEXELS * 4 // 3)


def _levels(texture: F32, count: int, room: int) -> U8:
    parts: list[U8] = []
    for _ in range(count):
        parts.append(np.clip(np.rint(texture), 0, 255).astype(np.uint8).ravel())
        texture = cv2.resize(texture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    row = np.concatenate(parts)
    return np.asarray(np.pad(row, (0, room - len(row))), np.uint8)


def _patterns(rng: np.random.Generator) -> list[F32]:
    """One (512, 512) texture per pattern, in the order of their numbers, rows up a wall or down a roof."""
    n = PATTERN_TEXELS
    row, column = np.mgrid[:n, :n]
    rough = periodic_detail(rng, n, 3.0, 120.0)
    made: dict[int, F32] = {PLAIN: np.full((n, n), 128, np.float32)}
    course, tile = row // 16, (column + 8 * (row // 16 % 2)) // 16
    shade = rng.normal(1.0, 0.10, (n // 16, n // 16 + 1)).astype(np.float32)
    step = 0.72 + 0.28 * np.minimum(row % 16 / 5.0, 1.0)
    made[TILES] = 128 * step * shade[course, tile % (n // 16)] * (1 + 0.06 * rough)
    made[RIBS] = 128 * (0.92 + 0.10 * np.sin(column * (2 * np.pi * 32 / n))) * (1 + 0.05 * rough)
    made[PLASTER] = 128 * (1 + 0.07 * rough)
    made[FACADE] = _facade(rng, row, column, rough)
    joint = np.where((row % 128 < 2) | (column % 256 < 2), 0.55, 1.0)
    stain = cv2.GaussianBlur(rng.standard_normal((n, n)).astype(np.float32), (0, 0), 12, borderType=cv2.BORDER_REFLECT)
    made[CONCRETE] = 128 * joint * (1 + 0.10 * rough + 2.0 * stain)
    return [np.asarray(made[k], np.float32) for k in range(len(made))]


def _facade(rng: np.random.Generator, row: I32, column: I32, rough: F32) -> F32:
    """Windows in plaster: one in 2.56 m along and one in 2.56 m down from the eaves, of all shades."""
    wall = 128 * (1 + 0.05 * rough)
    u, v = column % 128, row % 128
    glass = (u > 36) & (u < 92) & (v > 34) & (v < 104)
    frame = (u > 31) & (u < 97) & (v > 29) & (v < 109) & ~glass
    each = rng.uniform(28, 62, (4, 4))[row // 128 % 4, column // 128 % 4]
    bar = (np.abs(u - 64) < 2) & glass
    return np.asarray(np.where(glass & ~bar, each, np.where(frame | bar, 150, wall)), np.float32)
