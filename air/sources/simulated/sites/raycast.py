"""Rays of a video camera against a `Surface`, and the light that they find, compiled.

What is compiled together stands in one file, because numba's cache notices a changed file, not a changed callee. Rays
are walked in beams of a block of pixels first: what a block can meet is found once (cf. Amanatides and Woo, A Fast
Voxel Traversal Algorithm for Ray Tracing, 1987; Tevs et al., Maximum Mipmaps, 2008).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from air.sources.simulated.sites.raytrace import compiled, enter_house
from air.sources.simulated.sites.scene import EAST_WALL, GROUND, NORTH_ROOF, NORTH_WALL, SOUTH_ROOF, WEST_WALL, Light
from air.sources.simulated.sites.surface import (
    CELL,
    DETAIL_MIPS,
    DETAIL_TEXEL,
    DETAIL_TEXELS,
    INDEX_CELL,
    LEVELS,
    LIGHT_SCALE,
    LUMP,
    MIPS,
    PATTERN_MIPS,
    PATTERN_TEXEL,
    PATTERN_TEXELS,
    Surface,
)
from common.arrays import F32, F64, I32, U8, Bool

U64 = npt.NDArray[np.uint64]

WATER, SKY = -2, -3
"""What a ray meets beside solids (from 0 on) and the raster (−1)."""
CANDIDATES = 96
"""Solids that a block of pixels can meet, at most."""
BLOCK = 8
"""Pixels along the side of a block, which is one beam, and between the first rays."""
_CHUNK = 32
"""Rays of a row that one step of Newton's moves at once: what fits vectors of any processor."""
_T, _DX, _DY, _DZ, _U, _V, _Z00, _Z01, _Z10, _Z11, _STEP, _GUESS, _NEARBY = range(0, 13 * _CHUNK, _CHUNK)
_X, _Y, _Z, _AT, _FU, _FV, _PER, _SHIFT, _EAST, _NORTH, _ROW, _BEGIN, _REST, _SHADE, _R, _G, _B = range(
    0, 17 * _CHUNK, _CHUNK
)
_C00, _C01, _C10, _C11, _FINE, _COARSE = range(0, 6 * _CHUNK, _CHUNK)
CHUNK_ROOM, TEXEL_ROOM = 17 * _CHUNK, 6 * _CHUNK
"""Numbers and texels that a chunk of rays needs room for."""
_FAR = (8, 4, 4, 2, 2, 1, 1)
"""How far, in pixels, the rays of each sweep are from the two that they are between: left and right, or up and down."""
_SMOOTH, _ROUGH, _EMPTY = 0, 1, 2
_SMOOTH_SLOPE, _GRAZING = 0.4, 1.8
_SKYWARD = -0.08
"""Rays that descend less, per metre of depth, see the sky."""
_RASTER = -16 + GROUND
_NEAR = 0.02
"""Rays whose depths differ by less than this share belong to one surface."""
_UNIT = 1.0 / (LIGHT_SCALE * LIGHT_SCALE)
_PER_CELL = 1.0 / CELL
_PER_LEAF = 50.0
_FINEST = 0.05
"""Pixels of this width, m, no longer see the finest detail."""
_ONE = np.uint64(1)
_LOW, _BLUE, _GREEN, _STRENGTH = np.uint64(0xFFFF), np.uint64(16), np.uint64(32), np.uint64(48)


class View(NamedTuple):
    """The rays of a frame, each row of the camera at its own pose, and room for what they meet.

    `rays` (H, W, 2) at depth 1, `R` (H, 3, 3) and `p` (H, 3) m the rows' `T_world_cam`, `pixel` the width of a pixel at
    depth 1; rows are `row_s` apart, the middle one at `t_s`; moving solids go `pace` (K, 2) m/s. `depth` (H, W) gets
    z in the camera, m, `what` (H, W) the solid and face. `blocks` (B, CANDIDATES + 2), `starts` (B,), `chunk`
    (CHUNK_ROOM,) and `texels` (TEXEL_ROOM,) are room for what each block can meet and for a chunk of rays.
    """

    rays: F32
    R: F64
    p: F64
    pixel: float
    row_s: float
    t_s: float
    pace: F64
    depth: F32
    what: I32
    blocks: I32
    starts: F32
    chunk: F64
    texels: U64


@compiled
def raster_height(s: Surface, x: float, y: float) -> float:
    """Height of ground and vegetation, m; beyond the edge that of the edge."""
    h, w = s.height.shape
    u = min(max((x - s.west) * _PER_CELL, 0.0), w - 1.001)
    v = min(max((y - s.south) * _PER_CELL, 0.0), h - 1.001)
    i, j, z = np.uint64(v), np.uint64(u), s.height  # numbers that count from the end would have to be looked for
    fu, fv = u - j, v - i
    low = z[i, j] + (z[i, j + _ONE] - z[i, j]) * fu
    high = z[i + _ONE, j] + (z[i + _ONE, j + _ONE] - z[i + _ONE, j]) * fu
    return float(low + (high - low) * fv)


@compiled
def _cell_of(s: Surface, x: float, y: float, level: int) -> int:
    """Place in `tops` of the cell of a level at (x, y), the nearest one beyond the edge."""
    begin, rows, columns = s.top_at[level]
    scale = 1.0 / (INDEX_CELL * (1 << level))
    j = int(min(max((x - s.west) * scale, 0.0), columns - 1.0))
    i = int(min(max((y - s.south) * scale, 0.0), rows - 1.0))
    return int(begin + i * columns + j)


