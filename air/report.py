"""The report of a processed flight: what went in, what became of it, how long it took."""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from air.alignment.status import PhotoStatus, State
from air.odometry_report import Consistency, OdometryReport
from air.sources.source import Problem
from common.camera import CameraModel
from common.messages import MapTile


@dataclass
class Stopwatch:
    """Wall time of each stage, s."""

    stages: dict[str, float] = field(default_factory=dict)
    started: float = field(default_factory=time.monotonic)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the block to a stage."""
        begun = time.monotonic()
        try:
            yield
        finally:
            self.stages[name] = self.stages.get(name, 0.0) + time.monotonic() - begun

    @property
    def total(self) -> float:
        """Time since the start, s."""
        return time.monotonic() - self.started


@dataclass(frozen=True)
class Report:
    """What `report.json` says; times in s, memory in bytes, lengths in px and m as named.

    `odometry` is None for a source of photos, `odometry_against_truth` for any but a simulated flight.
    """

    source: str
    photos: dict[str, int]
    problems: list[dict[str, str]]
    cameras: list[CameraModel]
    reprojection_rms_px: float
    odometry: OdometryReport | None
    odometry_against_truth: Consistency | None
    tiles: int
    cells: int
    area_m2: float
    stages_s: dict[str, float]
    wall_s: float
    peak_memory_bytes: int

    def write(self, path: Path) -> None:
        """Write the report as JSON."""
        path.write_text(json.dumps(asdict(self), indent=2) + "\n")


def problems_of(statuses: Sequence[PhotoStatus], problems: Sequence[Problem]) -> list[dict[str, str]]:
    """Every photo that is not simply placed, with what its source and its alignment say of it, once."""
    said = {s.name: [s.reason] for s in statuses if s.reason}
    for problem in problems:
        said.setdefault(problem.name, []).append(problem.text)
    state = {s.name: str(s.state) for s in statuses}
    return [
        {"photo": name, "state": state.get(name, str(State.REJECTED)), "reason": "; ".join(reasons)}
        for name, reasons in said.items()
    ]


def counts(statuses: Sequence[PhotoStatus]) -> dict[str, int]:
    """How many photos there are in each state."""
    return {"read": len(statuses)} | {str(s): sum(x.state is s for x in statuses) for s in State}


def known_cells(tiles: Sequence[MapTile]) -> int:
    """Cells of the map whose height is known."""
    return int(sum(np.isfinite(tile.height).sum() for tile in tiles))


def peak_memory() -> int:
    """Most memory that this process has held, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
