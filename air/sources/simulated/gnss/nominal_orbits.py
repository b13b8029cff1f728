"""Nominal orbits of GPS, Galileo, BeiDou and GLONASS, with a little scatter, as they are at the start of a flight."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from air.gnss.gnss_time import BEIDOU_EPOCH_NS, GPS_EPOCH_NS, SECOND_NS, WEEK_NS
from air.gnss.orbit import EARTH_RATE, RATE
from common.arrays import F64
from common.measurements import Ephemeris, GlonassEphemeris, KeplerEphemeris

_GPS = tuple(number for number in range(1, 33) if number != 1)
_GALILEO = (2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 15, 19, 21, 24, 25, 26, 27, 30, 31, 33, 34, 36, 1)
_BEIDOU = (*range(19, 31), *range(32, 38), *range(41, 47))
_BEIDOU_INCLINED = {6: 118.0, 7: 118.0, 8: 118.0, 9: 95.0, 10: 95.0, 13: 95.0, 16: 112.0, 38: 112.0, 39: 112.0}
_BEIDOU_STATIONARY = {1: 140.0, 2: 84.0, 3: 110.5, 4: 160.0, 5: 58.75}
"""Longitudes in degrees, of the node or of the place above the equator, by number."""
_CHANNELS = (1, -4, 5, 6, 1, -4, 5, 6, -2, -7, 0, -1, -2, -7, 0, -1, 4, -3, 3, 2, 4, -3, 3, 2)
_GLONASS_A, _GLONASS_MU = 25_508.2e3, 3.9860044e14
_PULL = 2.0**-30 * 1e3
"""Unit in which GLONASS tells the pull of sun and moon, m/s²."""


def nominal(start_ns: int, rng: np.random.Generator) -> list[Ephemeris]:
    """One ephemeris of every satellite with reference time `start_ns` (GPST), in no rounding."""
    return [*_kepler_orbits(start_ns, rng), *_glonass(start_ns, rng)]


def _kepler_orbits(start_ns: int, rng: np.random.Generator) -> Iterator[KeplerEphemeris]:
    for i, number in enumerate(_GPS):
        node, argument = 60.0 * (i % 6), 360.0 / 31 * (i // 6) * 6 + 35.0 * (i % 6)
        yield _kepler(f"G{number:02d}", start_ns, rng, 26_559.7e3, 0.008, 55.0, node, argument)
    for names, system, a, inclination in ((_GALILEO, "E", 29_600.3e3, 56.0), (_BEIDOU, "C", 27_906.1e3, 55.0)):
        for i, number in enumerate(names):  # Walker 24/3/1
            node, argument = 120.0 * (i % 3) + 20.0, 45.0 * (i // 3) + 15.0 * (i % 3)
            yield _kepler(f"{system}{number:02d}", start_ns, rng, a, 0.0003, inclination, node, argument)
    for i, (number, longitude) in enumerate(_BEIDOU_INCLINED.items()):
        argument = 120.0 * (i % 3) + 40.0 * (i // 3)
        yield _kepler(f"C{number:02d}", start_ns, rng, 42_164.2e3, 0.004, 55.0, longitude - argument, argument)
    for number, longitude in _BEIDOU_STATIONARY.items():
        # Their frame is tilted by 5° about the axis to longitude 0; there the equator is an orbit inclined by 5°
        # whose node lies at longitude 180°.
        yield _kepler(f"C{number:02d}", start_ns, rng, 42_164.2e3, 0.0003, 5.0, 180.0, longitude - 180.0, 0.0)


def _kepler(
    satellite: str,
    start_ns: int,
    rng: np.random.Generator,
    a: float,
    e: float,
    inclination_deg: float,
    node_deg: float,
    argument_deg: float,
    scatter_deg: float = 1.5,
) -> KeplerEphemeris:
    """A Kepler orbit: `node_deg` over the earth at the start, `argument_deg` from the node to the satellite then."""
    epoch_ns = BEIDOU_EPOCH_NS if satellite[0] == "C" else GPS_EPOCH_NS
    inclination, node, argument = np.radians([inclination_deg, node_deg, argument_deg]) + np.radians(
        scatter_deg
    ) * rng.normal(size=3) * (0.3, 1.0, 1.0)
    perigee = rng.uniform(-np.pi, np.pi)
    wobble = dict(zip(("cuc", "cus", "cic", "cis"), 3e-6 * rng.normal(size=4), strict=True))
    crc, crs = 150.0 * rng.normal(size=2)
    e = e * float(rng.uniform(0.3, 1.5))
    true_anomaly = argument - perigee
    eccentric = 2 * np.arctan(np.sqrt((1 - e) / (1 + e)) * np.tan(true_anomaly / 2))
    still = scatter_deg == 0.0
    clock = rng.uniform(-3e-4, 3e-4), rng.uniform(-5e-12, 5e-12)
    delays = 5e-9 * rng.normal(size=2)
    return KeplerEphemeris(
        t_ns=start_ns,
        satellite=satellite,
        source={"G": "LNAV", "E": "INAV"}.get(satellite[0], "D2" if still else "D1"),
        toe_ns=start_ns,
        toc_ns=start_ns,
        iode=1,
        iodc=1,
        af0=clock[0],
        af1=clock[1],
        af2=0.0,
        sqrt_a=float(np.sqrt(a)),
        e=e,
        i0=float(inclination),
        omega0=wrapped(node + RATE[satellite[0]] * ((start_ns - epoch_ns) % WEEK_NS / SECOND_NS)),
        omega=float(perigee),
        m0=wrapped(eccentric - e * np.sin(eccentric)),
        delta_n=0.0 if still else float(rng.uniform(4e-9, 5e-9)),
        idot=0.0 if still else float(rng.uniform(-2e-10, 2e-10)),
        omega_dot=0.0 if still else float(rng.uniform(-8.5e-9, -7.5e-9)),
        crc=float(crc),
        crs=float(crs),
        group_delay=(float(delays[0]), 0.0 if satellite[0] == "G" else float(delays[0] + 0.3 * delays[1])),
        accuracy=3.12 if satellite[0] == "E" else 2.0,
        health=0,
        **wobble,
    )


def _glonass(start_ns: int, rng: np.random.Generator) -> Iterator[GlonassEphemeris]:
    speed = float(np.sqrt(_GLONASS_MU / _GLONASS_A))
    for i in range(24):
        node, argument, tilt = np.radians([120.0 * (i // 8) + 70.0, 45.0 * (i % 8) + 15.0 * (i // 8), 64.8])
        node, argument, tilt = np.array([node, argument, tilt]) + np.radians(1.0) * rng.normal(size=3) * (1, 1, 0.2)
        position = _GLONASS_A * _in_plane(node, tilt, argument)
        turning = np.cross((0.0, 0.0, EARTH_RATE), position)
        velocity = speed * _in_plane(node, tilt, argument + np.pi / 2) - turning
        yield GlonassEphemeris(
            t_ns=start_ns,
            satellite=f"R{i + 1:02d}",
            toe_ns=start_ns,
            position=_three(position),
            velocity=_three(velocity),
            acceleration=_three(_PULL * rng.integers(-2, 3, 3).astype(float)),
            tau=float(rng.uniform(-1e-4, 1e-4)),
            gamma=float(rng.uniform(-2e-12, 2e-12)),
            channel=_CHANNELS[i],
            age_days=0,
            health=0,
        )


def _in_plane(node: float, tilt: float, argument: float) -> F64:
    """Unit vector (3,) at an angle from the node of a plane."""
    across = np.array([-np.sin(node) * np.cos(tilt), np.cos(node) * np.cos(tilt), np.sin(tilt)])
    return np.asarray(np.cos(argument) * np.array([np.cos(node), np.sin(node), 0.0]) + np.sin(argument) * across)


def _three(values: npt.NDArray[np.floating[Any]]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def wrapped(angle: float) -> float:
    """The angle within ±π rad."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
