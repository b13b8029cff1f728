"""Trajectories as TUM files and as GeoJSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from common.arrays import F64, I64
from common.errors import EvaluationError
from common.geo import enu_to_geodetic
from common.messages import Datum, Keyframe
from common.se3 import SE3


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses in time order: `t_ns` (N,) int64 and as many `poses`, each the moving frame in the fixed one."""

    t_ns: I64
    poses: tuple[SE3, ...]

    @property
    def positions(self) -> F64:
        """Positions (N, 3) m in the fixed frame."""
        return np.array([pose.t for pose in self.poses], float).reshape(-1, 3)


def newest_keyframes(keyframes: Iterable[Keyframe]) -> list[Keyframe]:
    """The newest revision of each keyframe, in time order."""
    newest: dict[int, Keyframe] = {}
    for keyframe in keyframes:
        if keyframe.index not in newest or keyframe.revision > newest[keyframe.index].revision:
            newest[keyframe.index] = keyframe
    return sorted(newest.values(), key=lambda keyframe: (keyframe.t_ns, keyframe.index))


def write_tum(path: Path, t_ns: Iterable[int], poses: Iterable[SE3]) -> None:
    """Write lines `t x y z qx qy qz qw`: t in s with all nanoseconds, position in m, unit quaternion with w last.

    Source: J. Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems (IROS 2012).
    """
    with path.open("w", encoding="ascii") as file:
        file.writelines(map(tum_line, t_ns, poses))


def tum_line(t_ns: int, pose: SE3) -> str:
    """A pose at GPST `t_ns` as a line of a TUM file."""
    seconds, nanoseconds = divmod(int(t_ns), 1_000_000_000)
    w, x, y, z = pose.wxyz
    numbers = " ".join(f"{value:.9f}" for value in (*pose.t, x, y, z, w))
    return f"{seconds}.{nanoseconds:09d} {numbers}\n"


def read_tum(path: Path) -> Trajectory:
    """The trajectory of a TUM file, sorted by time.

    Raises EvaluationError that names file and line when a line is not eight numbers with a usable quaternion.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: cannot read the trajectory ({error})") from error
    rows: list[tuple[int, SE3]] = []
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            try:
                rows.append(_parse_tum_line(line))
            except (ValueError, InvalidOperation) as error:
                raise EvaluationError(
                    f"{path}, line {number}: needs 't x y z qx qy qz qw' (s, m, w last), got {line.strip()[:80]!r}"
                ) from error
    rows.sort(key=lambda row: row[0])
    return Trajectory(np.array([t for t, _ in rows], np.int64), tuple(pose for _, pose in rows))


def _parse_tum_line(line: str) -> tuple[int, SE3]:
    time, *rest = line.replace(",", " ").split()
    x, y, z, qx, qy, qz, qw = (float(word) for word in rest)
    if not np.isfinite([x, y, z]).all() or not 0.5 < np.linalg.norm([qx, qy, qz, qw]) < 2.0:
        raise ValueError("not a pose")
    t_ns = int((Decimal(time) * 1_000_000_000).to_integral_value())
    return t_ns, SE3.from_quaternion([qw, qx, qy, qz], [x, y, z])


def write_geojson(path: Path, datum: Datum, keyframes: Iterable[Keyframe]) -> None:
    """Write the flight as a line and its keyframes as points: WGS84 longitude, latitude °, ellipsoidal height m.

    Source: RFC 7946.
    """
    newest = newest_keyframes(keyframes)
    p_world = np.array([keyframe.T_world_cam.t for keyframe in newest], float).reshape(-1, 3)
    geodetic = enu_to_geodetic(datum, p_world)
    places = [[round(lon, 9), round(lat, 9), round(h, 3)] for lat, lon, h in geodetic.tolist()]
    features = [_feature("Point", place, _properties(k)) for place, k in zip(places, newest, strict=True)]
    if len(places) > 1:
        features.insert(0, _feature("LineString", places, {"flight": datum.flight, "keyframes": len(places)}))
    collection = {"type": "FeatureCollection", "features": features}
    path.write_text(json.dumps(collection, indent=1) + "\n", encoding="utf-8")


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def _properties(keyframe: Keyframe) -> dict[str, Any]:
    sigma = [round(value, 4) if np.isfinite(value) else None for value in keyframe.sigma.tolist()]
    names = dict(zip(("sigma_east", "sigma_north", "sigma_up"), sigma, strict=True))
    return {"index": keyframe.index, "name": keyframe.name, "t_ns": keyframe.t_ns, **names}
