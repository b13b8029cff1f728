"""Rays against a surface of smooth terrain and convex solids, compiled.

Everything compiled stands in this one file, because numba's cache notices a changed file, not a changed callee.
The surface is 2.5D: every solid reaches down into the ground, and the highest point at (x, y) is the surface.
The definitions here ARE the truth: bilinear terrain, exact planes and ellipsoids.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit

from air.sources.simulated.sites.scene import (
    DOME,
    DOME_SIDE,
    DOME_TOP,
    EAST_WALL,
    GROUND,
    HOUSE,
    NORTH_ROOF,
    NORTH_WALL,
    PLASTER,
    RIBS,
    SOUTH_ROOF,
    SOUTH_WALL,
    TILES,
    WEST_WALL,
    Light,
    Scene,
    Solids,
)
from common.arrays import F32, F64, I32

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """The function compiled by numba, cached on disk; one thread and strict arithmetic, so it is deterministic.

    Compiled functions allocate nothing, so they need no run time (`_nrt`), whose counting of references to the
    arrays of a scene would double the time of a ray; inlined, they do not hand the scene around on the stack.
    """
    return cast(F, njit(cache=True, error_model="numpy", _nrt=False, forceinline=True, nogil=True)(function))


@compiled
def terrain_height(scene: Scene, x: float, y: float) -> float:
    """Height of the bare terrain, m; beyond the edge that of the edge."""
    h, w = scene.terrain.shape
    u = min(max((x - scene.west) / scene.terrain_cell, 0.0), w - 1.000001)
    v = min(max((y - scene.south) / scene.terrain_cell, 0.0), h - 1.000001)
    i, j = int(v), int(u)
    fu, fv = u - j, v - i
    z = scene.terrain
    low = z[i, j] * (1.0 - fu) + z[i, j + 1] * fu
    high = z[i + 1, j] * (1.0 - fu) + z[i + 1, j + 1] * fu
    return float(low * (1.0 - fv) + high * fv)


@compiled
def solid_height(scene: Scene, k: int, x: float, y: float) -> float:
    """Height of the top of a solid at (x, y), m; −inf beside it."""
    s = scene.solids[k]
    dx, dy = x - s.x, y - s.y
    if s.kind == HOUSE:
        u, v = s.cos * dx + s.sin * dy, s.cos * dy - s.sin * dx
        if abs(u) > s.a or abs(v) > s.b:
            return -np.inf
        return float(s.top - s.slope * abs(v))
    q = (dx * dx + dy * dy) / (s.a * s.a)
    return -np.inf if q > 1.0 else float(s.top - s.b * (1.0 - math.sqrt(1.0 - q)))


@compiled
def index_of(scene: Scene, x: float, y: float) -> int:
    """Cell of the index grid at (x, y), or −1 outside."""
    j = math.floor((x - scene.west) / scene.index_cell)
    i = math.floor((y - scene.south) / scene.index_cell)
    if i < 0 or j < 0 or i >= scene.index_height or j >= scene.index_width:
        return -1
    return i * scene.index_width + j


@compiled
def top_at(scene: Scene, x: float, y: float) -> tuple[float, int]:
    """Height of the surface, m, and the solid that forms it (−1: terrain)."""
    best, solid = terrain_height(scene, x, y), -1
    c = index_of(scene, x, y)
    if c >= 0:
        for n in range(scene.first[c], scene.first[c + 1]):
            z = solid_height(scene, scene.listed[n], x, y)
            if z > best:
                best, solid = z, scene.listed[n]
    return best, solid


@compiled
def enter_house(
    solids: Solids, k: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, int]:
    """Where a ray enters a house: parameter (inf: it misses) and face, by clipping with its six half-spaces."""
    s = solids[k]
    rx, ry = ox - s.x, oy - s.y
    u, v = s.cos * rx + s.sin * ry, s.cos * ry - s.sin * rx
    du, dv = s.cos * dx + s.sin * dy, s.cos * dy - s.sin * dx
    z, slope = oz - s.top, s.slope
    t_in, t_out, face_in = -np.inf, np.inf, 0
    for face in range(6):
        if face == EAST_WALL:
            outside, rate = u - s.a, du
        elif face == WEST_WALL:
            outside, rate = -u - s.a, -du
        elif face == NORTH_WALL:
            outside, rate = v - s.b, dv
        elif face == SOUTH_WALL:
            outside, rate = -v - s.b, -dv
        elif face == NORTH_ROOF:
            outside, rate = z + slope * v, dz + slope * dv
        else:
            outside, rate = z - slope * v, dz - slope * dv
        if rate > 0.0:
            t_out = min(t_out, -outside / rate)
        elif rate < 0.0:
            t = -outside / rate
            if t > t_in:
                t_in, face_in = t, face
        elif outside > 0.0:
            return np.inf, 0
        if t_in >= t_out:
            return np.inf, 0
    return t_in, face_in


@compiled
def _enter_dome(
    solids: Solids, k: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, int]:
    """Where a ray enters a dome: parameter (inf: it misses) and face."""
    s = solids[k]
    rx, ry, rz = ox - s.x, oy - s.y, oz - (s.top - s.b)
    # In units of the radii the ellipsoid is the unit sphere and the cylinder has radius one.
    rx, ry, rz = rx / s.a, ry / s.a, rz / s.b
    ex, ey, ez = dx / s.a, dy / s.a, dz / s.b
    a, b, c = ex * ex + ey * ey, rx * ex + ry * ey, rx * rx + ry * ry - 1.0
    side = b * b - a * c
    if side <= 0.0:
        return np.inf, 0
    b_top = b + rz * ez
    a_top = a + ez * ez
    top = b_top * b_top - a_top * (c + rz * rz)
    if top > 0.0:
        t = (-b_top - math.sqrt(top)) / a_top
        if rz + t * ez >= 0.0:
            return t, DOME_TOP
    if a > 0.0:
        t = (-b - math.sqrt(side)) / a
        if rz + t * ez < 0.0:
            return t, DOME_SIDE
    return np.inf, 0


@compiled
def first_solid(
    scene: Scene, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, t0: float, t1: float
) -> tuple[float, int, int]:
    """First solid that a ray enters between t0 and t1: parameter (t1: none), solid (−1: none) and face.

    Walks the cells of the index grid (Amanatides and Woo, 1987) and passes over those that the ray is above.
    """
    solids, first, listed, cell_top = scene.solids, scene.first, scene.listed, scene.cell_top
    rows, columns = scene.index_height, scene.index_width
    cell = scene.index_cell
    x0, y0 = ox + t0 * dx - scene.west, oy + t0 * dy - scene.south
    j, i = math.floor(x0 / cell), math.floor(y0 / cell)
    step_j, step_i = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    t_x = t0 + ((j + (dx > 0)) * cell - x0) / dx if dx != 0.0 else np.inf
    t_y = t0 + ((i + (dy > 0)) * cell - y0) / dy if dy != 0.0 else np.inf
    dt_x = cell / abs(dx) if dx != 0.0 else np.inf
    dt_y = cell / abs(dy) if dy != 0.0 else np.inf
    best, solid, face = t1, -1, GROUND
    t = t0
    while t < best:
        t_next = min(t_x, t_y)
        if 0 <= i < rows and 0 <= j < columns:
            c = i * columns + j
            if oz + min(dz * t, dz * min(t_next, best)) < cell_top[c]:
                for n in range(first[c], first[c + 1]):
                    k = listed[n]
                    if solids[k].kind == HOUSE:
                        t_hit, f = enter_house(solids, k, ox, oy, oz, dx, dy, dz)
                    else:
                        t_hit, f = _enter_dome(solids, k, ox, oy, oz, dx, dy, dz)
                    if t0 <= t_hit < best:
                        best, solid, face = t_hit, k, f
        t = t_next
        if t_x < t_y:
            j += step_j
            t_x += dt_x
        else:
            i += step_i
            t_y += dt_y
    return best, solid, face


@compiled
def trace(scene: Scene, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> tuple[float, int, int]:
    """Where a descending ray from above the surface meets it: parameter, solid (−1: terrain) and face."""
    # The terrain is far less steep than any ray, so dropping onto it along the ray converges like a contraction.
    per_z = 1.0 / dz
    t = -oz * per_z
    for _ in range(12):
        miss = oz + t * dz - terrain_height(scene, ox + t * dx, oy + t * dy)
        t -= miss * per_z
        if abs(miss) < 1e-4:
            break
    return first_solid(scene, ox, oy, oz, dx, dy, dz, min(t, (scene.highest - oz) * per_z), t)


@compiled
def normal_at(scene: Scene, solid: int, face: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit outward normal of the surface at a point on it."""
    if solid < 0:
        e = 0.5 * scene.terrain_cell
        nx = (z - terrain_height(scene, x + e, y)) / e
        ny = (z - terrain_height(scene, x, y + e)) / e
        nz = 1.0
    elif scene.solids[solid].kind == HOUSE:
        s = scene.solids[solid]
        nu, nv, nz = 0.0, 0.0, 0.0
        if face == EAST_WALL:
            nu = 1.0
        elif face == WEST_WALL:
            nu = -1.0
        elif face == NORTH_WALL:
            nv = 1.0
        elif face == SOUTH_WALL:
            nv = -1.0
        else:
            nv, nz = (s.slope if face == NORTH_ROOF else -s.slope), 1.0
        nx, ny = s.cos * nu - s.sin * nv, s.sin * nu + s.cos * nv
    else:
        s = scene.solids[solid]
        nx, ny, nz = (x - s.x) / s.a**2, (y - s.y) / s.a**2, 0.0
        if face == DOME_TOP:
            nz = (z - s.top + s.b) / s.b**2
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length


