"""The signals of one epoch without what models know of them: satellite clocks, group delays, air.

What is left of a measurement is the range to a satellite at a known place, the receiver's clock and errors. Source:
Misra and Enge, Global Positioning System, chapter 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.gnss.atmosphere import L1_HZ, TYPICAL, klobuchar, saastamoinen
from air.gnss.ephemerides import Ephemerides, is_healthy
from air.gnss.orbit import geometric_range, states_at_transmission
from air.gnss.positioning import azimuth_elevation
from air.gnss.ranges import CLOCKS, FURTHEST, NEAREST, group_delay, tells_group_delay
from air.gnss.signals import LIGHT, PRIMARY, SECONDARY, frequency, preference
from common.arrays import F64, I64, Bool
from common.geo import ecef_to_geodetic
from common.measurements import Ephemeris, GnssEpoch

_LOWEST = np.radians(5.0)
_FAR, _FAST = 1e10, 1e5
"""No carrier, m, and no range rate, m/s, is larger, whatever the receiver's clock does."""


@dataclass(frozen=True, eq=False)
class Signals:
    """One row for each of M signals, at most one for each satellite and band; the first band's come first.

    `row` (M,) is that of the epoch, `first` (M,) whether it is the first band. `p_satellite`, `v_satellite` (M, 3) are
    in ECEF at transmission, as the frame stood then. `code`, `carrier` (M,) m and `rate` (M,) m/s are free of the
    models; `carrier` is NaN where none is tracked, `rate` where there is no Doppler. `bend` (M,) is by how much the
    ionosphere delays more than at L1; `slant` (M,) by how much more than in the zenith; `elevation` (M,) rad; `told`
    (M,) whether the satellite says by how much its signal is late; `issue` (M,) tells one ephemeris from the next.
    `renewed` (M,) m is by how much the newest model of the ionosphere, which codes take, delays more than the one that
    carriers keep to.
    """

    row: I64
    satellites: tuple[str, ...]
    clocks: tuple[str, ...]
    first: Bool
    p_satellite: F64
    v_satellite: F64
    code: F64
    carrier: F64
    rate: F64
    frequency: F64
    bend: F64
    slant: F64
    elevation: F64
    told: Bool
    issue: I64
    renewed: F64

    @property
    def keys(self) -> list[tuple[str, bool]]:
        """Satellite and band of each signal."""
        return list(zip(self.satellites, self.first.tolist(), strict=True))

    def ranges(self, p_ecef: F64) -> F64:
        """Distances (M,) m that the signals travel to a place (3,) m, the turn of the earth included."""
        return geometric_range(self.p_satellite, p_ecef)[0]

    def sigma_rate(self, epoch: GnssEpoch) -> F64:
        """One sigma (M,) m/s of the rates as the receiver of their epoch says, 0 where it does not."""
        with np.errstate(over="ignore"):
            return np.nan_to_num(epoch.sigma_doppler[self.row] * LIGHT / self.frequency)


def correct(epoch: GnssEpoch, broadcast: Ephemerides, p_ecef: F64) -> Signals:
    """The signals of healthy satellites above the horizon with what models know taken off, for a receiver near a place.

    `p_ecef` (3,) m need only be known to some hundred metres.
    """
    chosen = _choose(epoch, broadcast)
    rows = np.array([row for row, _, _ in chosen], np.int64)
    ephemerides = [ephemeris for _, ephemeris, _ in chosen]
    satellites = [epoch.satellites[row] for row in rows]
    signals = [epoch.signals[row] for row in rows]
    f = np.array([frequency(*one) for one in zip(satellites, signals, epoch.channel[rows].tolist(), strict=True)])
    states = states_at_transmission(ephemerides, epoch.t_ns, epoch.pseudorange[rows])
    _, line = geometric_range(states.position, p_ecef)
    geodetic = ecef_to_geodetic(p_ecef) * (np.pi / 180, np.pi / 180, 1.0)
    azimuth, elevation = azimuth_elevation(line, geodetic)
    angle = np.maximum(elevation, _LOWEST)
    bend = (L1_HZ / f) ** 2
    of_code, of_carrier = (
        bend * klobuchar(model or TYPICAL, epoch.t_ns, geodetic, azimuth, angle)[0]
        for model in (broadcast.ionosphere(), broadcast.steady_ionosphere())
    )
    troposphere = saastamoinen(geodetic, angle)[0]
    known = LIGHT * states.clock - troposphere
    late = [group_delay(one, signal, each) for one, signal, each in zip(ephemerides, signals, f.tolist(), strict=True)]
    keep = np.isfinite(known) & np.isfinite(f) & np.isfinite(states.position).all(axis=1) & (elevation > 0)
    index = np.flatnonzero(keep)
    with np.errstate(over="ignore"):
        carrier = epoch.carrier_phase[rows] * LIGHT / f + known + of_carrier
        rate = -epoch.doppler[rows] * LIGHT / f + LIGHT * states.drift
    return Signals(
        row=rows[index],
        satellites=tuple(satellites[i] for i in index),
        clocks=tuple(CLOCKS[satellites[i][0]] for i in index),
        first=np.array([first for _, _, first in chosen], bool)[index],
        p_satellite=states.position[index],
        v_satellite=states.velocity[index],
        code=(epoch.pseudorange[rows] + known - of_code - np.array(late, float))[index],
        carrier=np.where(epoch.half_cycle[rows] | ~(np.abs(carrier) < _FAR), np.nan, carrier)[index],
        rate=np.where(np.abs(rate) < _FAST, rate, np.nan)[index],
        frequency=f[index],
        bend=bend[index],
        slant=(1.0 + 16.0 * (0.53 - angle / np.pi) ** 3)[index],
        elevation=elevation[index],
        told=np.array([tells_group_delay(one) for one in ephemerides], bool)[index],
        issue=np.array([one.toe_ns for one in ephemerides], np.int64)[index],
        renewed=(of_code - of_carrier)[index],
    )


def _choose(epoch: GnssEpoch, broadcast: Ephemerides) -> list[tuple[int, Ephemeris, bool]]:
    """Row, ephemeris and whether it is the first band, of the preferred signal of each satellite's two bands."""
    best: dict[tuple[bool, str], int] = {}
    for row, (satellite, signal) in enumerate(zip(epoch.satellites, epoch.signals, strict=True)):
        system, band = satellite[:1], signal[:1]
        if band not in (PRIMARY.get(system), SECONDARY.get(system)):
            continue
        if not NEAREST < epoch.pseudorange[row] < FURTHEST:
            continue
        key = (band != PRIMARY[system], satellite)
        if key not in best or preference(signal) < preference(epoch.signals[best[key]]):
            best[key] = row
    chosen = []
    for (second, satellite), row in sorted(best.items()):
        ephemeris = broadcast.find(satellite, epoch.t_ns)
        if satellite[0] in CLOCKS and ephemeris is not None and is_healthy(ephemeris):
            chosen.append((row, ephemeris, not second))
    return chosen
