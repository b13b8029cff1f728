"""What all receivers of a simulated flight share: where satellites really are, what their clocks show, and the air.

Times are seconds of GPST since the start of the flight. The range is that of light from the satellite at its time to
the antenna at its own, in the frame that does not turn with the earth (Ashby, Relativity in the GPS, 2003, section 2).
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from air.gnss.atmosphere import L1_HZ, klobuchar, saastamoinen
from air.gnss.gnss_time import SECOND_NS
from air.gnss.orbit import EARTH_RATE, states_at
from air.gnss.positioning import azimuth_elevation
from air.gnss.ranges import group_delay
from air.gnss.signals import LIGHT, frequency
from air.sources.simulated.gnss.constellation import Constellation
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.gnss.ionosphere import IonosphereError
from air.sources.simulated.gnss.swing import Swing
from common.arrays import F64
from common.geo import T_ecef_enu, ecef_to_geodetic, geodetic_to_ecef
from common.measurements import GlonassEphemeris
from common.messages import Datum

_ERRORS, _FAULTS = 51, 52
SIGNALS = {"G": ("1C", "2L"), "E": ("1C", "7Q"), "C": ("2I", "7I"), "R": ("1C", "2C")}
_WITHOUT_L2C = {"G02", "G13", "G16", "G19", "G20", "G21", "G22"}
_LAST_BEIDOU_2 = 16
_NODE_S, _NODES_KEPT = 10.0, 8
_LOWEST = np.radians(5.0)
"""Below this, delays in the air are those of this elevation: the models know no horizon."""
_ERROR_OF = {"G": 1.0, "E": 0.35, "C": 1.6, "R": 3.0}
"""How large orbits' and clocks' errors of a system are against GPS's (Montenbruck, Steigenberger and Hauschild,
Multi-GNSS signal-in-space range error assessment, 2018: 0.6 m, Galileo 0.2 m, BeiDou-2 1 m, GLONASS 2 m)."""
_FAULT_ELEVATION = np.radians(25.0)


@dataclass(frozen=True, eq=False)
class Geometry:
    """From N times and places to S satellites: `distance` (N, S) m and its `rate` (N, S) m/s; `clock` (N, S) m and
    `clock_rate` m/s, by how far the satellites' clocks are ahead."""

    distance: F64
    rate: F64
    clock: F64
    clock_rate: F64


@dataclass(frozen=True, eq=False)
class Air:
    """Seen from a place: `azimuth`, `elevation` (S,) rad, `direction` (S, 3) in ENU there, and delays (S,) m of the
    code: `ionosphere` at L1, `troposphere` of all signals."""

    azimuth: F64
    elevation: F64
    direction: F64
    ionosphere: F64
    troposphere: F64