@compiled
def _start(
    s: Surface, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, spread: float, pad: float
) -> float:
    """How far a beam, `pad` m wide and `spread` wider per metre, certainly meets nothing."""
    t, level, flat = 0.0, LEVELS - 1, max(math.hypot(dx, dy), 1e-6)
    fall = spread - dz
    for _ in range(400):
        # A cell knows what is within one cell of it: half for the way ahead, half for the beam's width.
        size = 0.5 * INDEX_CELL * (1 << level)
        known = min(t + size / flat, (size - pad) / spread)
        low = (oz - pad - s.tops[_cell_of(s, ox + t * dx, oy + t * dy, level)]) / fall
        if low >= known:
            t = max(t, known)
            if level == LEVELS - 1 and t * spread + pad >= size:
                return t
            level = min(level + 1, LEVELS - 1)
        elif level > 0 and t * spread + pad < 0.5 * size:
            level -= 1
        else:
            return float(max(t, low))
    return t


@compiled
def look_ahead(
    s: Surface, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, spread: float, found: I32
) -> tuple[float, int, int]:
    """What a beam can meet: parameter at which it begins, kind of surface, and how many solids stand in `found`."""
    pad = 0.03
    if dz > _SKYWARD - spread:
        return 0.0, _ROUGH if dz - spread < _SKYWARD else _EMPTY, 0
    start = _start(s, ox, oy, oz, dx, dy, dz, spread, pad)
    t, count, kind = start, 0, _SMOOTH
    flat = math.hypot(dx, dy)
    if flat > -_GRAZING * dz:
        kind = _ROUGH
    last = (oz + pad - s.lowest) / (-dz - spread)
    seen = -1
    for _ in range(2000):
        wide, end = _stride(t, flat, last, spread, pad)
        bottom = t
        for di in range(-wide, wide + 1):
            for dj in range(-wide, wide + 1):
                x, y = ox + t * dx + 2 * dj * INDEX_CELL, oy + t * dy + 2 * di * INDEX_CELL
                c = _cell_of(s, x, y, 0)
                i, j = c // s.floor.shape[1], c % s.floor.shape[1]
                bottom = max(bottom, (oz + pad - s.floor[i, j]) / (-dz - spread))
                if c == seen:
                    continue
                seen = c
                if s.steep[i, j] > _SMOOTH_SLOPE:
                    kind = _ROUGH
                for n in range(s.first[c], s.first[c + 1]):
                    k, known = s.listed[n], False
                    for m in range(count):
                        known = known or found[m] == k
                    if not known and count < CANDIDATES and _near(s, k, ox, oy, oz, dx, dy, dz, spread, last):
                        found[count] = k
                        count += 1
        if bottom <= end:
            break
        t = end
    for k in range(s.still, len(s.solids)):
        if count < CANDIDATES and _near(s, k, ox, oy, oz, dx, dy, dz, spread, last):
            found[count] = k
            count += 1
    return start, kind, count


@compiled
def _stride(t: float, flat: float, last: float, spread: float, pad: float) -> tuple[int, float]:
    """How many cells to each side of a beam to look at, every second one, and up to where that is all it can meet."""
    for wide in range(64):
        reach = (wide + 0.5) * INDEX_CELL
        end = min(t + reach / max(flat, 1e-6), last)
        if end * spread + pad <= reach:
            return wide, end
    return 64, end


@compiled
def _near(
    s: Surface, k: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, spread: float, last: float
) -> bool:
    """Whether a beam that ends at `last` may touch a solid, or the ground that a moving one shades."""
    solid = s.solids[k]
    reach = math.hypot(solid.a, solid.b) + (5.0 if k >= s.still else 0.1)
    rx, ry = solid.x - ox, solid.y - oy
    flat = math.hypot(dx, dy)
    # Where the beam, which widens, comes nearest in plan, of its part below the solid's top.
    t = last
    if flat > spread:
        beside = abs(rx * dy - ry * dx) / flat
        t = (rx * dx + ry * dy) / (flat * flat) + beside * spread / (flat * math.sqrt(flat * flat - spread * spread))
    t = max(min(t, last), (oz - solid.top) / (spread - dz), 0.0)
    return bool(math.hypot(rx - t * dx, ry - t * dy) < reach + t * spread + 0.1)


@compiled
def _fall(
    s: Surface, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, begin: float, guess: float
) -> float:
    """Where a ray meets a raster less steep than the ray, near a guessed height: a contraction along the ray."""
    # The last pixel's height is a good guess; what is missed falls below a tenth of itself with each step.
    per_z = 1.0 / dz
    t = max((guess - oz) * per_z, begin)
    enough = 3e-5 * t + 1e-5
    for _ in range(12):
        miss = oz + t * dz - raster_height(s, ox + t * dx, oy + t * dy)
        t -= miss * per_z
        if abs(miss) < enough:
            break
    return t


@compiled
def _march(s: Surface, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, begin: float) -> float:
    """Where a ray meets the raster: lump by lump while it is above, then cell by cell."""
    rows, columns = s.lump_top.shape
    size = CELL * LUMP
    per_size, per_z = 1.0 / size, 1.0 / dz
    per_x = 1.0 / dx if dx != 0.0 else 1e30
    per_y = 1.0 / dy if dy != 0.0 else 1e30
    step = CELL / max(math.hypot(dx, dy), 1e-6)
    side_x, side_y = (1 if dx > 0.0 else 0), (1 if dy > 0.0 else 0)
    last = (oz - s.lowest) / -dz
    t = begin
    for _ in range(6000):
        x, y = ox + t * dx - s.west, oy + t * dy - s.south
        j, i = math.floor(x * per_size), math.floor(y * per_size)
        out = t + min(((j + side_x) * size - x) * per_x, ((i + side_y) * size - y) * per_y) + 1e-6 * (1.0 + t)
        top = s.lump_top[min(max(i, 0), rows - 1), min(max(j, 0), columns - 1)]
        drop = (top - oz) * per_z
        if drop >= out:
            t = out
            continue
        t = max(t, drop)
        before, above = t, oz + t * dz - raster_height(s, ox + t * dx, oy + t * dy)
        if above <= 0.0:
            return float(t)
        while t < out:
            t = min(t + step, out)
            height = oz + t * dz - raster_height(s, ox + t * dx, oy + t * dy)
            if height <= 0.0:
                return _between(s, ox, oy, oz, dx, dy, dz, before, t, above, height)
            before, above = t, height
        if t > last:
            return last
    return t


