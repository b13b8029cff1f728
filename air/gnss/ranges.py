"""From the raw signals of an epoch to one clean pseudorange for each satellite, with the satellite's state."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from air.gnss.ephemerides import Ephemerides, is_healthy
from air.gnss.orbit import SatelliteStates, states_at_transmission
from air.gnss.settings import PositioningSettings
from air.gnss.signals import LIGHT, PRIMARY, SECONDARY, frequency, preference
from common.arrays import F64
from common.measurements import Ephemeris, GnssEpoch, KeplerEphemeris

CLOCKS = {"G": "G", "J": "G", "E": "E", "R": "R", "C": "C"}
"""Clock that each system's ranges share: QZSS runs on GPS time."""
NEAREST, FURTHEST = 1.0e7, 1.0e8
"""Pseudoranges in m beyond these were not measured, whatever the receiver's clock shows."""
FASTEST = 1.0e5
"""Nor were range rates in m/s beyond this."""

_URA_BOUNDS = (2.4, 3.4, 4.85, 6.85, 9.65, 13.65, 24.0, 48.0, 96.0, 192.0, 384.0, 768.0, 1536.0, 3072.0, 6144.0)
_GLONASS_ACCURACY = 5.0


@dataclass(frozen=True, eq=False)
class Ranges:
    """One row for each of N satellites, in the order of their names.

    `pseudorange` (N,) m with group delays removed; `range_rate` (N,) m/s from Doppler, NaN where there is none, of
    a signal of `frequency` (N,) Hz, with `sigma_rate` (N,) m/s as the receiver says, or NaN; `sigma` (N,) m, one
    sigma of the satellite's orbit and clock; `clock` names the clock of each. `rejected` tells of the other
    satellites of the epoch why they are not here.
    """

    satellites: tuple[str, ...]
    clock: tuple[str, ...]
    states: SatelliteStates
    pseudorange: F64
    range_rate: F64
    sigma_rate: F64
    frequency: F64
    sigma: F64
    rejected: dict[str, str]


def clean_ranges(epoch: GnssEpoch, broadcast: Ephemerides, settings: PositioningSettings) -> Ranges:
    """The ranges of an epoch that can serve a position, before anything is known about the place."""
    rejected: dict[str, str] = {}
    rows: list[tuple[str, Ephemeris, float, int]] = []
    for satellite, indices in _by_satellite(epoch):
        ephemeris = broadcast.find(satellite, epoch.t_ns)
        reason, pseudorange, row = "", np.nan, -1
        if satellite[:1] not in settings.systems or satellite[:1] not in CLOCKS:
            reason = "system not used"
        elif ephemeris is None:
            reason = "no ephemeris"
        elif not is_healthy(ephemeris):
            reason = "unhealthy"
        else:
            pseudorange, row, reason = _pseudorange(epoch, indices, ephemeris, settings)
        if reason or ephemeris is None:
            rejected[satellite] = reason
        else:
            rows.append((satellite, ephemeris, pseudorange, row))

    ephemerides = [row[1] for row in rows]
    index = np.array([row[3] for row in rows], int)
    states = states_at_transmission(ephemerides, epoch.t_ns, epoch.pseudorange[index])
    f = np.array([frequency(epoch.satellites[i], epoch.signals[i], epoch.channel[i]) for i in index], float)
    range_rate, sigma_rate = -epoch.doppler[index] * (LIGHT / f), epoch.sigma_doppler[index] * (LIGHT / f)
    range_rate[~(np.abs(range_rate) < FASTEST)] = np.nan
    kept = np.isfinite(states.position).all(axis=1) & np.isfinite(states.clock) & np.isfinite(f)
    rejected |= {row[0]: "senseless ephemeris" for row, good in zip(rows, kept, strict=True) if not good}
    satellites = tuple(row[0] for row, good in zip(rows, kept, strict=True) if good)
    return Ranges(
        satellites=satellites,
        clock=tuple(CLOCKS[satellite[0]] for satellite in satellites),
        states=SatelliteStates(states.position[kept], states.velocity[kept], states.clock[kept], states.drift[kept]),
        pseudorange=np.array([row[2] for row in rows], float)[kept],
        range_rate=range_rate[kept],
        sigma_rate=np.minimum(sigma_rate, FASTEST)[kept],
        frequency=f[kept],
        sigma=np.array([_ephemeris_sigma(ephemeris) for ephemeris in ephemerides], float)[kept],
        rejected=rejected,
    )


