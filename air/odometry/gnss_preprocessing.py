"""From the raw measurements of an epoch to those that the odometry can believe.

Elevation mask, satellites seen for a while, C/N0 and standard-deviation gates, residual tests, and both bands as one:
codes and carriers free of the ionosphere where both are there, and the mean of the Dopplers. Sources: Cao, Lu,
Shen, GVINS (2022), section IV; Misra and Enge, Global Positioning System, 5.7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from air.gnss.ephemerides import HeldEphemerides
from air.gnss.gnss_time import SECOND_NS
from air.gnss.positioning import PointPosition, Refused, find_position
from air.gnss.settings import PositioningSettings
from air.odometry.gnss_bands import DIFFERENTIAL, Measured, Row, loudness
from air.odometry.gnss_base import BaseStation
from air.odometry.gnss_carrier import CarrierLocks
from air.odometry.gnss_corrections import Signals, correct
from air.odometry.gnss_settings import GnssSettings
from common.arrays import F64, I64, Bool
from common.measurements import GnssEpoch

_LOW = np.radians(20.0)
_GLONASS = 1.5
_ORBIT = {"E": 0.4, "C": 1.7, "R": 3.0}
"""Orbit and clock as broadcast, in units of those of GPS: O. Montenbruck, P. Steigenberger, A. Hauschild, Multi-GNSS
signal-in-space range error assessment (2018), table 3."""
_UNTOLD = 3.0
"""Least sigma of a satellite's clock, m, where nobody tells by how much its signals are late."""


@dataclass(frozen=True, eq=False)
class CleanEpoch:
    """One row for each of N satellites at GPST `t_ns`, the receiver's clock taken off.

    `satellites` (N,) are named as in RINEX 3, `systems` (N,) by the clock of each; where differences to a base station
    are taken, both end in "-base", for what spoils these is not what spoiled the ranges before. `p_satellite`,
    `v_satellite` (N, 3) are in ECEF at transmission. What models know is taken off `code`, `carrier` m and `rate` m/s
    (N,), all of which may be NaN. `arcs` (N,) names the unbroken carrier, empty where there is none. White noise is
    `sigma_code`, `sigma_carrier`, `sigma_rate` (N,); what stays for a while is `sigma_multipath` and, for `slow_s`
    (N,), `sigma_slow` (N,) m of the code, and `sigma_drift` (N,) m/s of Doppler and carrier. `fix` is the single-point
    position of the epoch, None where it had none. `offset` (N,) m is by how much carrier and code differ: a first guess
    of the ambiguity.
    """

    t_ns: int
    satellites: tuple[str, ...]
    systems: tuple[str, ...]
    p_satellite: F64
    v_satellite: F64
    code: F64
    carrier: F64
    rate: F64
    arcs: tuple[str, ...]
    sigma_code: F64
    sigma_carrier: F64
    sigma_rate: F64
    sigma_multipath: F64
    sigma_slow: F64
    slow_s: F64
    sigma_drift: F64
    elevation: F64
    offset: F64
    fix: PointPosition | None

    @property
    def differential(self) -> bool:
        """Whether differences to a base station are taken."""
        return any(name.endswith(DIFFERENTIAL) for name in self.systems)

    def without_code(self) -> CleanEpoch:
        """The epoch with its carriers and Dopplers alone."""
        return replace(self, code=np.full(len(self.satellites), np.nan))