@compiled
def _between(
    s: Surface, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, t0: float, t1: float, f0: float,
    f1: float,
) -> float:  # fmt: skip
    """Where a ray passes through the raster, above it at t0 and below at t1: regula falsi (Illinois)."""
    t, enough = t1, 1e-4 * t1 + 1e-5
    for _ in range(5):
        last, t = t, (t0 * f1 - t1 * f0) / (f1 - f0)
        if abs(t - last) < enough:
            break
        f = oz + t * dz - raster_height(s, ox + t * dx, oy + t * dy)
        if abs(f) < enough:
            break
        if f > 0.0:
            t0, f0, f1 = t, f, 0.5 * f1
        else:
            t1, f1, f0 = t, f, 0.5 * f0
    return t


@compiled
def _approach(s: Surface, ox: float, oy: float, oz: float, w: F64) -> None:
    """One step of Newton's for a chunk of rays towards the bilinear patch that each is over.

    Only the loop that reads the raster is not made of vectors.
    """
    z = s.height
    rows, columns = z.shape
    x, y, east, north = ox - s.west, oy - s.south, columns - 1.001, rows - 1.001
    for m in range(_CHUNK):
        w[_U + m] = min(max((x + w[_T + m] * w[_DX + m]) * _PER_CELL, 0.0), east)
        w[_V + m] = min(max((y + w[_T + m] * w[_DY + m]) * _PER_CELL, 0.0), north)
    for m in range(_CHUNK):
        i, j = np.uint64(w[_V + m]), np.uint64(w[_U + m])
        w[_Z00 + m], w[_Z01 + m] = z[i, j], z[i, j + _ONE]
        w[_Z10 + m], w[_Z11 + m] = z[i + _ONE, j], z[i + _ONE, j + _ONE]
    for m in range(_CHUNK):
        fu, fv = w[_U + m] - np.floor(w[_U + m]), w[_V + m] - np.floor(w[_V + m])
        to_east, to_north = w[_Z01 + m] - w[_Z00 + m], w[_Z10 + m] - w[_Z00 + m]
        twist = w[_Z11 + m] - w[_Z10 + m] - to_east
        above = oz + w[_T + m] * w[_DZ + m] - (w[_Z00 + m] + to_east * fu + (to_north + twist * fu) * fv)
        rise = (to_east + twist * fv) * w[_DX + m] + (to_north + twist * fu) * w[_DY + m]
        w[_STEP + m] = above / max(rise * _PER_CELL - w[_DZ + m], 0.05)
        w[_T + m] += w[_STEP + m]


@compiled
def _on_raster(
    s: Surface, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, begin: float, kind: int, guess: float
) -> float:
    """Where a ray of a beam meets the raster, of which a height is guessed; −1 where it does not."""
    if kind == _EMPTY or dz > _SKYWARD:
        return -1.0
    if kind == _SMOOTH:
        return _fall(s, ox, oy, oz, dx, dy, dz, begin, guess)
    return _march(s, ox, oy, oz, dx, dy, dz, begin)


@compiled
def _before(
    s: Surface, t: float, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, found: I32, count: int,
    late: float, pace: F64,
) -> tuple[float, int, int]:  # fmt: skip
    """What a ray that meets the raster at t (−1: not) meets first: parameter, solid (or −1, WATER, SKY) and face.

    Moving solids are `late` s further along their `pace` (K, 2) m/s than they stand.
    """
    if t < 0.0:
        return 1e4, SKY, GROUND
    solid, face = -1, GROUND
    if oz + t * dz < s.water:
        t, solid = (s.water - oz) / dz, WATER
    for n in range(count):
        k = found[n]
        px, py = ox, oy
        if k >= s.still:
            px, py = ox - late * pace[k - s.still, 0], oy - late * pace[k - s.still, 1]
        hit, side = enter_house(s.solids, k, px, py, oz, dx, dy, dz)
        if 0.0 < hit < t:
            t, solid, face = hit, k, side
    return t, solid, face


@compiled
def _texel(s: Surface, x: float, y: float, level: int) -> int:
    """Root of light and strength of detail of the raster at (x, y), bilinear in one level: four numbers of 16 bits.

    They are R, B, G and the strength, from the lowest bits on, 256 times what a texel says.
    """
    begin, rows, columns = s.colour_at[level]
    scale = 1.0 / (1 << level)
    per = s.per_texel * scale
    u = min(max((x - s.west) * per + 0.5 * scale - 0.5, 0.0), columns - 1.001)
    v = min(max((y - s.south) * per + 0.5 * scale - 0.5, 0.0), rows - 1.001)
    i, j = int(v), int(u)
    fu, fv = np.uint64((u - j) * 256.0), np.uint64((v - i) * 256.0)
    w11 = (fu * fv) >> np.uint64(8)
    a, c = begin + i * columns + j, s.colour
    b = a + columns
    return np.uint64(
        (np.uint64(256) - fu - fv + w11) * _spread(c[a])
        + (fu - w11) * _spread(c[a + 1])
        + (fv - w11) * _spread(c[b])
        + w11 * _spread(c[b + 1])
    )  # type: ignore[return-value]


@compiled
def _spread(texel: int) -> int:
    """Four bytes in 16 bits each, so that one multiplication weighs them all."""
    t = np.uint64(texel)
    return (t & np.uint64(0x00FF00FF)) | ((t & np.uint64(0xFF00FF00)) << np.uint64(24))  # type: ignore[return-value]


