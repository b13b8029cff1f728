"""Comparison of two point clouds: cloud-to-cloud distances and completeness, before and after alignment."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import trimesh
from pyproj import CRS, Transformer
from scipy.spatial import cKDTree

from common.arrays import F64, Bool
from common.errors import EvaluationError
from common.export.ply import DATUM_COMMENT
from common.export.projection import UtmProjection
from common.messages import Datum
from ground.evaluation.registration import register, search_tree
from ground.evaluation.similarity import Similarity

FOOTPRINT_CELL = 1.0
COMPLETE_WITHIN = 0.5
_MIN_POINTS = 100


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (N, 3) float64 m and what their coordinates mean: a CRS, ENU at a datum, or unknown."""

    points: F64
    frame: CRS | Datum | None = None


@dataclass(frozen=True)
class DistanceStatistics:
    """Of distances to the nearest point of the other cloud: all m, and of how many points."""

    mean: float
    std: float
    median: float
    p90: float
    max: float
    points: int


@dataclass(frozen=True)
class CloudRow:
    """One alignment: the distances both ways within the common footprint (m²) and what the alignment did.

    `completeness` is the share of all reference points with one of ours within 0.5 m. `shift` (m) is how far the
    centre of our cloud moved.
    """

    alignment: str
    to_reference: DistanceStatistics
    from_reference: DistanceStatistics
    completeness: float
    footprint: float
    shift: float
    rotation_deg: float
    scale: float


@dataclass(frozen=True)
class CloudComparison:
    """Our cloud against the reference: point counts and one row for each alignment."""

    points: int
    reference_points: int
    rows: tuple[CloudRow, ...]


def read_cloud(path: Path) -> Cloud:
    """The points of a LAS, LAZ or PLY file with their CRS or datum when the file says it.

    Raises EvaluationError for another kind of file, a damaged one and one with fewer than 100 points.
    """
    readers = {".las": _read_las, ".laz": _read_las, ".ply": _read_ply}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise EvaluationError(f"{path}: cannot read this kind of cloud; LAZ, LAS and PLY are accepted")
    if not path.is_file():
        raise EvaluationError(f"{path}: there is no such file")
    try:
        cloud = reader(path)
    except Exception as error:  # three libraries, each with its own errors
        raise EvaluationError(f"{path}: cannot be read as a cloud ({error or type(error).__name__})") from error
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)]
    if len(points) < _MIN_POINTS:
        raise EvaluationError(f"{path}: holds {len(points)} points, a comparison needs at least {_MIN_POINTS}")
    return Cloud(points, cloud.frame)


def _read_las(path: Path) -> Cloud:
    las = laspy.read(path)
    return Cloud(np.asarray(las.xyz, float), las.header.parse_crs())


def _read_ply(path: Path) -> Cloud:
    geometry = trimesh.load(path, process=False)
    return Cloud(np.asarray(geometry.vertices, float).reshape(-1, 3), _ply_datum(path))


def _ply_datum(path: Path) -> Datum | None:
    with path.open("rb") as stream:
        for line in stream:
            if line.startswith(b"end_header"):
                break
            text = line.decode(errors="replace").strip()
            if text.startswith(f"comment {DATUM_COMMENT}"):
                fields = json.loads(text.removeprefix(f"comment {DATUM_COMMENT}"))
                return Datum(fields["flight"], fields["latitude_deg"], fields["longitude_deg"], fields["height"])
    return None


def in_frame_of(ours: Cloud, reference: Cloud) -> F64:
    """Our points (N, 3) m in the coordinates of the reference; unchanged when either frame is unknown.

    Raises EvaluationError when the two coordinate systems cannot be brought together.
    """
    if ours.frame is None or reference.frame is None or ours.frame == reference.frame:
        return ours.points
    points, crs = ours.points, ours.frame
    if isinstance(crs, Datum):
        projection = UtmProjection(crs)
        points, crs = projection.from_world(points), projection.crs
    if isinstance(reference.frame, Datum):
        projection = UtmProjection(reference.frame)
        return projection.to_world(_transform(points, crs, projection.crs))
    return _transform(points, crs, reference.frame)


def _transform(points: F64, crs: CRS, to: CRS) -> F64:
    if crs.to_2d() == to.to_2d():
        return points
    moved = np.column_stack(Transformer.from_crs(crs, to, always_xy=True).transform(*points.T))
    if not np.isfinite(moved).all():
        raise EvaluationError(f"points of {crs.name!r} have no coordinates in {to.name!r}: check the CRS of both files")
    return moved


def compare_clouds(ours: Cloud, reference: Cloud) -> CloudComparison:
    """The distances between two clouds without alignment, after rigid and after similarity alignment.

    Raises EvaluationError when they do not overlap.
    """
    points, target = in_frame_of(ours, reference), reference.points
    if not _common(points, target)[0].any():
        raise EvaluationError(
            f"the clouds share no ground: ours spans {_extent(points)}, the reference {_extent(target)}; "
            "check that both have the same coordinate system"
        )
    alignments = {
        "none": Similarity.identity(),
        "rigid": register(points, target, with_scale=False),
        "similarity": register(points, target, with_scale=True),
    }
    tree = search_tree(target)
    rows = tuple(_row(name, T, points, target, tree) for name, T in alignments.items())
    return CloudComparison(len(points), len(target), rows)


def _row(name: str, T: Similarity, points: F64, target: F64, tree: cKDTree) -> CloudRow:
    aligned = T.apply(points)
    ours_common, reference_common = _common(aligned, target)
    to_reference, _ = tree.query(aligned[ours_common], workers=-1)
    from_reference, _ = search_tree(aligned).query(target, workers=-1)
    centre = points.mean(axis=0)
    return CloudRow(
        alignment=name,
        to_reference=_statistics(to_reference),
        from_reference=_statistics(from_reference[reference_common]),
        completeness=float((from_reference <= COMPLETE_WITHIN).mean()),
        footprint=len(np.unique(_cells(aligned[ours_common]))) * FOOTPRINT_CELL**2,
        shift=float(np.linalg.norm(aligned.mean(axis=0) - centre)),
        rotation_deg=T.rotation_deg,
        scale=T.scale,
    )


def _common(a: F64, b: F64) -> tuple[Bool, Bool]:
    """Which points of each cloud stand on a ground cell that both occupy."""
    cells_a, cells_b = _cells(a), _cells(b)
    return np.isin(cells_a, cells_b), np.isin(cells_b, cells_a)


def _cells(points: F64) -> F64:
    """One number for the ground cell of each point (N,)."""
    x, y = np.floor(points[:, :2] / FOOTPRINT_CELL).T
    return np.asarray(x * 2.0**26 + y)


def _statistics(distance: F64) -> DistanceStatistics:
    if not len(distance):
        nan = float("nan")
        return DistanceStatistics(nan, nan, nan, nan, nan, 0)
    return DistanceStatistics(
        mean=float(distance.mean()),
        std=float(distance.std()),
        median=float(np.median(distance)),
        p90=float(np.percentile(distance, 90)),
        max=float(distance.max()),
        points=len(distance),
    )


def _extent(points: F64) -> str:
    low, high = points.min(axis=0), points.max(axis=0)
    return " × ".join(f"[{a:.1f}, {b:.1f}]" for a, b in zip(low, high, strict=True))
