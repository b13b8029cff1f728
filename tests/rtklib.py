"""RTKLIB's programs as an oracle: skips the test where Debian's package is not installed."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from air.gnss.calendar import from_calendar
from air.gnss.gnss_time import from_week
from common.arrays import F64

_SYSTEMS = {"G": 1, "R": 4, "E": 8, "J": 16, "C": 32}
_FIRST = (("G", 1, 32, 1), ("R", 33, 59, 1), ("E", 60, 95, 1), ("J", 96, 105, 1), ("C", 106, 168, 1))
"""RTKLIB's numbers of satellites: system, first and last number, first number of the system."""


@dataclass(frozen=True, eq=False)
class Solution:
    """A single-point solution: ECEF position m and velocity m/s, number of satellites."""

    t_ns: int
    position: F64
    velocity: F64
    satellites: int


def program(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"RTKLIB's {name} is not installed (Debian: apt install rtklib)")
    return path


def single_point(folder: Path, obs: Path, nav: Path, systems: str, mask_deg: float, trace: int = 0) -> list[Solution]:
    """What rnx2rtkp finds with one band, broadcast ionosphere and Saastamoinen; its trace is `out.pos.trace`."""
    settings = {
        "pos1-posmode": "single",
        "pos1-elmask": mask_deg,
        "pos1-ionoopt": "brdc",
        "pos1-tropopt": "saas",
        "pos1-sateph": "brdc",
        "pos1-navsys": sum(_SYSTEMS[system] for system in systems),
        "out-solformat": "xyz",
        "out-timeform": "tow",
        "out-timendec": 6,
        "out-outvel": "on",
    }
    (folder / "rtklib.conf").write_text("".join(f"{key} ={value}\n" for key, value in settings.items()))
    out = folder / "out.pos"
    command = [program("rnx2rtkp"), "-k", folder / "rtklib.conf", "-x", str(trace), "-o", out, obs, nav]
    subprocess.run([str(part) for part in command], capture_output=True, check=False)
    return [_solution(line.split()) for line in out.read_text().splitlines() if line[:1] != "%"]


@dataclass(frozen=True, eq=False)
class RelativeSolution:
    """A carrier-phase solution against a base: ECEF position m; `fixed` when its ambiguities are whole numbers."""

    t_ns: int
    position: F64
    fixed: bool


def kinematic(folder: Path, rover: Path, base: Path, nav: Path, base_position: F64) -> list[RelativeSolution]:
    """What rnx2rtkp finds epoch by epoch with two bands of GPS, Galileo and GLONASS, the ambiguities not held."""
    settings = {
        "pos1-posmode": "kinematic",
        "pos1-frequency": "l1+l2",
        "pos1-elmask": 15,
        "pos1-ionoopt": "brdc",
        "pos1-tropopt": "saas",
        "pos1-navsys": sum(_SYSTEMS[system] for system in "GRE"),
        "pos2-armode": "continuous",
        "pos2-gloarmode": "off",
        "out-solformat": "xyz",
        "out-timeform": "tow",
        "out-timendec": 6,
        "ant2-postype": "xyz",
        **{f"ant2-pos{i + 1}": f"{value:.4f}" for i, value in enumerate(base_position.tolist())},
    }
    (folder / "rtk.conf").write_text("".join(f"{key} ={value}\n" for key, value in settings.items()))
    out = folder / "rtk.pos"
    command = [program("rnx2rtkp"), "-k", folder / "rtk.conf", "-o", out, rover, base, nav]
    subprocess.run([str(part) for part in command], capture_output=True, check=False)
    rows = [line.split() for line in out.read_text().splitlines() if line[:1] != "%"]
    return [
        RelativeSolution(from_week(int(row[0]), float(row[1])), np.array(row[2:5], float), row[5] == "1")
        for row in rows
    ]


def _solution(fields: list[str]) -> Solution:
    position, velocity = np.array(fields[2:5], float), np.array(fields[15:18], float)
    return Solution(from_week(int(fields[0]), float(fields[1])), position, velocity, int(fields[6]))


def traced_states(trace: Path) -> Iterator[tuple[int, str, F64, float]]:
    """Time tag of the epoch, satellite, position m and clock s of every state that rnx2rtkp used (trace level 4)."""
    t_ns = 0
    for line in trace.read_text(errors="replace").splitlines():
        if found := re.search(r"satposs : teph=(\d+)/(\d+)/(\d+) (\d+):(\d+):(\d+)\.(\d+)", line):
            *calendar, thousandths = (int(group) for group in found.groups())
            t_ns = from_calendar(datetime(*calendar)) + thousandths * 1_000_000  # type: ignore[arg-type]
        elif found := re.search(r"sat= *(\d+) rs= *(\S+) +(\S+) +(\S+) dts= *(\S+) var", line):
            number, *values = found.groups()
            x, y, z, dts = (float(value) for value in values)
            name = _name(int(number))
            if name and (x, y, z) != (0.0, 0.0, 0.0):
                yield t_ns, name, np.array([x, y, z]), dts * 1e-9


def _name(number: int) -> str:
    for system, first, last, start in _FIRST:
        if first <= number <= last:
            return f"{system}{number - first + start:02d}"
    return ""