@compiled
def _periodic(texture: U8, begin: int, size: int, u: float, v: float) -> float:
    """Value of a level of a periodic texture of `size` (a power of two) texels a side, bilinear; 1 on average."""
    fu, fv = math.floor(u), math.floor(v)
    n = np.uint64(size - 1)
    j, i = np.uint64(np.int64(fu)) & n, np.uint64(np.int64(fv)) & n
    j1, i1 = (j + _ONE) & n, (i + _ONE) & n
    u, v = u - fu, v - fv
    a, b = np.uint64(begin) + i * np.uint64(size), np.uint64(begin) + i1 * np.uint64(size)
    low = texture[a + j] * (1.0 - u) + texture[a + j1] * u
    high = texture[b + j] * (1.0 - u) + texture[b + j1] * u
    return float(low * (1.0 - v) + high * v) / 128.0


@compiled
def _pyramid_texel(texture: U8, begin: int, size: int, levels: int, u: float, v: float, lod: float) -> float:
    """Value of a periodic texture at texels (u, v) of its finest level, seen at a level of detail."""
    level = min(max(int(lod + 0.5), 0), levels - 1)
    for _ in range(level):
        begin += size * size
        size //= 2
    scale = 1.0 / (1 << level)
    return _periodic(texture, begin, size, (u + 0.5) * scale - 0.5, (v + 0.5) * scale - 0.5)


@compiled
def detail_gain(s: Surface, u: float, v: float, footprint: float, strength: float) -> float:
    """Factor of the finest detail at surface coordinates m, when a pixel is as wide as `footprint` m."""
    if footprint > _FINEST:
        return 1.0
    lod = math.log2(max(footprint / DETAIL_TEXEL, 1e-3))
    fine = _pyramid_texel(s.detail, 0, DETAIL_TEXELS, DETAIL_MIPS, u / DETAIL_TEXEL, v / DETAIL_TEXEL, lod)
    if footprint < 0.5 * DETAIL_TEXEL:  # on the ground: the same once more, eleven times as fine
        u, v = 11.3 * u, 11.3 * v
        fine += 0.8 * _pyramid_texel(
            s.detail, 0, DETAIL_TEXELS, DETAIL_MIPS, u / DETAIL_TEXEL, v / DETAIL_TEXEL, lod + 3.5
        )
        fine -= 0.8
    return max(1.0 + strength * (fine - 1.0), 0.1)


@compiled
def raster_light(s: Surface, x: float, y: float, lod: float, footprint: float) -> tuple[float, float, float]:
    """Light RGB that the raster sends out at (x, y), between two levels of its texture."""
    level = min(max(int(lod), 0), MIPS - 2)
    rest = min(max(lod - level, 0.0), 1.0)
    near, far = _texel(s, x, y, level), _texel(s, x, y, level + 1)
    r = (1.0 - rest) * (near & _LOW) + rest * (far & _LOW)
    g = (1.0 - rest) * (near >> _GREEN & _LOW) + rest * (far >> _GREEN & _LOW)
    b = (1.0 - rest) * (near >> _BLUE & _LOW) + rest * (far >> _BLUE & _LOW)
    gain = 1.0 / 256.0
    if footprint < _FINEST:
        gain *= detail_gain(s, x, y, footprint, (near >> _STRENGTH) / 25600.0)
    gain *= gain * _UNIT
    return r * r * gain, g * g * gain, b * b * gain


@compiled
def _sunlit(s: Surface, x: float, y: float, z: float) -> float:
    """How much of the sun reaches a point, 0 to 1."""
    h, w = s.shadow.shape
    u = min(max((x - s.west) * _PER_CELL, 0.0), w - 1.001)
    v = min(max((y - s.south) * _PER_CELL, 0.0), h - 1.001)
    i, j = int(v), int(u)
    fu, fv = u - j, v - i
    a = s.shadow
    low = a[i, j] + (a[i, j + 1] - a[i, j]) * fu
    high = a[i + 1, j] + (a[i + 1, j + 1] - a[i + 1, j]) * fu
    return float(min(max((z + 0.1 - low - (high - low) * fv) * 5.0, 0.0), 1.0))


