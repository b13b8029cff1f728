"""The satellites of a simulated sky: their orbits, and the ephemerides that they broadcast of them, issue by issue.

A satellite flies on one orbit, that of its first issue as its message rounds it; later issues describe the same orbit
for a later time, rounded anew. Sources of the nominal orbits: IS-GPS-200, GPS SPS PS (2020), 3.2; Galileo OS SDD, 3.1;
BeiDou OS PS 3.0, 3.1; GLONASS ICD 5.1, 3.3.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from air.gnss import beidou_d1_d2, glonass_strings, inav, lnav
from air.gnss.atmosphere import B1I_HZ, L1_HZ
from air.gnss.calendar import leap_seconds, to_calendar
from air.gnss.ephemerides import is_healthy
from air.gnss.gnss_time import BEIDOU_EPOCH_NS, GPS_EPOCH_NS, SECOND_NS, WEEK_NS
from air.gnss.orbit import MU, RATE, is_geostationary, states_at
from air.sources.rinex import open_rinex
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.gnss.nominal_orbits import nominal, wrapped
from common.arrays import F64
from common.errors import SourceError
from common.measurements import Ephemeris, GlonassEphemeris, Ionosphere, KeplerEphemeris

_CONSTELLATION = 50
HOUR_NS = 3600 * SECOND_NS
IONOSPHERE = Ionosphere(
    0,
    "G",
    (12 * 2.0**-30, -1 * 2.0**-27, -1 * 2.0**-24, 2 * 2.0**-24),
    (57 * 2.0**11, -14 * 2.0**14, -2 * 2.0**16, 16 * 2.0**16),
)
"""Close to GPS's broadcast of 2004-01-01, in whole units of the message."""

_GEOMAGNETIC_SHIFT = -0.064
"""By so much geomagnetic latitudes are less than geographic ones in East Asia, semicircles."""
_PERIOD_S = {"G": 7200, "E": 600, "C": 3600, "R": 1800}
_LEAD_S = {"G": 7200, "E": -600, "C": 0, "R": 900}
"""How often a satellite begins a new issue, and how far its reference time lies ahead of that beginning."""
_PHASE_STEP_S = 16
"""GPS satellites in their turn are uploaded at any time; reference times are multiples of this."""
_REACH_NS = 2 * HOUR_NS


