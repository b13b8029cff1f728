"""Single-point position, velocity and clock from the pseudoranges and Dopplers of one epoch.

Weighted least squares, iterated from the centre of the earth, with one receiver clock for each satellite system.
Ranges that contradict the others are excluded one by one, the worst first; an epoch that then still contradicts
itself, or that has too few ranges to notice, is refused. Sources: Misra and Enge, Global Positioning System, 6.1;
error model of RTKLIB 2.4.3, manual E.6; test of residuals: Teunissen and Kleusberg, GPS for Geodesy, 7 (w-test).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.gnss.atmosphere import L1_HZ, TYPICAL, klobuchar, saastamoinen
from air.gnss.ephemerides import Ephemerides
from air.gnss.orbit import EARTH_RATE, geometric_range
from air.gnss.ranges import Ranges, clean_ranges
from air.gnss.settings import PositioningSettings
from air.gnss.signals import LIGHT
from common.arrays import F64, Bool
from common.geo import ecef_to_geodetic
from common.measurements import GnssEpoch, Ionosphere

MAX_ITERATIONS = 20
COARSE_STEP = 1000.0
"""While steps are longer, elevations mean nothing yet: no mask, no atmosphere, equal weights."""
CONVERGED_STEP = 1e-4
_GLONASS_FACTOR = 1.5
_SIGMA_CODE, _SIGMA_BIAS = 0.3, 0.3
_NORMAL_QUANTILE = 3.0902
"""That good residuals exceed once in a thousand times."""


@dataclass(frozen=True, eq=False)
class PointPosition:
    """Where the antenna was at an epoch, with one-sigma honesty.

    `t_ns` is the receiver's time tag; the true GPST is `t_ns` minus the clock. `position` (3,) m and `velocity`
    (3,) m/s in ECEF, the latter NaN where Dopplers were missing or contradictory, with their `covariance` (3, 3)
    and `velocity_covariance`. `clocks` is how far the receiver's clock is ahead of each system's, s; `drift` s/s.
    `used` names the satellites, with `residuals` (N,) m, `azimuth` and `elevation` (N,) rad; `rejected` tells why the
    others were not used, `rejected_rates` names those used whose Doppler was not. `chi_square` has `redundancy`
    degrees of freedom.
    """

    t_ns: int
    position: F64
    covariance: F64
    velocity: F64
    velocity_covariance: F64
    clocks: dict[str, float]
    drift: float
    used: tuple[str, ...]
    residuals: F64
    azimuth: F64
    elevation: F64
    rejected: dict[str, str]
    rejected_rates: tuple[str, ...]
    pdop: float
    chi_square: float
    redundancy: int


@dataclass(frozen=True)
class Refused:
    """Why an epoch gives no position, and why its satellites were not used."""

    t_ns: int
    reason: str
    rejected: dict[str, str]


def find_position(
    epoch: GnssEpoch, broadcast: Ephemerides, settings: PositioningSettings, near: F64 | None = None
) -> PointPosition | Refused:
    """Position of the antenna at an epoch, or why there is none.

    `near` (3,) m, ECEF, saves a few iterations; where it leads nowhere the search starts from nothing.
    """
    ranges = clean_ranges(epoch, broadcast, settings)
    ionosphere = broadcast.ionosphere() or TYPICAL
    fit = _fit(ranges, epoch.t_ns, ionosphere, settings, near)
    if isinstance(fit, str) and near is not None:
        fit = _fit(ranges, epoch.t_ns, ionosphere, settings, None)
    if isinstance(fit, str):
        return Refused(epoch.t_ns, fit, ranges.rejected)
    rejected = ranges.rejected | fit.rejected
    velocity = _fit_velocity(ranges, fit, settings)
    reason = _doubts(fit, velocity, settings)
    if reason:
        return Refused(epoch.t_ns, reason, rejected)
    used = np.flatnonzero(fit.used)
    return PointPosition(
        t_ns=epoch.t_ns,
        position=fit.position,
        covariance=fit.covariance,
        velocity=velocity.velocity,
        velocity_covariance=velocity.covariance,
        clocks={name: bias / LIGHT for name, bias in fit.clocks.items()},
        drift=velocity.drift / LIGHT,
        used=tuple(ranges.satellites[i] for i in used),
        residuals=fit.residuals[used],
        azimuth=fit.azimuth[used],
        elevation=fit.elevation[used],
        rejected=rejected,
        rejected_rates=tuple(ranges.satellites[i] for i in used if not velocity.used[i]),
        pdop=fit.pdop,
        chi_square=fit.chi_square,
        redundancy=fit.redundancy,
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """A converged position; arrays have a row for each range, those not used included."""

    position: F64
    clocks: dict[str, float]
    covariance: F64
    used: Bool
    residuals: F64
    azimuth: F64
    elevation: F64
    rejected: dict[str, str]
    pdop: float
    chi_square: float
    redundancy: int
    excluded: int


def _fit(
    ranges: Ranges, t_ns: int, ionosphere: Ionosphere, settings: PositioningSettings, near: F64 | None
) -> _Fit | str:
    """The position that fits best after outliers were excluded, or why there is none."""
    excluded: dict[int, str] = {}
    clocks: dict[str, float] = {}
    position = np.zeros(3) if near is None else near
    coarse = near is None
    for _ in range(MAX_ITERATIONS + len(ranges.satellites)):
        model = _coarse_model(ranges, position) if coarse else _model(ranges, position, t_ns, ionosphere, settings)
        used = model.above & ~np.isin(np.arange(len(ranges.satellites)), list(excluded))
        groups = sorted({name for name, use in zip(ranges.clock, used, strict=True) if use})
        redundancy = int(used.sum()) - 3 - len(groups)
        if redundancy < 0:
            return f"too few ranges: {used.sum()} for {3 + len(groups)} unknowns"
        H = np.column_stack([-model.line[used], *(_belongs(ranges.clock, used, name) for name in groups)])
        bias = np.array([clocks.get(name, 0.0) for name in ranges.clock])
        v = (ranges.pseudorange - model.expected - bias)[used]
        sigma = model.sigma[used]
        try:
            cofactor = _cofactor(H, sigma)
            step = cofactor @ (H.T @ (v / sigma**2))
        except np.linalg.LinAlgError:
            return "ranges do not determine a position"
        position = position + step[:3]
        clocks = {name: clocks.get(name, 0.0) + d for name, d in zip(groups, step[3:].tolist(), strict=True)}
        length = float(np.linalg.norm(step))
        if not length < 1e9:
            return "the solution diverges"
        if coarse or length >= CONVERGED_STEP:
            coarse = coarse and length > COARSE_STEP
            continue

        v = v - H @ step
        chi_square = float(v / sigma @ (v / sigma))
        if redundancy > 0 and chi_square > chi_square_limit(redundancy) and settings.exclude_outliers:
            worst = _worst(v, sigma, H, cofactor)
            if worst is not None and redundancy - 1 >= settings.min_redundancy + len(excluded) + 1:
                excluded[int(np.flatnonzero(used)[worst])] = f"residual of {v[worst]:.0f} m"
                continue
        return _Fit(
            position=position,
            clocks=clocks,
            covariance=cofactor[:3, :3],
            used=used,
            residuals=ranges.pseudorange - model.expected - np.array([clocks.get(c, np.nan) for c in ranges.clock]),
            azimuth=model.azimuth,
            elevation=model.elevation,
            rejected={
                satellite: excluded.get(i, "below the elevation mask")
                for i, satellite in enumerate(ranges.satellites)
                if not used[i]
            },
            pdop=float(np.sqrt(np.trace(np.linalg.inv(H.T @ H)[:3, :3]))),
            chi_square=chi_square,
            redundancy=redundancy,
            excluded=len(excluded),
        )
    return "the solution does not converge"


def _doubts(fit: _Fit, velocity: _Velocity, settings: PositioningSettings) -> str:
    """Why a converged position is not to be believed, empty when it is."""
    height = float(ecef_to_geodetic(fit.position)[2])
    speed = float(np.linalg.norm(velocity.velocity))
    if fit.redundancy < settings.min_redundancy + fit.excluded:
        return f"nothing to check it with: redundancy {fit.redundancy}, {fit.excluded} ranges excluded"
    if fit.redundancy > 0 and fit.chi_square > chi_square_limit(fit.redundancy):
        return f"ranges contradict each other: χ² {fit.chi_square:.0f} of {fit.redundancy} degrees of freedom"
    if not fit.pdop <= settings.max_pdop:
        return f"poor geometry: PDOP {fit.pdop:.0f}"
    if not settings.min_height <= height <= settings.max_height:
        return f"impossible height: {height:.0f} m"
    if speed > settings.max_speed:
        return f"impossible speed: {speed:.0f} m/s"
    return ""


def chi_square_limit(degrees: int) -> float:
    """What χ² exceeds once in a thousand times; within 3 % (Wilson and Hilferty, 1931)."""
    spread = 2.0 / (9.0 * degrees)
    return float(degrees * (1.0 - spread + _NORMAL_QUANTILE * np.sqrt(spread)) ** 3)


@dataclass(frozen=True, eq=False)
class _Model:
    """What ranges (N,) m should be at a place, but for the receiver's clocks, and how well they are known."""

    expected: F64
    line: F64
    azimuth: F64
    elevation: F64
    sigma: F64
    above: Bool


