"""Where satellites are and what their clocks show, from broadcast ephemerides.

Sources: IS-GPS-200, table 20-IV (Kepler orbits) and 20.3.3.3.3.1 (clock and relativity); Galileo OS SIS ICD 5.1.1;
BeiDou B1I ICD 5.2.4.12 (geostationary satellites); GLONASS ICD 5.1, appendix A.3.1.2 (numerical integration).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter

import numpy as np

from air.gnss.gnss_time import BDT_MINUS_GPST_NS, GPS_EPOCH_NS, WEEK_NS
from air.gnss.signals import LIGHT
from common.arrays import F64
from common.measurements import Ephemeris, GlonassEphemeris, KeplerEphemeris

EARTH_RATE = 7.2921151467e-5
"""Rotation of the earth, rad/s, in GPS and Galileo and for the Sagnac correction."""
_BEIDOU_RATE = 7.292115e-5
MU = {"G": 3.9860050e14, "J": 3.9860050e14, "E": 3.986004418e14, "C": 3.986004418e14}
RATE = {"G": EARTH_RATE, "J": EARTH_RATE, "E": EARTH_RATE, "C": _BEIDOU_RATE}
"""Gravity, m³/s², and rotation of the earth, rad/s, by which the satellites of a system count their orbits."""
_GEO_TILT = np.radians(-5.0)

_GLONASS_MU, _GLONASS_RADIUS, _GLONASS_J2, _GLONASS_RATE = 3.9860044e14, 6378136.0, 1.0826257e-3, 7.292115e-5
_GLONASS_STEP_S = 60.0
_GLONASS_REACH_S = 7200.0
"""Further from its time a GLONASS state is no orbit any more; integrating on would only cost time."""

_KEPLER = attrgetter(
    *("sqrt_a", "e", "i0", "omega0", "omega", "m0", "delta_n", "idot", "omega_dot"),
    *("cuc", "cus", "crc", "crs", "cic", "cis", "af0", "af1", "af2"),
)


@dataclass(frozen=True, eq=False)
class SatelliteStates:
    """Satellites at their times: `position` (N, 3) m and `velocity` (N, 3) m/s, ECEF of that very time.

    `clock` (N,) s is how far the satellite's clock is ahead, with relativity and without group delay; `drift` (N,)
    s/s. Rows without a usable ephemeris are NaN.
    """

    position: F64
    velocity: F64
    clock: F64
    drift: F64


def states_at(ephemerides: Sequence[Ephemeris | None], t_ns: int, offset_s: F64) -> SatelliteStates:
    """States of N satellites at GPST `t_ns` + `offset_s` (N,) s, one ephemeris each (None: NaN)."""
    rows = np.full((len(ephemerides), 8), np.nan)
    kepler = {i: ephemeris for i, ephemeris in enumerate(ephemerides) if isinstance(ephemeris, KeplerEphemeris)}
    glonass = {i: ephemeris for i, ephemeris in enumerate(ephemerides) if isinstance(ephemeris, GlonassEphemeris)}
    with np.errstate(all="ignore"):  # A senseless ephemeris gives NaN.
        if kepler:
            rows[list(kepler)] = _kepler(list(kepler.values()), t_ns, offset_s[list(kepler)])
        if glonass:
            rows[list(glonass)] = _glonass(list(glonass.values()), t_ns, offset_s[list(glonass)])
    return SatelliteStates(rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7])


def states_at_transmission(ephemerides: Sequence[Ephemeris | None], t_ns: int, pseudorange: F64) -> SatelliteStates:
    """States of N satellites when they sent what arrived at receiver time `t_ns` with `pseudorange` (N,) m.

    The error of the receiver's clock cancels: receiver time minus pseudorange is the satellite's own clock time.
    """
    sent_s = -pseudorange / LIGHT
    return states_at(ephemerides, t_ns, sent_s - clock_at(ephemerides, t_ns, sent_s))


def clock_at(ephemerides: Sequence[Ephemeris | None], t_ns: int, offset_s: F64) -> F64:
    """Satellite clock errors (N,) s, without relativity, at the clocks' own time `t_ns` + `offset_s` (N,) s."""
    toc_ns = np.array([_clock_reference(ephemeris) for ephemeris in ephemerides], np.int64)
    a0, a1, a2 = np.array([_clock_polynomial(ephemeris) for ephemeris in ephemerides], float).reshape(-1, 3).T
    shown_s = (t_ns - toc_ns) * 1e-9 + offset_s
    error_s = np.zeros_like(shown_s)
    for _ in range(3):
        t = shown_s - error_s
        error_s = a0 + a1 * t + a2 * t * t
    return error_s


def geometric_range(p_satellite: F64, p_receiver: F64) -> tuple[F64, F64]:
    """Ranges (N,) m with the Sagnac correction, and unit vectors (N, 3) from the receiver to the satellites.

    `p_satellite` (N, 3) m in ECEF at transmission, `p_receiver` (3,) m in ECEF at reception.
    """
    line = p_satellite - p_receiver
    distance = np.sqrt(np.einsum("ij,ij->i", line, line))
    sagnac = EARTH_RATE / LIGHT * (p_satellite[:, 0] * p_receiver[1] - p_satellite[:, 1] * p_receiver[0])
    return distance + sagnac, line / distance[:, None]