@compiled
def solid_light(
    s: Surface, light: Light, k: int, face: int, x: float, y: float, z: float, footprint: float
) -> tuple[float, float, float]:
    """Light RGB that a solid sends out at a point on one of its faces."""
    solid = s.solids[k]
    rx, ry = x - solid.x, y - solid.y
    u, v = solid.cos * rx + solid.sin * ry, solid.cos * ry - solid.sin * rx
    nu, nv, nz = 0.0, 0.0, 0.0
    if face >= NORTH_ROOF:
        flat = math.sqrt(1.0 + solid.slope * solid.slope)
        nv, nz = (solid.slope if face == NORTH_ROOF else -solid.slope) / flat, 1.0 / flat
        across, up = u, flat * (abs(v) if solid.slope > 0.0 else v)
        colour, pattern, piece = solid.roof, solid.roof_pattern, 2 * solid.seed + (face == SOUTH_ROOF)
    else:
        if face <= WEST_WALL:
            nu, across = (1.0 if face == EAST_WALL else -1.0), v
        else:
            nv, across = (1.0 if face == NORTH_WALL else -1.0), u
        up = z - solid.top
        colour, pattern, piece = solid.wall, solid.wall_pattern, 8 * solid.seed + face
    nx, ny = solid.cos * nu - solid.sin * nv, solid.sin * nu + solid.cos * nv
    cosine = nx * light.sun[0] + ny * light.sun[1] + nz * light.sun[2]
    sun = 0.0 if cosine <= 0.0 else cosine * _sunlit(s, x + 0.3 * nx, y + 0.3 * ny, z + 0.05)
    sky = 0.45 + 0.55 * nz
    begin = pattern * (PATTERN_TEXELS * PATTERN_TEXELS * 4 // 3)
    lod = math.log2(max(footprint / PATTERN_TEXEL, 1e-3))
    if pattern > 0:
        shift = 97.0 * piece if nz > 0.0 or pattern < 4 else 0.0
        gain = _pyramid_texel(
            s.pattern, begin, PATTERN_TEXELS, PATTERN_MIPS, across / PATTERN_TEXEL + shift, up / PATTERN_TEXEL, lod
        )
        gain *= detail_gain(s, across + 0.37 * piece, up, footprint, 0.12)
        gain *= gain
    else:
        gain = 1.0
    return (
        colour[0] * gain * (light.sun_colour[0] * sun + light.sky_colour[0] * sky),
        colour[1] * gain * (light.sun_colour[1] * sun + light.sky_colour[1] * sky),
        colour[2] * gain * (light.sun_colour[2] * sun + light.sky_colour[2] * sky),
    )


@compiled
def _water_light(
    s: Surface, light: Light, x: float, y: float, dx: float, dy: float, dz: float, footprint: float, t_s: float
) -> tuple[float, float, float]:
    """Light RGB of still water under a breeze: sky and sun mirrored by moving ripples, over a dark ground."""
    lod = math.log2(max(footprint / 0.03, 1e-3))
    wave = 0.0
    tilt_x, tilt_y = 0.0, 0.0
    for n in range(2):
        drift = (0.5 + 0.3 * n) * t_s
        u, v = (x + drift) / 0.03 + 300.0 * n, (y + (0.6 - n) * drift) / 0.03
        here = _pyramid_texel(s.detail, 0, DETAIL_TEXELS, DETAIL_MIPS, u, v, lod)
        tilt_x += 0.4 * (_pyramid_texel(s.detail, 0, DETAIL_TEXELS, DETAIL_MIPS, u + 4.0, v, lod) - here)
        tilt_y += 0.4 * (_pyramid_texel(s.detail, 0, DETAIL_TEXELS, DETAIL_MIPS, u, v + 4.0, lod) - here)
        wave += here - 1.0
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    ex, ey, ez = dx / length, dy / length, dz / length
    into = -(ex * tilt_x + ey * tilt_y + ez) / math.sqrt(1.0 + tilt_x * tilt_x + tilt_y * tilt_y)
    mirrored = 0.02 + 0.98 * max(1.0 - into, 0.0) ** 5
    glint_x, glint_y, glint_z = ex + 2.0 * into * tilt_x, ey + 2.0 * into * tilt_y, ez + 2.0 * into
    towards = glint_x * light.sun[0] + glint_y * light.sun[1] + glint_z * light.sun[2]
    glint = 1.5 * max(towards, 0.0) ** 200
    ground = 0.05 * (1.0 + 0.35 * wave)
    return ground + mirrored * 0.7 + glint, 1.25 * ground + mirrored * 0.8 + glint, 1.15 * ground + mirrored + glint


@compiled
def _leafy(s: Surface, x: float, y: float) -> int:
    """How much of a plant the raster is at (x, y), 0 to 255."""
    h, w = s.sway.shape
    i = np.uint64(min(max((y - s.south) * _PER_CELL, 0.0), h - 1.0))
    j = np.uint64(min(max((x - s.west) * _PER_CELL, 0.0), w - 1.0))
    return int(s.sway[i, j])


@compiled
def _leaf(s: Surface, x: float, y: float, z: float, lod: float) -> float:
    """Factor on the light of a plant at a point: leaves break up texture drawn out on the sides of crowns."""
    u, v = (x - 0.6 * y + 0.3 * z) * _PER_LEAF, (0.9 * z + 0.4 * y) * _PER_LEAF
    leaf = _pyramid_texel(s.detail, 0, DETAIL_TEXELS, DETAIL_MIPS, u, v, lod + 0.3)
    return min(max(0.3 + 0.7 * leaf, 0.1), 2.0)


@compiled
def _blown(x: float, y: float, size: float, t_s: float) -> tuple[float, float]:
    """Where what is seen at (x, y) stands in still air."""
    x += size * math.sin(2.1 * t_s + 0.5 * x + 0.3 * y)
    return x, y + size * math.sin(1.7 * t_s + 0.4 * y - 0.2 * x + 1.0)


@compiled
def _seen(
    s: Surface, light: Light, t: float, solid: int, face: int, ox: float, oy: float, oz: float, dx: float, dy: float,
    dz: float, pixel: float, lod: float, found: I32, count: int, late: float, pace: F64, t_s: float, sway: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Light RGB that arrives along a ray which met something."""
    if solid == SKY:
        return 0.55, 0.68, 0.90
    x, y, footprint = ox + t * dx, oy + t * dy, t * pixel
    if solid == WATER:
        return _water_light(s, light, x, y, dx, dy, dz, footprint, t_s)
    if solid >= 0:
        if solid >= s.still:
            x, y = x - late * pace[solid - s.still, 0], y - late * pace[solid - s.still, 1]
        return solid_light(s, light, solid, face, x, y, oz + t * dz, footprint)
    shade = 1.0
    for n in range(count):
        k = found[n]
        if k >= s.still:
            px, py = x - late * pace[k - s.still, 0], y - late * pace[k - s.still, 1]
            sun = light.sun
            hit, _ = enter_house(s.solids, k, px, py, oz + t * dz + 0.02, sun[0], sun[1], sun[2])
            if 0.0 < hit < 50.0:
                shade = 0.3
    leafy = _leafy(s, x, y)
    if leafy > 0:
        shade *= _leaf(s, x, y, oz + t * dz, lod)
        if sway > 0.0:
            x, y = _blown(x, y, sway * leafy / 255.0, t_s)
    r, g, b = raster_light(s, x, y, lod, footprint)
    return r * shade, g * shade, b * shade


@compiled
def render(s: Surface, light: Light, view: View, sway: float, image: F32) -> None:
    """Fill `image` (H, W, 3) with light BGR through the rays of a view; plants move by `sway` m in the wind."""
    _prepare(s, view)
    for sweep in range(len(_FAR)):
        _sweep(s, view, _FAR[sweep], sweep > 0, (sweep + 1) % 2 > 0)
    _shade(s, light, view, sway, image)


@compiled
def _prepare(s: Surface, view: View) -> None:
    """Find what each block of a view can meet."""
    rays, R, p, pixel = view.rays, view.R, view.p, view.pixel
    height, width, _ = rays.shape
    n = 0
    for i0 in range(0, height, BLOCK):
        i1 = min(i0 + BLOCK, height)
        for j0 in range(0, width, BLOCK):
            j1 = min(j0 + BLOCK, width)
            im = (i0 + i1) // 2
            rx = 0.5 * (rays[i0, j0, 0] + rays[i1 - 1, j1 - 1, 0])
            ry = 0.5 * (rays[i0, j0, 1] + rays[i1 - 1, j1 - 1, 1])
            dx, dy, dz = _turned(R, im, rx, ry)
            spread = 0.75 * (BLOCK + 1) * pixel
            start, kind, count = look_ahead(s, p[im, 0], p[im, 1], p[im, 2], dx, dy, dz, spread, view.blocks[n, 2:])
            view.starts[n], view.blocks[n, 0], view.blocks[n, 1] = start, kind, count
            n += 1


@compiled
def _sweep(s: Surface, view: View, far: int, between: bool, turn: bool) -> None:
    """Trace the first rays, every `far` pixels, or those between two that are `far` left and right, or up and down.

    Rays between two that meet the raster nearly as deep look for it there; they are moved chunk by chunk. Others look
    for it from where their beam begins, or just before the nearer of the two.
    """
    rays, depth, what, w = view.rays, view.depth, view.what, view.chunk
    height, width, _ = rays.shape
    across = (width + BLOCK - 1) // BLOCK
    turn = turn and between
    begin_i, step_i = (far, 2 * far) if turn else (0, 2 * far if between else far)
    begin_j, step_j = (0, far) if turn or not between else (far, 2 * far)
    for i in range(begin_i, height, step_i):
        ox, oy, oz = view.p[i, 0], view.p[i, 1], view.p[i, 2]
        late, guess = view.row_s * (i - 0.5 * (height - 1)), 0.0
        up, down = (i - far, i + far if i + far < height else i - far) if turn else (i, i)
        for left in range(begin_j, width, step_j * _CHUNK):
            length = min(_CHUNK, (width - left + step_j - 1) // step_j)
            for m in range(_CHUNK):
                j = left + min(m, length - 1) * step_j  # what is beyond the row shall not run away
                w[_DX + m], w[_DY + m], w[_DZ + m] = _turned(view.R, i, rays[i, j, 0], rays[i, j, 1])
                w[_NEARBY + m] = -1.0
                if between:
                    ja, jb = (j, j) if turn else (j - far, j + far if j + far < width else j - far)
                    first, second = depth[up, ja], depth[down, jb]
                    gap = abs(first - second)
                    w[_T + m] = w[_GUESS + m] = 0.5 * (first + second)
                    if what[up, ja] == _RASTER and what[down, jb] == _RASTER:
                        w[_NEARBY + m] = gap + 0.006 * first if gap < _NEAR * first else 0.0
            if between:
                for _ in range(3):
                    _approach(s, ox, oy, oz, w)
            for m in range(length):
                j = left + m * step_j
                n = i // BLOCK * across + j // BLOCK
                begin, kind, count = view.starts[n], view.blocks[n, 0], view.blocks[n, 1]
                dx, dy, dz, t = w[_DX + m], w[_DY + m], w[_DZ + m], w[_T + m]
                # Steps more than double the digits: after a small one nothing is left to do.
                lost = abs(t - w[_GUESS + m]) > w[_NEARBY + m] or abs(w[_STEP + m]) > 1e-4 * t
                if w[_NEARBY + m] < 0.0 or lost or kind == _EMPTY:
                    if w[_NEARBY + m] >= 0.0:
                        ja, jb = (j, j) if turn else (j - far, j + far if j + far < width else j - far)
                        near = (1.0 - 0.5 * _NEAR) * min(depth[up, ja], depth[down, jb])
                        if near > begin and oz + near * dz > raster_height(s, ox + near * dx, oy + near * dy):
                            begin = near
                    t = _on_raster(s, ox, oy, oz, dx, dy, dz, begin, kind, guess)
                guess = oz + t * dz
                t, solid, face = _before(
                    s, t, ox, oy, oz, dx, dy, dz, view.blocks[n, 2:], count, late, view.pace
                )  # fmt: skip
                depth[i, j], what[i, j] = t, solid * 16 + face


@compiled
def _shade(s: Surface, light: Light, view: View, sway: float, image: F32) -> None:
    """Fill `image` with the light of what the rays of a view met; four rays where neighbours see different things."""
    rays, depth, what, w = view.rays, view.depth, view.what, view.chunk
    height, width, _ = rays.shape
    across = (width + BLOCK - 1) // BLOCK
    for i in range(height):
        ox, oy, oz = view.p[i, 0], view.p[i, 1], view.p[i, 2]
        late = view.row_s * (i - 0.5 * (height - 1))
        up, down = max(i - 1, 0), min(i + 1, height - 1)
        for begin in range(0, width, _CHUNK):
            length = min(_CHUNK, width - begin)
            for m in range(length):
                t = depth[i, begin + m]
                dx, dy, dz = _turned(view.R, i, rays[i, begin + m, 0], rays[i, begin + m, 1])
                w[_X + m], w[_Y + m], w[_Z + m] = ox + t * dx, oy + t * dy, oz + t * dz
            _raster_lights(s, view, i, begin, length, sway, view.t_s + late)
            for m in range(length):
                j = begin + m
                n = i // BLOCK * across + j // BLOCK
                count = view.blocks[n, 1]
                k, left, right = what[i, j], max(j - 1, 0), min(j + 1, width - 1)
                same = what[up, j] == k and what[down, j] == k and what[i, left] == k and what[i, right] == k
                if same and k == _RASTER and (count == 0 or view.blocks[n, count + 1] < s.still):
                    footprint = depth[i, j] * view.pixel
                    gain = _UNIT
                    if footprint < _FINEST:
                        strength = (view.texels[_FINE + m] >> _STRENGTH) / 25600.0
                        fine = detail_gain(s, w[_X + m], w[_Y + m], footprint, strength)
                        gain *= fine * fine
                    gain *= w[_SHADE + m]
                    r, g, b = gain * w[_R + m], gain * w[_G + m], gain * w[_B + m]
                else:
                    r, g, b = _pixel(s, light, view, i, j, n, same, sway)
                image[i, j, 0], image[i, j, 1], image[i, j, 2] = b, g, r


@compiled
def _lod(s: Surface, view: View, i: int, j: int) -> float:
    """Level of detail of the surface's texture for the pixels of a row in one block."""
    return math.log2(max(1.15 * view.depth[i, j // BLOCK * BLOCK] * view.pixel / s.texel, 1e-3))


@compiled
def _raster_lights(s: Surface, view: View, i: int, begin: int, length: int, sway: float, t_s: float) -> None:
    """For a chunk of points X, Y, Z: light R, G, B of the raster as `raster_light` says, and the SHADE of leaves on it.

    The finest detail is left out; points on plants are moved to where they stand in still air.
    """
    w, c = view.chunk, view.texels
    lod = 0.0
    for m in range(length):
        if m % BLOCK == 0:
            lod = _lod(s, view, i, begin + m)
        x, y, w[_SHADE + m] = w[_X + m], w[_Y + m], 1.0
        leafy = _leafy(s, x, y)
        if leafy > 0:
            w[_SHADE + m] = _leaf(s, x, y, w[_Z + m], lod)
            if sway > 0.0:
                w[_X + m], w[_Y + m] = _blown(x, y, sway * leafy / 255.0, t_s)
    for coarser in range(2):
        for first in range(0, length, BLOCK):
            lod = _lod(s, view, i, begin + first)
            level = min(max(int(lod), 0), MIPS - 2)
            rest = min(max(lod - level, 0.0), 1.0)
            level += coarser
            start, rows, columns = s.colour_at[level]
            scale = 1.0 / (1 << level)
            for m in range(first, first + BLOCK):
                w[_PER + m], w[_SHIFT + m], w[_REST + m] = s.per_texel * scale, 0.5 * scale - 0.5, rest
                w[_BEGIN + m], w[_ROW + m] = start, columns
                w[_EAST + m], w[_NORTH + m] = columns - 1.001, rows - 1.001
        to = _COARSE if coarser else _FINE
        for m in range(_CHUNK):
            u = min(max((w[_X + m] - s.west) * w[_PER + m] + w[_SHIFT + m], 0.0), w[_EAST + m])
            v = min(max((w[_Y + m] - s.south) * w[_PER + m] + w[_SHIFT + m], 0.0), w[_NORTH + m])
            w[_FU + m], w[_FV + m] = (u - np.floor(u)) * 256.0, (v - np.floor(v)) * 256.0
            w[_AT + m] = w[_BEGIN + m] + np.floor(v) * w[_ROW + m] + np.floor(u)
        for m in range(length):
            a, b = np.uint64(w[_AT + m]), np.uint64(w[_AT + m] + w[_ROW + m])
            c[_C00 + m], c[_C01 + m] = s.colour[a], s.colour[a + _ONE]
            c[_C10 + m], c[_C11 + m] = s.colour[b], s.colour[b + _ONE]
        for m in range(_CHUNK):
            fu, fv = np.uint64(w[_FU + m]), np.uint64(w[_FV + m])
            w11 = (fu * fv) >> np.uint64(8)
            c[to + m] = (
                (np.uint64(256) - fu - fv + w11) * _spread(c[_C00 + m])
                + (fu - w11) * _spread(c[_C01 + m])
                + (fv - w11) * _spread(c[_C10 + m])
                + w11 * _spread(c[_C11 + m])
            )
    for m in range(_CHUNK):
        near, far, rest = c[_FINE + m], c[_COARSE + m], w[_REST + m]
        r = ((1.0 - rest) * (near & _LOW) + rest * (far & _LOW)) / 256.0
        g = ((1.0 - rest) * (near >> _GREEN & _LOW) + rest * (far >> _GREEN & _LOW)) / 256.0
        b = ((1.0 - rest) * (near >> _BLUE & _LOW) + rest * (far >> _BLUE & _LOW)) / 256.0
        w[_R + m], w[_G + m], w[_B + m] = r * r, g * g, b * b


@compiled
def _pixel(
    s: Surface, light: Light, view: View, i: int, j: int, n: int, same: bool, sway: float
) -> tuple[float, float, float]:
    """Light RGB of a pixel of block n: of its ray, or where its neighbours do not see the `same`, of four."""
    kind, count, found, pixel = view.blocks[n, 0], view.blocks[n, 1], view.blocks[n, 2:], view.pixel
    ox, oy, oz = view.p[i, 0], view.p[i, 1], view.p[i, 2]
    late = view.row_s * (i - 0.5 * (view.rays.shape[0] - 1))
    t_s, lod, t = view.t_s + late, _lod(s, view, i, j), view.depth[i, j]
    solid, face = view.what[i, j] >> 4, view.what[i, j] & 15
    rays, r, g, b = (1 if same else 4), 0.0, 0.0, 0.0
    fu, fv = (0.0, 0.0) if same else (-0.125 * pixel, -0.375 * pixel)
    for _ in range(rays):
        fu, fv = -fv, fu  # a turned square: four different rows and columns
        dx, dy, dz = _turned(view.R, i, view.rays[i, j, 0] + fu, view.rays[i, j, 1] + fv)
        if not same:
            t = _on_raster(s, ox, oy, oz, dx, dy, dz, view.starts[n], kind, oz + view.depth[i, j] * dz)
            t, solid, face = _before(s, t, ox, oy, oz, dx, dy, dz, found, count, late, view.pace)
            lod = math.log2(max(1.15 * t * pixel / s.texel, 1e-3))
        r1, g1, b1 = _seen(
            s, light, t, solid, face, ox, oy, oz, dx, dy, dz, pixel, lod, found, count, late, view.pace, t_s, sway
        )
        r, g, b = r + r1 / rays, g + g1 / rays, b + b1 / rays
    return r, g, b


@compiled
def _turned(R: F64, i: int, x: float, y: float) -> tuple[float, float, float]:
    """The ray (x, y, 1) of row i in world."""
    return (
        R[i, 0, 0] * x + R[i, 0, 1] * y + R[i, 0, 2],
        R[i, 1, 0] * x + R[i, 1, 1] * y + R[i, 1, 2],
        R[i, 2, 0] * x + R[i, 2, 1] * y + R[i, 2, 2],
    )


@compiled
def raster_heights(s: Surface, xy: F64, z: F64) -> None:
    """Fill `z` (N,) with the height of the raster at `xy` (N, 2)."""
    for n in range(len(xy)):
        z[n] = raster_height(s, xy[n, 0], xy[n, 1])


@compiled
def _top(s: Surface, x: float, y: float) -> tuple[float, int]:
    """Height of the surface and what forms it (as `_before` says)."""
    best, solid = raster_height(s, x, y), -1
    if best < s.water:
        best, solid = s.water, WATER
    c = _cell_of(s, x, y, 0)
    for n in range(s.first[c], s.first[c + 1]):
        k = s.listed[n]
        part = s.solids[k]
        rx, ry = x - part.x, y - part.y
        u, v = part.cos * rx + part.sin * ry, part.cos * ry - part.sin * rx
        if abs(u) <= part.a and abs(v) <= part.b and part.top - part.slope * abs(v) > best:
            best, solid = part.top - part.slope * abs(v), k
    return best, solid


@compiled
def heights(s: Surface, xy: F64, z: F64) -> None:
    """Fill `z` (N,) with the height of the surface at `xy` (N, 2)."""
    for n in range(len(xy)):
        z[n], _ = _top(s, xy[n, 0], xy[n, 1])


@compiled
def colours(s: Surface, light: Light, xy: F64, rgb: F64) -> None:
    """Fill `rgb` (N, 3) with the light that the surface sends upwards at `xy` (N, 2)."""
    for n in range(len(xy)):
        x, y = xy[n, 0], xy[n, 1]
        z, solid = _top(s, x, y)
        if solid >= 0:
            part = s.solids[solid]
            north = part.cos * (y - part.y) - part.sin * (x - part.x) > 0.0
            r, g, b = solid_light(s, light, solid, NORTH_ROOF if north else SOUTH_ROOF, x, y, z, 0.06)
        elif solid == WATER:
            r, g, b = _water_light(s, light, x, y, 0.0, 0.0, -1.0, 0.06, 0.0)
        else:
            r, g, b = raster_light(s, x, y, 1.0, 0.06)
        rgb[n, 0], rgb[n, 1], rgb[n, 2] = r, g, b


@compiled
def intersections(s: Surface, origin: F64, directions: F64, found: I32, p: F64, solid: I32) -> None:
    """Fill `p` (N, 3) and `solid` (N,) with where descending rays (N, 3) from one origin (3,) meet the surface."""
    ox, oy, oz = origin
    pace = directions[:1, :2]
    for n in range(len(directions)):
        length = math.sqrt(directions[n, 0] ** 2 + directions[n, 1] ** 2 + directions[n, 2] ** 2)
        dx, dy, dz = directions[n, 0] / length, directions[n, 1] / length, directions[n, 2] / length
        start, kind, count = look_ahead(s, ox, oy, oz, dx, dy, dz, 1e-4, found)
        t = _on_raster(s, ox, oy, oz, dx, dy, dz, start, kind, oz + start * dz)
        t, solid[n], _ = _before(s, t, ox, oy, oz, dx, dy, dz, found, count, 0.0, pace)
        p[n, 0], p[n, 1], p[n, 2] = ox + t * dx, oy + t * dy, oz + t * dz


@compiled
def hidden(s: Surface, origin: F64, directions: F64, out: Bool) -> None:
    """Fill `out` (N,) with whether the surface hides directions (N, 3) from an origin (3,).

    The raster is looked at every half cell, solids exactly.
    """
    ox, oy, oz = origin
    for n in range(len(directions)):
        dx, dy, dz = directions[n]
        flat = max(math.hypot(dx, dy), 1e-9)
        t, out[n] = 0.0, dz <= 0.0 and flat < 1e-6
        for _ in range(100000):
            z = oz + t * dz
            if out[n] or (dz >= 0.0 and z > s.highest) or t * flat > 2000.0:
                break
            x, y = ox + t * dx, oy + t * dy
            c = _cell_of(s, x, y, 0)
            if z > s.tops[c] and dz >= 0.0:
                t += 0.5 * INDEX_CELL / flat
                continue
            if z < raster_height(s, x, y):
                out[n] = True
            for m in range(s.first[c], s.first[c + 1]):
                hit, _ = enter_house(s.solids, s.listed[m], ox, oy, oz, dx, dy, dz)
                if 0.0 <= hit < 1e9:
                    out[n] = True
            t += 0.5 * CELL / flat