class Constellation:
    """N satellites in order of their names. `reference` holds the orbit that each really flies."""

    def __init__(self, orbits: Iterable[Ephemeris], ionosphere: Ionosphere, start_ns: int, seed: int):
        self.ionosphere, self.beidou_ionosphere = ionosphere, told_by_beidou(ionosphere)
        self.leap_s = leap_seconds(to_calendar(start_ns))
        by_name = {orbit.satellite: orbit for orbit in orbits}
        uploads = np.random.default_rng([seed, _CONSTELLATION, 1]).integers(0, 5 * _PERIOD_S["G"] // _PHASE_STEP_S, 64)
        self._phase_s: dict[str, int] = {}
        self._issues: dict[tuple[str, int], Ephemeris] = {}
        references = []
        for name in sorted(by_name):
            off_s = int(uploads[int(name[1:])]) * _PHASE_STEP_S
            self._phase_s[name] = {"R": self.leap_s, "G": off_s if off_s < _PERIOD_S["G"] else 0}.get(name[0], 0)
            try:
                reference = self._rounded(self._moved(by_name[name], *self._issue_time(name, start_ns)))
            except ValueError:  # a value of a damaged file does not fit the message
                continue
            references.append(reference)
        self.reference: tuple[Ephemeris, ...] = tuple(references)
        self.satellites = tuple(reference.satellite for reference in references)
        self._by_name = dict(zip(self.satellites, references, strict=True))
        self._first = {name: self._issue_time(name, start_ns)[0] for name in self.satellites}

    def issue(self, satellite: str, t_ns: int) -> Ephemeris:
        """The ephemeris that a satellite broadcasts at GPST `t_ns`, as a receiver decodes it."""
        number, toe_ns = self._issue_time(satellite, t_ns)
        reference = self._by_name[satellite]
        if number <= self._first[satellite] or is_geostationary(satellite):
            return reference
        if (satellite, number) not in self._issues:
            self._issues[satellite, number] = self._rounded(self._moved(reference, number, toe_ns))
        return self._issues[satellite, number]

    def _issue_time(self, satellite: str, t_ns: int) -> tuple[int, int]:
        """Number and reference time of the issue that is broadcast at `t_ns`."""
        period_ns, lead_ns = (table[satellite[0]] * SECOND_NS for table in (_PERIOD_S, _LEAD_S))
        phase_ns = self._phase_s[satellite] * SECOND_NS
        epoch_ns = BEIDOU_EPOCH_NS if satellite[0] == "C" else GPS_EPOCH_NS
        number = (t_ns - epoch_ns - phase_ns) // period_ns
        return number, epoch_ns + number * period_ns + phase_ns + lead_ns

    def _moved(self, orbit: Ephemeris, number: int, toe_ns: int) -> Ephemeris:
        """The same orbit and clock, described for another reference time (geostationary: as it is)."""
        if isinstance(orbit, GlonassEphemeris):
            at = states_at([orbit], toe_ns, np.zeros(1))
            (x, y, z), (vx, vy, vz) = at.position[0].tolist(), at.velocity[0].tolist()
            return replace(orbit, toe_ns=toe_ns, position=(x, y, z), velocity=(vx, vy, vz), tau=float(at.clock[0]))
        if is_geostationary(orbit.satellite):
            return orbit
        issue = number % 256 if orbit.satellite[0] == "G" else number % 1024
        issue = 1 if orbit.satellite[0] == "C" else issue
        dt, dt_clock = (toe_ns - orbit.toe_ns) / SECOND_NS, (toe_ns - orbit.toc_ns) / SECOND_NS
        mean_motion = np.sqrt(MU[orbit.satellite[0]]) / orbit.sqrt_a**3 + orbit.delta_n
        return replace(
            turned(orbit, toe_ns, orbit.omega_dot - RATE[orbit.satellite[0]]),
            iode=issue,
            iodc=issue,
            toc_ns=toe_ns,
            m0=wrapped(orbit.m0 + mean_motion * dt),
            i0=orbit.i0 + orbit.idot * dt,
            af0=orbit.af0 + orbit.af1 * dt_clock + orbit.af2 * dt_clock**2,
            af1=orbit.af1 + 2 * orbit.af2 * dt_clock,
        )

    def _rounded(self, orbit: Ephemeris) -> Ephemeris:
        """What a receiver decodes of it. Raises ValueError for a value that the message cannot hold."""
        t_ns, name = orbit.toe_ns, orbit.satellite
        found: Ephemeris | None
        if isinstance(orbit, GlonassEphemeris):
            strings = map(glonass_strings.string, glonass_strings.strings(orbit, t_ns, self.leap_s))
            found = glonass_strings.ephemeris([bits or 0 for bits in strings], name, orbit.channel, t_ns, self.leap_s)
        elif name[0] == "G":
            subframes = map(lnav.subframe, lnav.ephemeris_words(orbit, t_ns // HOUR_NS * HOUR_NS))
            found = lnav.ephemeris([bits or 0 for bits in subframes], name, t_ns)
        elif name[0] == "E":
            words = map(inav.word, inav.pages(orbit, t_ns))
            found = inav.ephemeris([bits or 0 for bits in words], name, t_ns)
        else:
            subframes = map(beidou_d1_d2.subframe, beidou_d1_d2.ephemeris_words(orbit, self.beidou_ionosphere, t_ns))
            both = beidou_d1_d2.ephemeris([bits or 0 for bits in subframes], name, t_ns)
            found = both[0] if both else None
        if found is None:
            raise ValueError(f"{orbit.satellite} cannot be broadcast")
        return found


def constellation(options: GnssOptions, start_ns: int, seed: int) -> Constellation:
    """The satellites of a flight that starts at GPST `start_ns`: nominal ones, or those of a navigation file.

    Raises SourceError for systems that there are not, and for a file that cannot be read or that holds no usable orbit.
    """
    if not options.systems or set(options.systems) - set(_PERIOD_S):
        raise SourceError(f"option 'systems' is {options.systems!r}, must be some of GREC")
    rng = np.random.default_rng([seed, _CONSTELLATION, 0])
    found: Sequence[Ephemeris | Ionosphere] = nominal(start_ns, rng)
    if options.nav:
        found = from_navigation(Path(options.nav).expanduser(), start_ns)
    ionosphere = next((m for m in found if isinstance(m, Ionosphere) and m.system == "G"), IONOSPHERE)
    orbits = [m for m in found if not isinstance(m, Ionosphere) and m.satellite[0] in options.systems]
    flying = Constellation(orbits, replace(ionosphere, t_ns=start_ns), start_ns, seed)
    if not flying.satellites:
        raise SourceError(f"option 'nav': {options.nav!r} holds no usable ephemeris of the systems {options.systems}")
    return flying


def told_by_beidou(model: Ionosphere) -> Ionosphere:
    """GPS's ionosphere as BeiDou tells it over East Asia: by geographic latitude, at B1I, rounded as its message does.

    That is north of the equator; elsewhere both constellations differ, as they do in the real sky.
    """
    geomagnetic = np.polynomial.Polynomial([_GEOMAGNETIC_SHIFT, 1.0])
    scale = (L1_HZ / B1I_HZ) ** 2

    def moved(values: tuple[float, ...], times: float, units: tuple[int, ...]) -> tuple[float, float, float, float]:
        coefficients: F64 = np.pad(np.polynomial.Polynomial(values)(geomagnetic).coef, (0, 4))[:4].astype(float)
        steps = 2.0 ** np.array(units)
        a, b, c, d = (np.clip(np.rint(times * coefficients / steps), -128, 127) * steps).tolist()
        return a, b, c, d

    return Ionosphere(
        model.t_ns, "C", moved(model.alpha, scale, (-30, -27, -24, -24)), moved(model.beta, 1.0, (11, 14, 16, 16))
    )


def from_navigation(path: Path, start_ns: int) -> list[Ephemeris | Ionosphere]:
    """One orbit of each satellite of a RINEX navigation file, and the ionosphere in it.

    They are moved in time, as the earth sees them, by whole hours, so that the middle of the file is the start of
    the flight. Raises SourceError for a file that cannot be read.
    """
    found = list(open_rinex(f"rinex:{path}", str(path)))
    orbits = [
        m
        for m in found
        if isinstance(m, KeplerEphemeris | GlonassEphemeris)
        and m.satellite[0] in _PERIOD_S
        and is_healthy(m)
        and getattr(m, "source", "") != "FNAV"
    ]
    if not orbits:
        return []
    middle_ns = sorted(orbit.toe_ns for orbit in orbits)[len(orbits) // 2]
    shift_ns = round((start_ns - middle_ns) / HOUR_NS) * HOUR_NS
    best: dict[str, Ephemeris] = {}
    for orbit in orbits:
        moved = _shifted(orbit, shift_ns)
        distance_ns = abs(moved.toe_ns - start_ns)
        known = best.get(orbit.satellite)
        if distance_ns <= _REACH_NS and (known is None or distance_ns < abs(known.toe_ns - start_ns)):
            best[orbit.satellite] = moved
    return [*best.values(), *(m for m in found if isinstance(m, Ionosphere))]


def turned(orbit: KeplerEphemeris, toe_ns: int, node_rate: float) -> KeplerEphemeris:
    """The orbit with another reference time, its node moved by `node_rate` rad/s over the earth until then."""
    dt = (toe_ns - orbit.toe_ns) / SECOND_NS
    epoch_ns = BEIDOU_EPOCH_NS if orbit.satellite[0] == "C" else GPS_EPOCH_NS
    before_s, after_s = ((toe - epoch_ns) % WEEK_NS / SECOND_NS for toe in (orbit.toe_ns, toe_ns))
    omega0 = orbit.omega0 + node_rate * dt + RATE[orbit.satellite[0]] * (after_s - before_s)
    return replace(orbit, toe_ns=toe_ns, omega0=wrapped(omega0))


def _shifted(orbit: Ephemeris, shift_ns: int) -> Ephemeris:
    """An orbit that is over the same places as much later."""
    if isinstance(orbit, GlonassEphemeris):
        return replace(orbit, toe_ns=orbit.toe_ns + shift_ns)
    return replace(turned(orbit, orbit.toe_ns + shift_ns, 0.0), toc_ns=orbit.toc_ns + shift_ns)