def is_geostationary(satellite: str) -> bool:
    """True for BeiDou's geostationary satellites, C01 to C05 and C59 to C63."""
    return satellite[:1] == "C" and (satellite[1:] <= "05" or satellite[1:] >= "59")


def _kepler(ephemerides: Sequence[KeplerEphemeris], t_ns: int, offset_s: F64) -> F64:
    """Rows (N, 8) of position, velocity, clock and drift of Kepler orbits."""
    elements = np.array([_KEPLER(ephemeris) for ephemeris in ephemerides], float).T
    sqrt_a, e, i0, omega0, omega, m0, delta_n, idot, omega_dot = elements[:9]
    cuc, cus, crc, crs, cic, cis, af0, af1, af2 = elements[9:]
    systems = [ephemeris.satellite[:1] for ephemeris in ephemerides]
    mu = np.array([MU.get(system, np.nan) for system in systems])
    rate = np.array([RATE.get(system, np.nan) for system in systems])
    toe_ns = np.array([ephemeris.toe_ns for ephemeris in ephemerides], np.int64)
    toc_ns = np.array([ephemeris.toc_ns for ephemeris in ephemerides], np.int64)
    bdt_ns = np.array([BDT_MINUS_GPST_NS if system == "C" else 0 for system in systems], np.int64)
    toe_of_week = (toe_ns + bdt_ns - GPS_EPOCH_NS) % WEEK_NS * 1e-9
    tk = (t_ns - toe_ns) * 1e-9 + offset_s

    n = np.sqrt(mu) / sqrt_a**3 + delta_n
    E, E_dot = _eccentric_anomaly(m0 + n * tk, n, e)
    sin_E, cos_E = np.sin(E), np.cos(E)

    phi = np.arctan2(np.sqrt(1 - e * e) * sin_E, cos_E - e) + omega
    phi_dot = np.sqrt(1 - e * e) * E_dot / (1 - e * cos_E)
    sin_2, cos_2 = np.sin(2 * phi), np.cos(2 * phi)
    u = phi + cus * sin_2 + cuc * cos_2
    r = sqrt_a**2 * (1 - e * cos_E) + crs * sin_2 + crc * cos_2
    i = i0 + idot * tk + cis * sin_2 + cic * cos_2
    u_dot = phi_dot * (1 + 2 * (cus * cos_2 - cuc * sin_2))
    r_dot = sqrt_a**2 * e * sin_E * E_dot + 2 * phi_dot * (crs * cos_2 - crc * sin_2)
    i_dot = idot + 2 * phi_dot * (cis * cos_2 - cic * sin_2)

    geo = np.array([is_geostationary(ephemeris.satellite) for ephemeris in ephemerides])
    node_dot = np.where(geo, omega_dot, omega_dot - rate)
    node = omega0 + node_dot * tk - rate * toe_of_week
    position, velocity = _from_orbit_plane((r, r_dot), (u, u_dot), (i, i_dot), (node, node_dot))
    if geo.any():
        position[geo], velocity[geo] = _geo_to_ecef(position[geo], velocity[geo], rate[geo], tk[geo])

    tc = (t_ns - toc_ns) * 1e-9 + offset_s
    relativity = -2 * np.sqrt(mu) * sqrt_a * e / LIGHT**2
    clock = af0 + af1 * tc + af2 * tc * tc + relativity * sin_E
    drift = af1 + 2 * af2 * tc + relativity * cos_E * E_dot
    return np.column_stack([position, velocity, clock, drift])


def _eccentric_anomaly(M: F64, n: F64, e: F64) -> tuple[F64, F64]:
    """Eccentric anomaly (N,) rad of Kepler's equation and its rate, by Newton's method from M."""
    E = M + e * np.sin(M)
    for _ in range(10):
        step = (E - e * np.sin(E) - M) / (1 - e * np.cos(E))
        E = E - step
        if not np.any(np.abs(step) > 1e-14):
            break
    return E, n / (1 - e * np.cos(E))


_Rate = tuple[F64, F64]
"""A value and its rate of change."""


def _from_orbit_plane(radius: _Rate, argument: _Rate, inclination: _Rate, node: _Rate) -> tuple[F64, F64]:
    """Position and velocity (N, 3) from polar coordinates in the plane of the orbit and the plane's orientation."""
    (r, r_dot), (u, u_dot), (i, i_dot), (o, o_dot) = radius, argument, inclination, node
    sin_u, cos_u, sin_i, cos_i, sin_o, cos_o = np.sin(u), np.cos(u), np.sin(i), np.cos(i), np.sin(o), np.cos(o)
    x, y = r * cos_u, r * sin_u
    x_dot, y_dot = r_dot * cos_u - y * u_dot, r_dot * sin_u + x * u_dot
    across, across_dot = y * cos_i, y_dot * cos_i - y * sin_i * i_dot  # perpendicular to the node, in the equator
    px, py, pz = x * cos_o - across * sin_o, x * sin_o + across * cos_o, y * sin_i
    vx = x_dot * cos_o - across_dot * sin_o - py * o_dot
    vy = x_dot * sin_o + across_dot * cos_o + px * o_dot
    vz = y_dot * sin_i + y * cos_i * i_dot
    return np.column_stack([px, py, pz]), np.column_stack([vx, vy, vz])