@compiled
def _bilinear(texture: F32, x: float, y: float) -> float:
    """Value of a periodic texture (D, D), D a power of two, at texel coordinates."""
    n = texture.shape[0] - 1
    fx, fy = math.floor(x), math.floor(y)
    j, i = int(fx) & n, int(fy) & n
    j1, i1 = (j + 1) & n, (i + 1) & n
    u, v = x - fx, y - fy
    low = texture[i, j] * (1.0 - u) + texture[i, j1] * u
    high = texture[i1, j] * (1.0 - u) + texture[i1, j1] * u
    return float(low * (1.0 - v) + high * v)


@compiled
def detail_at(scene: Scene, x: float, y: float) -> float:
    """Fine texture of about zero mean and unit deviation; two periods that never meet again make it aperiodic."""
    first = _bilinear(scene.detail[0], x * 40.0, y * 40.0)
    second = _bilinear(
        scene.detail[1], (0.79863551 * x + 0.60181502 * y) * 33.37, (0.79863551 * y - 0.60181502 * x) * 33.37
    )
    return 0.7071 * (first + second)


@compiled
def _painted(scene: Scene, x: float, y: float) -> tuple[float, float, float]:
    """Linear reflectance of the ground."""
    h, w, _ = scene.paint.shape
    u = min(max((x - scene.west) / scene.paint_cell, 0.0), w - 1.000001)
    v = min(max((y - scene.south) / scene.paint_cell, 0.0), h - 1.000001)
    i, j = int(v), int(u)
    fu, fv = u - j, v - i
    w00, w01, w10, w11 = (1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv
    p = scene.paint
    r = w00 * p[i, j, 0] + w01 * p[i, j + 1, 0] + w10 * p[i + 1, j, 0] + w11 * p[i + 1, j + 1, 0]
    g = w00 * p[i, j, 1] + w01 * p[i, j + 1, 1] + w10 * p[i + 1, j, 1] + w11 * p[i + 1, j + 1, 1]
    b = w00 * p[i, j, 2] + w01 * p[i, j + 1, 2] + w10 * p[i + 1, j, 2] + w11 * p[i + 1, j + 1, 2]
    strength = w00 * p[i, j, 3] + w01 * p[i, j + 1, 3] + w10 * p[i + 1, j, 3] + w11 * p[i + 1, j + 1, 3]
    gain = max(1.0 + strength / 255.0 * detail_at(scene, x, y), 0.1) / 255.0
    # The paint is stored with gamma 2, so that eight bits are enough in the shade.
    return (r * gain) ** 2, (g * gain) ** 2, (b * gain) ** 2


@compiled
def _pattern_gain(scene: Scene, pattern: int, k: int, u: float, v: float) -> float:
    """Factor on the reflectance of solid k at surface coordinates in m; every solid has its own piece of texture."""
    fine = detail_at(scene, u + 17.31 * k, v + 5.77 * k)
    if pattern == TILES:
        course = v / 0.34
        across = u / 0.28 + 0.5 * (math.floor(course) % 2.0)
        tile = math.sin(math.floor(across) * 12.9898 + math.floor(course) * 78.233 + k) * 43758.5453
        step = course - math.floor(course)
        return (0.78 + 0.22 * min(step * 4.0, 1.0)) * (0.85 + 0.3 * (tile - math.floor(tile))) * (1.0 + 0.14 * fine)
    if pattern == RIBS:
        return (0.92 + 0.08 * math.sin(u * 25.0)) * (1.0 + 0.08 * fine)
    if pattern == PLASTER:
        return 1.0 + 0.10 * fine
    return 1.0


@compiled
def _leaves_gain(scene: Scene, solid: int, x: float, y: float, z: float) -> float:
    """Factor on the reflectance of a dome: textures along the three axes, weighted by the normal."""
    s = scene.solids[solid]
    wx, wy = ((x - s.x) / s.a) ** 2, ((y - s.y) / s.a) ** 2
    wz = max(1.0 - wx - wy, 0.0)
    fine = wx * detail_at(scene, y, z) + wy * detail_at(scene, z, x) + wz * detail_at(scene, x, y)
    return float(max(1.0 + 0.42 * fine / math.sqrt(wx * wx + wy * wy + wz * wz), 0.15))


@compiled
def reflectance_at(scene: Scene, solid: int, face: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Linear reflectance RGB of the surface at a point on it."""
    if solid < 0:
        return _painted(scene, x, y)
    s = scene.solids[solid]
    if s.kind == DOME:
        gain = _leaves_gain(scene, solid, x, y, z)
        return s.roof[0] * gain, s.roof[1] * gain, s.roof[2] * gain
    rx, ry = x - s.x, y - s.y
    u, v = s.cos * rx + s.sin * ry, s.cos * ry - s.sin * rx
    if face in (NORTH_ROOF, SOUTH_ROOF):
        down = math.sqrt(1.0 + s.slope**2) * (abs(v) if s.slope > 0.0 else v)
        gain = _pattern_gain(scene, s.roof_pattern, 2 * s.seed + (v > 0.0), u, down)
        return s.roof[0] * gain, s.roof[1] * gain, s.roof[2] * gain
    gain = _pattern_gain(scene, s.wall_pattern, 8 * s.seed + face, v if face <= WEST_WALL else u, z)
    return s.wall[0] * gain, s.wall[1] * gain, s.wall[2] * gain


@compiled
def sunlight_at(
    scene: Scene, light: Light, solid: int, face: int, x: float, y: float, z: float
) -> tuple[float, float, float, float, bool]:
    """Cosine of the sun (0 in shadow), the unit normal (3 values), and whether the sun reaches the point."""
    nx, ny, nz = normal_at(scene, solid, face, x, y, z)
    sx, sy, sz = light.sun
    cosine = nx * sx + ny * sy + nz * sz
    if cosine <= 0.0:
        return 0.0, nx, ny, nz, False
    e = 2e-3
    px, py, pz = x + e * nx, y + e * ny, z + e * nz
    if pz < scene.highest:
        _, blocker, _ = first_solid(scene, px, py, pz, sx, sy, sz, 0.0, (scene.highest - pz) / sz)
        if blocker >= 0:
            return 0.0, nx, ny, nz, False
    return cosine, nx, ny, nz, True


@compiled
def _turn(R: F64, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The vector (x, y, z) turned by a rotation matrix (3, 3)."""
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@compiled
def look(
    scene: Scene, light: Light, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float]:
    """Linear light RGB that arrives along one ray."""
    t, solid, face = trace(scene, ox, oy, oz, dx, dy, dz)
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    cosine, _, _, nz, _ = sunlight_at(scene, light, solid, face, x, y, z)
    r, g, b = reflectance_at(scene, solid, face, x, y, z)
    open_sky = 0.5 + 0.5 * nz
    return (
        r * (light.sun_colour[0] * cosine + light.sky_colour[0] * open_sky),
        g * (light.sun_colour[1] * cosine + light.sky_colour[1] * open_sky),
        b * (light.sun_colour[2] * cosine + light.sky_colour[2] * open_sky),
    )


@compiled
def expose(scene: Scene, light: Light, xy: F64, R: F64, position: F64, image: F32, what: I32) -> None:
    """Fill `image` (H, W, 3) with linear light through the ideal rays `xy` (H, W, 2) of a camera, and `what` (H, W).

    One ray a pixel finds the surface and its light, two taps on the tangent plane average its texture. `what`
    differs where object, face or shadow do.
    """
    height, width, _ = image.shape
    ox, oy, oz = position
    for i in range(height):
        for j in range(width):
            dx, dy, dz = _turn(R, xy[i, j, 0], xy[i, j, 1], 1.0)
            t, solid, face = trace(scene, ox, oy, oz, dx, dy, dz)
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            cosine, nx, ny, nz, lit = sunlight_at(scene, light, solid, face, x, y, z)
            r, g, b = 0.0, 0.0, 0.0
            across = nx * dx + ny * dy + nz * dz
            j1 = j + 1 if j + 1 < width else j - 1
            i1 = i + 1 if i + 1 < height else i - 1
            for tap in range(2):
                fu = (0.5 * tap - 0.25) * (j1 - j)
                fv = (0.5 * tap - 0.25) * (i1 - i)
                ex = fu * (xy[i, j1, 0] - xy[i, j, 0]) + fv * (xy[i1, j, 0] - xy[i, j, 0])
                ey = fu * (xy[i, j1, 1] - xy[i, j, 1]) + fv * (xy[i1, j, 1] - xy[i, j, 1])
                mx, my, mz = _turn(R, ex, ey, 0.0)
                # Near the horizon of a surface the tangent plane runs away: stay within a tenth of the distance.
                shift = -t * (nx * mx + ny * my + nz * mz) / min(across + nx * mx + ny * my + nz * mz, -0.05)
                qx, qy, qz = (t + shift) * (dx + mx) + ox, (t + shift) * (dy + my) + oy, (t + shift) * (dz + mz) + oz
                tap_r, tap_g, tap_b = reflectance_at(scene, solid, face, qx, qy, qz)
                r, g, b = r + 0.5 * tap_r, g + 0.5 * tap_g, b + 0.5 * tap_b
            open_sky = 0.5 + 0.5 * nz
            image[i, j, 0] = r * (light.sun_colour[0] * cosine + light.sky_colour[0] * open_sky)
            image[i, j, 1] = g * (light.sun_colour[1] * cosine + light.sky_colour[1] * open_sky)
            image[i, j, 2] = b * (light.sun_colour[2] * cosine + light.sky_colour[2] * open_sky)
            part = scene.solids[solid].seed if solid >= 0 else -1
            what[i, j] = (part * 16 + face) * 2 + lit


@compiled
def refine_edges(scene: Scene, light: Light, xy: F64, R: F64, position: F64, image: F32, what: I32) -> None:
    """Replace the pixels of `image` where `what` differs from a neighbour by the mean of 3 × 3 rays."""
    height, width, _ = image.shape
    ox, oy, oz = position
    for i in range(height):
        for j in range(width):
            i0, i1, j0, j1 = max(i - 1, 0), min(i + 1, height - 1), max(j - 1, 0), min(j + 1, width - 1)
            w = what[i, j]
            if what[i0, j] == w and what[i1, j] == w and what[i, j0] == w and what[i, j1] == w:
                continue
            r, g, b = 0.0, 0.0, 0.0
            for tap in range(9):
                fu = (tap % 3 - 1) / 3.0 / (j1 - j0)
                fv = (tap // 3 - 1) / 3.0 / (i1 - i0)
                ex = xy[i, j, 0] + fu * (xy[i, j1, 0] - xy[i, j0, 0]) + fv * (xy[i1, j, 0] - xy[i0, j, 0])
                ey = xy[i, j, 1] + fu * (xy[i, j1, 1] - xy[i, j0, 1]) + fv * (xy[i1, j, 1] - xy[i0, j, 1])
                dx, dy, dz = _turn(R, ex, ey, 1.0)
                tap_r, tap_g, tap_b = look(scene, light, ox, oy, oz, dx, dy, dz)
                r, g, b = r + tap_r / 9.0, g + tap_g / 9.0, b + tap_b / 9.0
            image[i, j, 0], image[i, j, 1], image[i, j, 2] = r, g, b


@compiled
def terrain_heights(scene: Scene, xy: F64, z: F64) -> None:
    """Fill `z` (N,) with the height of the bare terrain at `xy` (N, 2)."""
    for n in range(xy.shape[0]):
        z[n] = terrain_height(scene, xy[n, 0], xy[n, 1])


@compiled
def heights(scene: Scene, xy: F64, z: F64, solid: I32) -> None:
    """Fill `z` (N,) with the surface height and `solid` (N,) with what forms it (−1: terrain) at `xy` (N, 2)."""
    for n in range(xy.shape[0]):
        z[n], solid[n] = top_at(scene, xy[n, 0], xy[n, 1])


@compiled
def reflectances(scene: Scene, p: F64, solid: I32, face: I32, rgb: F64) -> None:
    """Fill `rgb` (N, 3) with the linear reflectance at surface points `p` (N, 3) on given solids and faces."""
    for n in range(p.shape[0]):
        r, g, b = reflectance_at(scene, solid[n], face[n], p[n, 0], p[n, 1], p[n, 2])
        rgb[n, 0], rgb[n, 1], rgb[n, 2] = r, g, b


@compiled
def intersections(scene: Scene, origin: F64, directions: F64, p: F64, solid: I32) -> None:
    """Fill `p` (N, 3) and `solid` (N,) with where descending rays (N, 3) from one origin (3,) meet the surface."""
    for n in range(directions.shape[0]):
        dx, dy, dz = directions[n]
        t, solid[n], _ = trace(scene, origin[0], origin[1], origin[2], dx, dy, dz)
        p[n, 0], p[n, 1], p[n, 2] = origin[0] + t * dx, origin[1] + t * dy, origin[2] + t * dz
