"""Points and meshes as binary little-endian PLY in the world frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from common.arrays import I32, U8, AnyFloat
from common.export.datum import datum_as_json
from common.messages import Datum

DATUM_COMMENT = "luojia datum "
_TYPES = {"<f4": "float", "<i4": "int", "|u1": "uchar"}


def write_points_ply(
    path: Path, p_world: AnyFloat, colour: U8, datum: Datum, sigma: AnyFloat | None = None, views: U8 | None = None
) -> None:
    """Write points (N, 3) m in world with colour (N, 3) RGB; `sigma` (N,) m and `views` (N,) when given."""
    write_ply(path, p_world, colour, datum, extra={"sigma": sigma, "views": views})


def write_ply(
    path: Path,
    p_world: AnyFloat,
    colour: U8,
    datum: Datum,
    triangles: I32 | None = None,
    extra: dict[str, AnyFloat | U8 | None] | None = None,
) -> None:
    """Write vertices (N, 3) m in world with colour (N, 3) RGB and, for a mesh, triangles (M, 3) of their indices.

    Coordinates are float32 ENU at the datum, which stands in a comment as JSON.
    Source: G. Turk, The PLY Polygon File Format (1994).
    """
    columns: list[tuple[str, str, AnyFloat | U8]] = [
        *((axis, "<f4", p_world[:, i]) for i, axis in enumerate("xyz")),
        *((name, "|u1", colour[:, i]) for i, name in enumerate(("red", "green", "blue"))),
    ]
    for name, values in (extra or {}).items():
        if values is not None:
            columns.append((name, "|u1" if values.dtype == np.uint8 else "<f4", values))
    vertices = np.empty(len(p_world), np.dtype([(name, kind) for name, kind, _ in columns]))
    for name, _, values in columns:
        vertices[name] = values
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment coordinates are east, north, up in metres at the datum (WGS84, degrees, metres above the ellipsoid)",
        f"comment {DATUM_COMMENT}{json.dumps(datum_as_json(datum))}",
        f"element vertex {len(vertices)}",
        *(f"property {_TYPES[kind]} {name}" for name, kind, _ in columns),
    ]
    faces = np.empty(0 if triangles is None else len(triangles), np.dtype([("n", "|u1"), ("i", "<i4", (3,))]))
    if triangles is not None:
        faces["n"], faces["i"] = 3, triangles
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with path.open("wb") as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode())
        stream.write(vertices.tobytes())
        stream.write(faces.tobytes())
