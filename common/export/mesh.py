"""The surface as a coloured triangle mesh: PLY in the world frame, GLB as glTF wants it (Y up)."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.arrays import F32, F64, I32, U8, U16, Bool
from common.errors import ExportError
from common.export.datum import datum_as_json
from common.export.ply import write_ply
from common.export.surface import Surface
from common.messages import Datum

MAX_TRIANGLES = 1_000_000


@dataclass(frozen=True, eq=False)
class Mesh:
    """Vertices `p_world` (N, 3) float64 m, `colour` (N, 3) uint8 RGB, `triangles` (M, 3) int32, counter-clockwise."""

    p_world: F64
    colour: U8
    triangles: I32


def write_mesh(path: Path, surface: Surface, datum: Datum, max_triangles: int = MAX_TRIANGLES) -> None:
    """Write the surface as `.ply` (east, north, up at the datum) or `.glb` (x east, y up, z south).

    Raises ExportError for another suffix and when no three neighbouring cells have a height.
    """
    writers = {".ply": _write_ply, ".glb": _write_glb}
    if path.suffix not in writers:
        raise ExportError(f"{path}: cannot write a mesh as {path.suffix or 'a file without suffix'}: use .glb or .ply")
    mesh = triangulate(surface, max_triangles)
    if not len(mesh.triangles):
        raise ExportError(f"{path}: the surface has no three neighbouring cells with a height, so there is no mesh")
    writers[path.suffix](path, mesh, datum)


def triangulate(surface: Surface, max_triangles: int = MAX_TRIANGLES) -> Mesh:
    """The surface as triangles between neighbouring cells that have a height, walls included.

    When that is more than `max_triangles`, each square of as few cells as needed becomes one vertex, its cell of
    median height: unlike a mean it stays sharp at walls and ignores a lone spike.
    """
    cells = int(np.count_nonzero(surface.valid))
    stride = max(1, int(np.ceil(np.sqrt(2 * cells / max_triangles))))
    height, colour = _decimate(surface, stride)
    row, col = np.nonzero(np.isfinite(height))
    index = np.full(height.shape, -1, np.int32)
    index[row, col] = np.arange(len(row))
    east = surface.x0 + (col + 0.5) * stride * surface.cell
    north = surface.y0 + (row + 0.5) * stride * surface.cell
    p_world = np.column_stack([east, north, height[row, col].astype(float)])
    return Mesh(p_world, colour[row, col], _triangles(height, index))


def _decimate(surface: Surface, stride: int) -> tuple[F32, U8]:
    """Height and colour of the cell of (lower) median height in each square of stride × stride cells."""
    if stride == 1:
        return surface.height, surface.colour
    rows, cols = (-(-size // stride) for size in surface.height.shape)
    height = np.full((rows * stride, cols * stride), np.nan, np.float32)
    height[: surface.height.shape[0], : surface.height.shape[1]] = surface.height
    squares = height.reshape(rows, stride, cols, stride).swapaxes(1, 2).reshape(rows, cols, stride * stride)
    order = np.argsort(squares, axis=-1)  # NaN comes last
    known = np.isfinite(squares).sum(axis=-1)
    median = np.take_along_axis(order, np.maximum(known - 1, 0)[..., None] // 2, axis=-1)
    row = np.arange(rows)[:, None] * stride + median[..., 0] // stride
    col = np.arange(cols)[None, :] * stride + median[..., 0] % stride
    colour = surface.colour[np.minimum(row, len(surface.height) - 1), np.minimum(col, surface.height.shape[1] - 1)]
    return np.take_along_axis(squares, median, axis=-1)[..., 0], colour


def _triangles(height: F32, index: I32) -> I32:
    """Triangles (M, 3), counter-clockwise from above, of each square of neighbours; one where a corner is missing."""
    sw, se, nw, ne = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    with np.errstate(invalid="ignore"):
        # The flatter diagonal follows edges of roofs instead of cutting across them.
        rising = np.abs(height[:-1, :-1] - height[1:, 1:]) <= np.abs(height[:-1, 1:] - height[1:, :-1])
    use_sw_ne = np.where((nw < 0) | (se < 0), True, rising & (sw >= 0) & (ne >= 0))
    found = [
        _where(use_sw_ne, sw, se, ne),
        _where(use_sw_ne, sw, ne, nw),
        _where(~use_sw_ne, sw, se, nw),
        _where(~use_sw_ne, se, ne, nw),
    ]
    return np.concatenate(found)


def _where(wanted: Bool, a: I32, b: I32, c: I32) -> I32:
    keep = wanted & (a >= 0) & (b >= 0) & (c >= 0)
    return np.stack([a[keep], b[keep], c[keep]], axis=1)


def _write_ply(path: Path, mesh: Mesh, datum: Datum) -> None:
    write_ply(path, mesh.p_world, mesh.colour, datum, triangles=mesh.triangles)


def _write_glb(path: Path, mesh: Mesh, datum: Datum) -> None:
    """Own writer, for trimesh keeps colours in 8 bits, too coarse in the shadows for the linear light of glTF.

    Source: Khronos, glTF 2.0 specification, sections 3.6, 3.7 and 4 (ISO/IEC 12113:2022).
    """
    positions = np.column_stack([mesh.p_world[:, 0], mesh.p_world[:, 2], -mesh.p_world[:, 1]]).astype("<f4")
    parts = [positions, _linear_rgba(mesh.colour), mesh.triangles.astype("<u4")]
    views, offset = [], 0
    for part, target in zip(parts, (34962, 34962, 34963), strict=True):  # ARRAY_BUFFER twice, ELEMENT_ARRAY_BUFFER
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": part.nbytes, "target": target})
        offset += part.nbytes
    description = {
        "asset": {"version": "2.0", "generator": "Luojia", "extras": {"datum": datum_as_json(datum)}},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": datum.flight}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [_UNLIT],
        "accessors": [
            _accessor(0, 5126, len(positions), "VEC3")
            | {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()},
            _accessor(1, 5123, len(positions), "VEC4") | {"normalized": True},
            _accessor(2, 5125, mesh.triangles.size, "SCALAR"),
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(description, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + offset))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", offset, b"BIN\0"))
        for part in parts:
            stream.write(part.tobytes())


# The photographs hold the light already: shading them again would darken them.
_UNLIT = {
    "doubleSided": True,
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    "extensions": {"KHR_materials_unlit": {}},
}


def _accessor(view: int, component: int, count: int, kind: str) -> dict[str, object]:
    return {"bufferView": view, "componentType": component, "count": count, "type": kind}


def _linear_rgba(colour: U8) -> U16:
    """Linear-light RGBA (N, 4) uint16 of sRGB colours (N, 3) uint8 (IEC 61966-2-1)."""
    level = np.arange(256) / 255.0
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    rgba = np.full((len(colour), 4), 65535, "<u2")
    rgba[:, :3] = np.rint(linear * 65535)[colour]
    return rgba