def _coarse_model(ranges: Ranges, position: F64) -> _Model:
    distance, line = geometric_range(ranges.states.position, position)
    n = len(distance)
    expected = distance - LIGHT * ranges.states.clock
    return _Model(expected, line, np.zeros(n), np.zeros(n), np.ones(n), np.ones(n, bool))


def _model(ranges: Ranges, position: F64, t_ns: int, ionosphere: Ionosphere, settings: PositioningSettings) -> _Model:
    distance, line = geometric_range(ranges.states.position, position)
    geodetic = ecef_to_geodetic(position) * (np.pi / 180, np.pi / 180, 1.0)
    azimuth, elevation = azimuth_elevation(line, geodetic)
    above = elevation >= np.radians(settings.elevation_mask_deg)
    # Satellites below the mask are not used; the models only need an angle that they can bear.
    angle = np.where(above, elevation, np.pi / 2)
    slant = np.maximum(np.sin(angle), np.sin(np.radians(5.0)))
    code = _SIGMA_CODE * np.sqrt(1 + 1 / slant) * np.where(np.array(ranges.clock) == "R", _GLONASS_FACTOR, 1.0)
    delay_t, sigma_t = saastamoinen(geodetic, angle)
    if settings.ionosphere_free:
        delay_i, sigma_i, code = np.zeros_like(distance), np.zeros_like(distance), 3 * code
    else:
        scale = (L1_HZ / ranges.frequency) ** 2
        delay_i, sigma_i = (scale * value for value in klobuchar(ionosphere, t_ns, geodetic, azimuth, angle))
    sigma = np.sqrt(code**2 + _SIGMA_BIAS**2 + ranges.sigma**2 + sigma_i**2 + sigma_t**2)
    return _Model(distance - LIGHT * ranges.states.clock + delay_i + delay_t, line, azimuth, elevation, sigma, above)