def _geo_to_ecef(position: F64, velocity: F64, rate: F64, tk: F64) -> tuple[F64, F64]:
    """ECEF position and velocity of a geostationary BeiDou satellite from its own inclined, non-rotating frame."""
    tilt_s, tilt_c = np.sin(_GEO_TILT), np.cos(_GEO_TILT)
    turn_s, turn_c = np.sin(rate * tk), np.cos(rate * tk)

    def tilt_and_turn(v: F64) -> tuple[F64, F64, F64]:
        x, y, z = v[:, 0], v[:, 1] * tilt_c + v[:, 2] * tilt_s, -v[:, 1] * tilt_s + v[:, 2] * tilt_c
        return x * turn_c + y * turn_s, -x * turn_s + y * turn_c, z

    px, py, pz = tilt_and_turn(position)
    vx, vy, vz = tilt_and_turn(velocity)
    return np.column_stack([px, py, pz]), np.column_stack([vx + rate * py, vy - rate * px, vz])


def _glonass(ephemerides: Sequence[GlonassEphemeris], t_ns: int, offset_s: F64) -> F64:
    """Rows (N, 8) of position, velocity, clock and drift of integrated GLONASS states."""
    pull = np.array([ephemeris.acceleration for ephemeris in ephemerides], float)
    tau, gamma = np.array([(ephemeris.tau, ephemeris.gamma) for ephemeris in ephemerides], float).T
    toe_ns = np.array([ephemeris.toe_ns for ephemeris in ephemerides], np.int64)
    t = (t_ns - toe_ns) * 1e-9 + offset_s
    within = np.abs(t) <= _GLONASS_REACH_S
    steps = np.where(within, np.trunc(t / _GLONASS_STEP_S), 0.0)
    state = np.array([_glonass_state(*of) for of in zip(ephemerides, steps.astype(int).tolist(), strict=True)])
    left = np.where(within, t - steps * _GLONASS_STEP_S, np.nan)
    return np.column_stack([_runge_kutta(state, pull, left[:, None]), tau + gamma * t, gamma])


@lru_cache(4096)
def _glonass_state(ephemeris: GlonassEphemeris, steps: int) -> tuple[float, ...]:
    """Position and velocity (6,) whole steps after an ephemeris' reference time, or before it."""
    if steps == 0:
        return *ephemeris.position, *ephemeris.velocity
    way = 1 if steps > 0 else -1
    state, pull = np.array([_glonass_state(ephemeris, steps - way)]), np.array([ephemeris.acceleration])
    return tuple(_runge_kutta(state, pull, np.full((1, 1), way * _GLONASS_STEP_S))[0].tolist())


def _runge_kutta(state: F64, pull: F64, step: F64) -> F64:
    k1 = _glonass_motion(state, pull)
    k2 = _glonass_motion(state + k1 * (step / 2), pull)
    k3 = _glonass_motion(state + k2 * (step / 2), pull)
    k4 = _glonass_motion(state + k3 * step, pull)
    return state + (k1 + 2 * (k2 + k3) + k4) * (step / 6)


def _glonass_motion(state: F64, pull: F64) -> F64:
    """Rates (N, 6) of position and velocity: gravity with J2, rotation of the frame, sun and moon."""
    p, v = state[:, :3], state[:, 3:]
    r2 = np.einsum("ij,ij->i", p, p)
    r3 = r2 * np.sqrt(r2)
    oblate = 1.5 * _GLONASS_J2 * _GLONASS_MU * _GLONASS_RADIUS**2 / (r2 * r3)
    radial = -_GLONASS_MU / r3 - oblate * (1 - 5 * p[:, 2] ** 2 / r2)
    rates = np.empty_like(state)
    rates[:, :3] = v
    rates[:, 3:] = p * radial[:, None] + pull
    rates[:, 3] += _GLONASS_RATE**2 * p[:, 0] + 2 * _GLONASS_RATE * v[:, 1]
    rates[:, 4] += _GLONASS_RATE**2 * p[:, 1] - 2 * _GLONASS_RATE * v[:, 0]
    rates[:, 5] -= 2 * oblate * p[:, 2]
    return rates


def _clock_reference(ephemeris: Ephemeris | None) -> int:
    if isinstance(ephemeris, KeplerEphemeris):
        return ephemeris.toc_ns
    return 0 if ephemeris is None else ephemeris.toe_ns


def _clock_polynomial(ephemeris: Ephemeris | None) -> tuple[float, float, float]:
    if isinstance(ephemeris, KeplerEphemeris):
        return ephemeris.af0, ephemeris.af1, ephemeris.af2
    return (np.nan, 0.0, 0.0) if ephemeris is None else (ephemeris.tau, ephemeris.gamma, 0.0)
