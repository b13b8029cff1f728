"""Precise orbits of SP3 files, and broadcast-like ephemerides fitted to them.

Source: Hilla, The Extended Standard Product 3 Orbit Format (SP3-d), 2016; the fit determines the fifteen parameters
of IS-GPS-200, table 20-III, as the control segment does. An SP3 file tells of no group delays: ranges of one band
keep errors of some metres. Its positions are those of the centre of mass, up to 2 m from the antenna.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

import numpy as np

from air.gnss.calendar import from_calendar
from air.gnss.gnss_time import SECOND_NS, to_week
from air.gnss.orbit import EARTH_RATE, states_at
from air.gnss.rinex_lines import Lines, number
from common.arrays import F64, I64
from common.measurements import KeplerEphemeris

_MU = 3.9860050e14
_SIGMA = 0.01
_ITERATIONS = 8
_ARC_S = 2 * 3600.0
_PARAMETERS = {
    "sqrt_a": 1.0,
    "e": 1e-4,
    "i0": 1e-4,
    "omega0": 1e-4,
    "omega": 1e-2,
    "m0": 1e-2,
    "delta_n": 1e-8,
    "idot": 1e-9,
    "omega_dot": 1e-8,
    "cuc": 1e-5,
    "cus": 1e-5,
    "crc": 300.0,
    "crs": 300.0,
    "cic": 1e-6,
    "cis": 1e-6,
}
"""How far each may be expected from its first guess: the arc alone would not determine all."""


@dataclass(frozen=True, eq=False)
class PreciseOrbit:
    """Positions (N, 3) m, ECEF, and clock errors (N,) s of a satellite at `t_ns` (N,).

    The clock is without relativity, NaN where it is unknown.
    """

    satellite: str
    t_ns: I64
    position: F64
    clock: F64


def read_sp3(lines: Lines) -> list[PreciseOrbit]:
    """The orbits in an SP3 file, by satellite. Senseless lines are counted in `lines.damaged` and skipped."""
    t_ns: int | None = None
    rows: dict[str, list[tuple[int, float, float, float, float]]] = {}
    for line in lines:
        if line.startswith("* "):
            t_ns = _time(line)
        elif line.startswith("P"):
            x, y, z, clock = (number(line[i : i + 14]) for i in range(4, 60, 14))
            if t_ns is None or x != x or y != y or z != z or x == y == z == 0:
                lines.damage(line)
                continue
            known = clock == clock and abs(clock) < 999_999.0
            rows.setdefault(line[1:4], []).append((t_ns, x, y, z, clock if known else np.nan))
    orbits = []
    for satellite, row in sorted(rows.items()):
        table = np.array([values[1:] for values in row], float)
        times = np.array([values[0] for values in row], np.int64)
        orbits.append(PreciseOrbit(satellite, times, table[:, :3] * 1e3, table[:, 3] * 1e-6))
    return orbits


def fit_ephemeris(orbit: PreciseOrbit, t_ns: int) -> KeplerEphemeris | None:
    """An ephemeris of a GPS satellite for the hour around `t_ns`, None where the orbit is too short or has no clock.

    With positions every 15 min it meets them within about 0.1 m.
    """
    near = np.abs(orbit.t_ns - t_ns) <= _ARC_S * SECOND_NS
    orbit = PreciseOrbit(orbit.satellite, orbit.t_ns[near], orbit.position[near], orbit.clock[near])
    timed = np.isfinite(orbit.clock)
    if len(orbit.t_ns) < 5 or timed.sum() < 2:
        return None
    toe_ns = int(orbit.t_ns[np.argmin(np.abs(orbit.t_ns - t_ns))])
    t = (orbit.t_ns - toe_ns) / SECOND_NS
    af1, af0 = np.polyfit(t[timed], orbit.clock[timed], 1)
    ephemeris = _osculating(orbit, toe_ns, float(af0), float(af1))
    scale = np.array(list(_PARAMETERS.values()))
    total = np.zeros(len(scale))
    start = ephemeris
    for _ in range(_ITERATIONS):
        missing = (orbit.position - _positions(ephemeris, t)).ravel()
        steps = scale * 1e-3
        J = np.stack(
            [
                (_positions(_moved(start, total + column), t) - _positions(ephemeris, t)).ravel() / step
                for column, step in zip(np.diag(steps), steps, strict=True)
            ],
            axis=1,
        )
        A = np.vstack([J * scale / _SIGMA, np.eye(len(scale))])
        b = np.concatenate([missing / _SIGMA, -total / scale])
        total = total + scale * np.linalg.lstsq(A, b, rcond=None)[0]
        ephemeris = _moved(start, total)
    return ephemeris


def _time(line: str) -> int | None:
    try:
        year, month, day, hour, minute = (int(part) for part in line[1:19].split())
        return from_calendar(datetime(year, month, day, hour, minute) + timedelta(seconds=float(line[19:31])))
    except (ValueError, OverflowError):
        return None


def _positions(ephemeris: KeplerEphemeris, t: F64) -> F64:
    return states_at([ephemeris] * len(t), ephemeris.toe_ns, t).position


def _moved(ephemeris: KeplerEphemeris, step: Sequence[float] | F64) -> KeplerEphemeris:
    moved = {name: getattr(ephemeris, name) + float(d) for name, d in zip(_PARAMETERS, step, strict=True)}
    return replace(ephemeris, **moved)


def _osculating(orbit: PreciseOrbit, toe_ns: int, af0: float, af1: float) -> KeplerEphemeris:
    """The undisturbed orbit through position and velocity at `toe_ns`, by polynomials in an inertial frame."""
    t = (orbit.t_ns - toe_ns) / SECOND_NS
    angle = EARTH_RATE * t
    x = orbit.position[:, 0] * np.cos(angle) - orbit.position[:, 1] * np.sin(angle)
    y = orbit.position[:, 0] * np.sin(angle) + orbit.position[:, 1] * np.cos(angle)
    inertial = np.column_stack([x, y, orbit.position[:, 2]])
    unit = 3600.0
    terms = np.polynomial.polynomial.polyfit(t / unit, inertial, min(len(t) - 1, 8))
    p, v = terms[0], terms[1] / unit
    h = np.cross(p, v)
    r = float(np.linalg.norm(p))
    a = 1 / (2 / r - v @ v / _MU)
    eccentricity = np.cross(v, h) / _MU - p / r
    e = float(np.linalg.norm(eccentricity))
    node = np.array([-h[1], h[0], 0.0])
    node_angle = float(np.arctan2(node[1], node[0]))
    across = np.cross(h / np.linalg.norm(h), node / np.linalg.norm(node))
    along = node / np.linalg.norm(node)
    argument = float(np.arctan2(p @ across, p @ along))
    omega = float(np.arctan2(eccentricity @ across, eccentricity @ along))
    E = 2 * np.arctan(np.sqrt((1 - e) / (1 + e)) * np.tan((argument - omega) / 2))
    zero = dict.fromkeys(("delta_n", "idot", "omega_dot", "cuc", "cus", "crc", "crs", "cic", "cis", "af2"), 0.0)
    return KeplerEphemeris(
        t_ns=toe_ns,
        satellite=orbit.satellite,
        source="SP3",
        toe_ns=toe_ns,
        toc_ns=toe_ns,
        iode=0,
        iodc=0,
        af0=af0,
        af1=af1,
        sqrt_a=float(np.sqrt(a)),
        e=e,
        i0=float(np.arccos(h[2] / np.linalg.norm(h))),
        omega0=node_angle + EARTH_RATE * to_week(toe_ns)[1],
        omega=omega,
        m0=float(E - e * np.sin(E)),
        group_delay=(0.0, 0.0),
        accuracy=2.0,
        health=0,
        **zero,
    )