class Sky:
    """S satellites with two signals each, their errors and the air, over a flight that starts at the datum."""

    def __init__(self, constellation: Constellation, options: GnssOptions, datum: Datum, start_ns: int, seed: int):
        self.constellation = constellation
        self.satellites = constellation.satellites
        self.start_ns = start_ns
        self.datum = datum
        self.options = options
        n = len(self.satellites)
        rng = np.random.default_rng([seed, _ERRORS])
        share = np.array([_ERROR_OF[name[0]] for name in self.satellites])
        self._orbit_error = Swing(rng, (n, 3), options.orbit * share[:, None], 10_800.0, 21_600.0)
        self._clock_error = Swing(rng, (n,), options.satellite_clock * share, 10_800.0, 21_600.0)
        self._ionosphere_error = IonosphereError(options, n, rng)
        self._troposphere_error = Swing(rng, (1,), options.troposphere_residual, 3600.0, 10_800.0)
        self._nodes: OrderedDict[int, tuple[F64, F64, F64]] = OrderedDict()
        self.channel = np.array([getattr(r, "channel", 0) for r in constellation.reference], np.int32)
        self.signals = tuple(SIGNALS[name[0]] for name in self.satellites)
        self.exists = np.array([[True, _sends_second(name)] for name in self.satellites])
        rows = list(zip(constellation.reference, self.signals, self.channel.tolist(), strict=True))
        self.frequency = np.array([[frequency(r.satellite, s, c) for s in two] for r, two, c in rows])
        self.group_delay = np.array(
            [[group_delay(r, s, frequency(r.satellite, s, c)) for s in two] for r, two, c in rows]
        )
        self.is_glonass = np.array([isinstance(r, GlonassEphemeris) for r in constellation.reference])
        self.faulty = np.zeros(n, bool)
        if options.fault:
            place = geodetic_to_ecef(datum.latitude_deg, datum.longitude_deg, datum.height)
            high = np.flatnonzero(self.air(options.fault_start, place).elevation > _FAULT_ELEVATION)
            self.faulty[np.random.default_rng([seed, _FAULTS]).permutation(high)[: options.fault]] = True

    def geometry(self, t_s: F64, position: F64, velocity: F64) -> Geometry:
        """Ranges and clocks at times (N,) for an antenna at `position` (N, 3) m with `velocity` (N, 3) m/s, ECEF."""
        p, v, a, clock, clock_rate = self._satellites(t_s)
        tau = np.full(p.shape[:2], 0.08)
        for _ in range(4):
            sent = p - v * tau[..., None] + a * (0.5 * tau**2)[..., None]
            line = _turned(sent, EARTH_RATE * tau) - position[:, None]
            distance = np.sqrt(np.einsum("nsi,nsi->ns", line, line))
            tau = distance / LIGHT
        e = line / distance[..., None]
        v_sent = _turned(v - a * tau[..., None], EARTH_RATE * tau)
        seen = line + position[:, None]
        v_frame = EARTH_RATE * np.stack([seen[..., 1], -seen[..., 0], np.zeros_like(tau)], axis=-1)
        closing = np.einsum("nsi,nsi->ns", e, v_sent - velocity[:, None])
        slowing = 1 + np.einsum("nsi,nsi->ns", e, v_sent - v_frame) / LIGHT
        rate = closing / slowing
        clock_m = LIGHT * (clock - clock_rate * tau)
        return Geometry(distance, rate, clock_m, LIGHT * clock_rate * (1 - rate / LIGHT))

    def air(self, t_s: float, position: F64) -> Air:
        """The sky at a time from a place (3,) m, ECEF."""
        p, *_ = self._satellites(np.array([t_s]))
        line = p[0] - position
        line /= np.linalg.norm(line, axis=1)[:, None]
        geodetic = ecef_to_geodetic(position) * (np.pi / 180, np.pi / 180, 1.0)
        azimuth, elevation = azimuth_elevation(line, geodetic)
        angle = np.maximum(elevation, _LOWEST)
        t_ns = self.start_ns + round(t_s * SECOND_NS)
        delay, _ = klobuchar(self.constellation.ionosphere, t_ns, geodetic, azimuth, angle)
        wet_and_dry, _ = saastamoinen(geodetic, angle)
        slant = 1.0 + 16.0 * (0.53 - angle / np.pi) ** 3
        return Air(
            azimuth=azimuth,
            elevation=elevation,
            direction=np.stack(
                [np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
            ),
            ionosphere=self.options.ionosphere * delay
            + slant * self._ionosphere_error.at(t_s, self._apart(position), azimuth, angle),
            troposphere=self.options.troposphere * wet_and_dry
            + self._troposphere_error.at(np.array(t_s)) / np.sin(angle),
        )

    def _apart(self, position: F64) -> F64:
        """How far north and east (2,) km of the flight's start a place (3,) m lies, ECEF."""
        east, north, _ = T_ecef_enu(self.datum).inverse().apply(position)
        return np.array([north, east]) / 1000.0

    def _satellites(self, t_s: F64) -> tuple[F64, F64, F64, F64, F64]:
        """Position, velocity, acceleration (N, S, 3) in ECEF, clock (N, S) s and its rate at times (N,), errors
        included. Between nodes every 10 s, cubic Hermite interpolation is good to a micrometre."""
        j = np.floor(t_s / _NODE_S).astype(int)
        first, last = (int(j.min()), int(j.max()) + 1) if len(j) else (0, 1)
        nodes = [self._node(k) for k in range(first, last + 1)]
        h = _NODE_S
        p0, v0, c0 = (np.stack([node[i] for node in nodes])[j - first] for i in range(3))
        p1, v1, c1 = (np.stack([node[i] for node in nodes])[j - first + 1] for i in range(3))
        x = (t_s - j * h)[:, None, None]
        bend = 2 * (3 * (p1 - p0) / h - 2 * v0 - v1) / h
        twist = 6 * (v0 + v1 - 2 * (p1 - p0) / h) / h**2
        p = p0 + x * (v0 + x * (bend / 2 + x * twist / 6))
        v = v0 + x * (bend + x * twist / 2)
        clock_rate = (c1 - c0) / h
        clock = c0 + x[..., 0] * clock_rate
        p_error, v_error = self._orbit_error.at(t_s), self._orbit_error.rate(t_s)
        c_error, c_rate = self._clock_error.at(t_s) / LIGHT, self._clock_error.rate(t_s) / LIGHT
        late = self.options.fault_bias + self.options.fault_ramp * (t_s - self.options.fault_start)
        failed = (t_s >= self.options.fault_start)[:, None] & self.faulty
        c_fault = np.where(failed, -late[:, None], 0.0) / LIGHT
        ramp = np.where(failed, -self.options.fault_ramp, 0.0) / LIGHT
        return p + p_error, v + v_error, bend + x * twist, clock + c_error + c_fault, clock_rate + c_rate + ramp

    def _node(self, k: int) -> tuple[F64, F64, F64]:
        """Position and velocity (S, 3) and clock (S,) of the orbits at node `k`."""
        if k not in self._nodes:
            states = states_at(self.constellation.reference, self.start_ns, np.full(len(self.satellites), k * _NODE_S))
            self._nodes[k] = states.position, states.velocity, states.clock
            while len(self._nodes) > _NODES_KEPT:
                self._nodes.popitem(last=False)
        return self._nodes[k]


def l1_squared_over(frequency: F64) -> F64:
    """By how much more the ionosphere delays a signal than one at L1."""
    return np.asarray((L1_HZ / frequency) ** 2)


def _turned(v: F64, angle: F64) -> F64:
    """Vectors (N, S, 3) of ECEF as the frame stands `angle` (N, S) rad later."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[..., 0] + s * v[..., 1], -s * v[..., 0] + c * v[..., 1], v[..., 2]], axis=-1)


def _sends_second(satellite: str) -> bool:
    """Whether the second signal that the receiver tracks is sent: not by GPS's oldest, nor by BeiDou's newest."""
    if satellite[0] == "C":
        return int(satellite[1:]) <= _LAST_BEIDOU_2
    return satellite not in _WITHOUT_L2C
