"""Comparisons as text for a terminal and as JSON."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from typing import Any

from ground.evaluation.clouds import COMPLETE_WITHIN, CloudComparison, CloudRow, DistanceStatistics
from ground.evaluation.trajectories import TrajectoryComparison, TrajectoryRow

Comparison = CloudComparison | TrajectoryComparison


def render(comparison: Comparison) -> str:
    """The comparison as a table."""
    if isinstance(comparison, CloudComparison):
        return _render_clouds(comparison)
    return _render_trajectories(comparison)


def as_json(comparison: Comparison) -> str:
    """The comparison as JSON: the names of the dataclasses' fields, a unit other than SI in the name, NaN as null."""
    kind = "cloud" if isinstance(comparison, CloudComparison) else "trajectory"
    return json.dumps({"kind": kind} | _plain(dataclasses.asdict(comparison)), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _render_clouds(comparison: CloudComparison) -> str:
    title = (
        f"Cloud of {comparison.points:,} points against a reference of {comparison.reference_points:,}; distances in m"
    )
    head = ["alignment", "distance", "mean", "std", "median", "90 %", "max", "points"]
    lines = [line for row in comparison.rows for line in _cloud_lines(row)]
    moved_head = ["alignment", "completeness", "footprint", "shift", "rotation", "scale"]
    moved = [
        [row.alignment, f"{row.completeness:.1%}", f"{row.footprint:,.0f} m²", *_transform(row)]
        for row in comparison.rows
    ]
    note = (
        "Distances: nearest neighbours within the common footprint (cells of 1 m that both occupy).\n"
        f"Completeness: share of all reference points with one of ours within {COMPLETE_WITHIN} m."
    )
    return "\n\n".join([title, _grid(head, lines), _grid(moved_head, moved), note])


def _cloud_lines(row: CloudRow) -> list[list[str]]:
    return [
        [row.alignment, "ours → reference", *_distances(row.to_reference)],
        ["", "reference → ours", *_distances(row.from_reference)],
    ]


def _distances(s: DistanceStatistics) -> list[str]:
    return [*(_metres(value) for value in (s.mean, s.std, s.median, s.p90, s.max)), f"{s.points:,}"]


def _render_trajectories(comparison: TrajectoryComparison) -> str:
    title = (
        f"Trajectory of {comparison.poses:,} poses against a truth of {comparison.truth_poses:,}, "
        f"{comparison.matched:,} matched; errors in m"
    )
    head = ["alignment", "max", "mean", "median", "min", "RMSE", "std", "shift", "rotation", "scale"]
    lines = [
        [row.alignment, *map(_metres, dataclasses.astuple(row.error)), *_transform(row)] for row in comparison.rows
    ]
    return "\n\n".join([title, _grid(head, lines)])


def _transform(row: CloudRow | TrajectoryRow) -> list[str]:
    return [f"{row.shift:.3f} m", f"{row.rotation_deg:.3f}°", f"{row.scale:.5f}"]


def _metres(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "–"


def _grid(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Columns of text: words to the left, numbers to the right, a rule under the head."""
    widths = [max(len(line[i]) for line in (head, *lines)) for i in range(len(head))]
    words = [all(not line[i][:1].isdigit() and line[i] != "–" for line in lines) for i in range(len(head))]

    def one(line: Sequence[str]) -> str:
        cells = (
            text.ljust(width) if word else text.rjust(width)
            for text, width, word in zip(line, widths, words, strict=True)
        )
        return "  ".join(cells).rstrip()

    return "\n".join([one(head), "  ".join("─" * width for width in widths), *map(one, lines)])