def group_delay(ephemeris: Ephemeris, signal: str, f: float) -> float:
    """Delay in m by which a signal of frequency `f` Hz is late against the ephemeris' clock.

    Sources: IS-GPS-200, 20.3.3.3.3.2; Galileo OS SIS ICD, 5.1.5; BeiDou B1I ICD, 5.2.4.10. GLONASS tells none.
    """
    if not isinstance(ephemeris, KeplerEphemeris):
        return 0.0
    system, band = ephemeris.satellite[0], signal[:1]
    first, second = ephemeris.group_delay
    if system in "GJ":
        return LIGHT * first * (1575.42e6 / f) ** 2
    if system == "C":
        return LIGHT * {"2": first, "7": second}.get(band, 0.0)
    # Galileo's clock is that of E1 with E5a (F/NAV) or with E5b (I/NAV), which differ by second − first.
    own = second if ephemeris.source == "INAV" else first
    scale = (1575.42e6 / f) ** 2
    late = {"1": own, "5": own - first + scale * first, "7": own - second + scale * second}
    return LIGHT * late.get(band, own)


def tells_group_delay(ephemeris: Ephemeris) -> bool:
    """Whether an ephemeris says by how much signals are late: GLONASS's and those fitted to precise orbits do not."""
    return isinstance(ephemeris, KeplerEphemeris) and ephemeris.source != "SP3"


def _by_satellite(epoch: GnssEpoch) -> Iterable[tuple[str, list[int]]]:
    order = sorted(range(len(epoch.satellites)), key=epoch.satellites.__getitem__)
    return [(satellite, list(rows)) for satellite, rows in groupby(order, key=epoch.satellites.__getitem__)]


def _pseudorange(
    epoch: GnssEpoch, rows: list[int], ephemeris: Ephemeris, settings: PositioningSettings
) -> tuple[float, int, str]:
    """Pseudorange of a satellite without group delay, m; the row of its first signal; and why it cannot be used."""
    system = ephemeris.satellite[0]
    first = _best(epoch, rows, PRIMARY[system])
    if first is None:
        return np.nan, -1, "no code on the first band"
    if epoch.cn0[first] < settings.min_cn0:
        return np.nan, -1, "weak signal"
    p1, f1 = _without_delay(epoch, first, ephemeris)
    if not settings.ionosphere_free:
        return p1, first, ""
    second = _best(epoch, rows, SECONDARY[system])
    if second is None or epoch.cn0[second] < settings.min_cn0:
        return np.nan, -1, "no second band"
    p2, f2 = _without_delay(epoch, second, ephemeris)
    return (f1**2 * p1 - f2**2 * p2) / (f1**2 - f2**2), first, ""


def _best(epoch: GnssEpoch, rows: list[int], band: str) -> int | None:
    """Row of the preferred signal of a band that has a believable pseudorange."""
    fit = [i for i in rows if epoch.signals[i][:1] == band and NEAREST < epoch.pseudorange[i] < FURTHEST]
    return min(fit, key=lambda i: preference(epoch.signals[i]), default=None)


def _without_delay(epoch: GnssEpoch, row: int, ephemeris: Ephemeris) -> tuple[float, float]:
    """Pseudorange in m without the satellite's group delay, and its frequency in Hz."""
    signal = epoch.signals[row]
    f = frequency(epoch.satellites[row], signal, int(epoch.channel[row]))
    return float(epoch.pseudorange[row]) - group_delay(ephemeris, signal, f), f


def _ephemeris_sigma(ephemeris: Ephemeris) -> float:
    """One sigma of the satellite's orbit and clock, m: the bound of its user range accuracy's class."""
    if not isinstance(ephemeris, KeplerEphemeris):
        return _GLONASS_ACCURACY
    if ephemeris.satellite[0] == "E":
        return ephemeris.accuracy if 0 <= ephemeris.accuracy <= 6 else 500.0
    return next((bound for bound in _URA_BOUNDS if ephemeris.accuracy <= bound), _URA_BOUNDS[-1])