class GnssPreprocessor:
    """Cleans the epochs of one receiver; keeps ephemerides, locks and its clock whatever happens elsewhere."""

    def __init__(self, settings: GnssSettings, base: F64 | None = None) -> None:
        """`base` (3,) m, ECEF, is where a base station stands whose epochs come by `add_base`, unless these tell it."""
        self._settings = settings
        selection = settings.selection
        self.broadcast = HeldEphemerides()
        self._point = PositioningSettings(
            elevation_mask_deg=selection.elevation_mask_deg, min_cn0=selection.min_cn0, exclude_outliers=True
        )
        self._locks = CarrierLocks(selection)
        self.base = BaseStation(selection, base)
        self._seen: dict[str, tuple[int, int]] = {}
        self._codes: dict[str, tuple[int, float, float]] = {}
        self._fix: PointPosition | None = None

    def add(self, message: object) -> None:
        """Keep what satellites broadcast; ignore anything else."""
        self.broadcast.add(message)

    def add_base(self, epoch: GnssEpoch) -> None:
        """Take an epoch of the base station."""
        self.base.add(epoch, self.broadcast)

    def clean(self, epoch: GnssEpoch, near: F64 | None = None) -> CleanEpoch | Refused:
        """The believable rows of an epoch, or why there are none.

        `near` (3,) m, ECEF, is where the antenna is about; without it the epoch needs a position of its own.
        """
        outcome = find_position(epoch, self.broadcast, self._point, near)
        fix = outcome if isinstance(outcome, PointPosition) else None
        clock_s = self._clock(epoch, fix)
        if clock_s is None or (fix is None and near is None):
            return outcome if isinstance(outcome, Refused) else Refused(epoch.t_ns, "clock unknown", {})
        t_ns = epoch.t_ns - round(clock_s * SECOND_NS)
        place = fix.position if fix is not None else near
        assert place is not None
        signals = correct(epoch, self.broadcast, place)
        usable = self._usable(epoch, signals, t_ns)
        rejected = {name for name, why in outcome.rejected.items() if why.startswith("residual")}
        if fix is not None:
            usable &= ~np.isin(signals.satellites, list(rejected))
        arcs = self._locks.step(epoch.t_ns / SECOND_NS, signals, epoch.lock_s[signals.row])
        if not self._settings.selection.carrier:
            arcs[:] = -1
        clean = self._combine(epoch, signals, usable, arcs, t_ns, fix)
        return self._without_jumps(clean)

    def _clock(self, epoch: GnssEpoch, fix: PointPosition | None) -> float | None:
        """How far the receiver's clock is ahead, s: by this epoch's own fix, or by the last one's and its drift."""
        if fix is not None:
            self._fix = fix
            return next(iter(fix.clocks.values()))
        last = self._fix
        if last is None or epoch.clock_reset or epoch.t_ns - last.t_ns > self._settings.max_age_s * SECOND_NS:
            return None
        drift = last.drift if np.isfinite(last.drift) else 0.0
        return next(iter(last.clocks.values())) + drift * (epoch.t_ns - last.t_ns) / SECOND_NS

    def _usable(self, epoch: GnssEpoch, signals: Signals, t_ns: int) -> Bool:
        """Which signals (M,) pass the gates that look at one signal alone."""
        s, row = self._settings.selection, signals.row
        for satellite in set(signals.satellites):
            since, last = self._seen.get(satellite, (t_ns, t_ns))
            self._seen[satellite] = (since if t_ns - last < 3 * SECOND_NS else t_ns, t_ns)
        seen_s = np.array([(t_ns - self._seen[satellite][0]) / SECOND_NS for satellite in signals.satellites])
        good = signals.elevation >= np.radians(s.elevation_mask_deg)
        good &= ~(epoch.cn0[row] < s.min_cn0)
        good &= (np.fmax(seen_s, epoch.lock_s[row]) >= s.min_seen_s) if len(row) else good
        good &= ~(epoch.sigma_pseudorange[row] > s.max_sigma_code)
        return np.asarray(good)

    def _combine(
        self, epoch: GnssEpoch, signals: Signals, usable: Bool, arcs: I64, t_ns: int, fix: PointPosition | None
    ) -> CleanEpoch:
        """The bands of each satellite as one row."""
        s, noise = self._settings.selection, self._settings.noise
        known_rate = signals.sigma_rate(epoch) <= s.max_sigma_rate
        signals = replace(signals, rate=np.where(known_rate, signals.rate, np.nan))
        measured = Measured(signals, arcs, loudness(epoch.cn0[signals.row]))
        measured, usable = measured.minus(self.base.differences(epoch.t_ns / SECOND_NS, signals), usable)
        second = {name: i for i, name in enumerate(signals.satellites) if not signals.first[i] and usable[i]}
        first = [i for i in range(len(signals.satellites)) if signals.first[i] and usable[i]]
        rows = [measured.of(i, second.get(signals.satellites[i])) for i in first]
        elevation, slant = signals.elevation[first], signals.slant[first]
        ending = "" if measured.base is None else DIFFERENTIAL
        systems = tuple(signals.clocks[i] + ending for i in first)
        system = [signals.satellites[i][0] for i in first]
        orbit = noise.orbit * np.array([_ORBIT.get(name, 1.0) for name in system])
        orbit = np.where(signals.told[first], orbit, np.maximum(orbit, _UNTOLD))
        air = np.hypot(noise.ionosphere * _of(rows, "air") * slant, noise.troposphere / np.sin(elevation))
        drift = np.hypot(noise.orbit_drift, noise.drift * slant * _of(rows, "air_drift"))
        drift = np.where([row.drift_known for row in rows], noise.differential, 1.0) * drift
        glonass = np.where([name == "R" for name in system], _GLONASS, 1.0)
        multipath = _growth(elevation) * _of(rows, "multipath")
        sigma_slow, slow_s = np.hypot(orbit, air), np.full(len(first), noise.slow_s)
        if measured.base is not None:
            # The mean of a base's multipath changes the less, the longer it has been taken.
            base_s = _of(rows, "base_s")
            sigma_base = noise.base * multipath * _kept_by_mean(base_s / noise.base_s)
            sigma_slow = np.hypot(noise.differential * sigma_slow, sigma_base)
            slow_s = np.clip(base_s, noise.base_s, noise.slow_s)
        return CleanEpoch(
            t_ns=t_ns,
            satellites=tuple(signals.satellites[i] + ending for i in first),
            systems=systems,
            p_satellite=signals.p_satellite[first],
            v_satellite=signals.v_satellite[first],
            code=_of(rows, "code"),
            carrier=_of(rows, "carrier"),
            rate=_of(rows, "rate"),
            arcs=tuple(row.arc for row in rows),
            sigma_code=noise.code * _of(rows, "code_noise") * glonass,
            sigma_carrier=noise.carrier * _of(rows, "carrier_noise"),
            sigma_rate=noise.rate * _of(rows, "rate_noise"),
            sigma_multipath=noise.multipath * multipath,
            sigma_slow=sigma_slow,
            slow_s=slow_s,
            sigma_drift=drift,
            elevation=elevation,
            offset=_of(rows, "carrier") - _of(rows, "code"),
            fix=fix,
        )

    def _without_jumps(self, clean: CleanEpoch) -> CleanEpoch:
        """Without the codes that moved since the last epoch otherwise than their Doppler says."""
        n = len(clean.satellites)
        moved = np.full(n, np.nan)
        for i, name in enumerate(clean.satellites):
            t_ns, code, rate = self._codes.get(name, (0, np.nan, np.nan))
            dt = (clean.t_ns - t_ns) / SECOND_NS
            if dt < 3.0 and np.isfinite(clean.rate[i]):
                moved[i] = clean.code[i] - code - (clean.rate[i] + rate) / 2 * dt
            self._codes[name] = clean.t_ns, float(clean.code[i]), float(clean.rate[i])
        known = np.isfinite(moved)
        moved -= np.median(moved[known]) if known.any() else 0.0
        wild = np.abs(moved) > self._settings.selection.max_jump
        return replace(clean, code=np.where(wild, np.nan, clean.code))


def _of(rows: Sequence[Row], name: str) -> F64:
    return np.array([getattr(row, name) for row in rows], float)


def _growth(elevation: F64) -> F64:
    """How multipath (M,) grows from the zenith down."""
    return np.asarray(0.5 + 1.5 * np.exp(-elevation / _LOW))


def _kept_by_mean(times: F64) -> F64:
    """Sigma (M,) of the mean of a Gauss–Markov process of unit sigma over so many of its correlation times."""
    t = np.maximum(times, 1e-3)
    return np.asarray(np.sqrt(2.0 / t * (1.0 - (1.0 - np.exp(-t)) / t)))