def azimuth_elevation(line: F64, geodetic: F64) -> tuple[F64, F64]:
    """Azimuth and elevation (N,) rad of unit vectors (N, 3) in ECEF at a place (3,) of rad, rad, m."""
    lat, lon = geodetic[:2]
    east = line @ np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = line @ np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    up = line @ np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    return np.arctan2(east, north) % (2 * np.pi), np.arcsin(np.clip(up, -1, 1))


def _belongs(clocks: tuple[str, ...], used: Bool, name: str) -> F64:
    return np.array([clock == name for clock, use in zip(clocks, used, strict=True) if use], float)


def _cofactor(H: F64, sigma: F64) -> F64:
    """Covariance of the unknowns. Raises LinAlgError where the rows do not determine them."""
    return np.asarray(np.linalg.inv(H.T @ (H / sigma[:, None] ** 2)), np.float64)


def _worst(v: F64, sigma: F64, H: F64, cofactor: F64) -> int | None:
    """Index of the residual whose removal lowers χ² most (w-test), None where none can be checked by others."""
    left = sigma**2 - np.einsum("ij,jk,ik->i", H, cofactor, H)
    checked = left > 1e-6 * sigma**2
    if not checked.any():
        return None
    return int(np.argmax(np.where(checked, v**2 / np.where(checked, left, 1.0), -1.0)))


@dataclass(frozen=True, eq=False)
class _Velocity:
    velocity: F64
    covariance: F64
    drift: float
    used: Bool


def _fit_velocity(ranges: Ranges, fit: _Fit, settings: PositioningSettings) -> _Velocity:
    """Velocity m/s and clock drift m/s from range rates, after outliers were excluded; NaN where that fails."""
    used = fit.used & np.isfinite(ranges.range_rate)
    p_sat, v_sat = ranges.states.position, ranges.states.velocity
    _, line = geometric_range(p_sat, fit.position)
    turn = EARTH_RATE / LIGHT
    # Range rate is linear in the receiver's velocity; the last two terms are the Sagnac effect's.
    sagnac = turn * (v_sat[:, 1] * fit.position[0] - v_sat[:, 0] * fit.position[1])
    still = np.einsum("ij,ij->i", v_sat, line) + sagnac - LIGHT * ranges.states.drift
    H_all = np.column_stack([-line, np.ones(len(line))])
    H_all[:, 0] += turn * p_sat[:, 1]
    H_all[:, 1] -= turn * p_sat[:, 0]
    excluded = 0
    sigma_all = np.fmax(ranges.sigma_rate, settings.sigma_doppler)
    while (redundancy := int(used.sum()) - 4) >= settings.min_redundancy + excluded:
        H, y, sigma = H_all[used], (ranges.range_rate - still)[used], sigma_all[used]
        try:
            cofactor = _cofactor(H, sigma)
        except np.linalg.LinAlgError:
            break
        x = cofactor @ (H.T @ (y / sigma**2))
        v = y - H @ x
        if v / sigma @ (v / sigma) <= chi_square_limit(max(redundancy, 1)):
            return _Velocity(x[:3], cofactor[:3, :3], float(x[3]), used)
        worst = _worst(v, sigma, H, cofactor)
        if worst is None:
            break
        used[np.flatnonzero(used)[worst]] = False
        excluded += 1
    return _Velocity(np.full(3, np.nan), np.full((3, 3), np.nan), np.nan, np.zeros_like(used))
