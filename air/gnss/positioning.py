"""Single-point position, velocity and clock from the pseudoranges and Dopplers of one epoch.

Weighted least squares, iterated from the centre of the earth, with one receiver clock for each satellite system.
Ranges that contradict the others are excluded one by one, the worst first; an epoch that then still contradicts
itself, or that has too few ranges to notice, is refused. Sources: Misra and Enge, Global Positioning System, 6.1;
error model of RTKLIB 2.4.3, manual E.6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.gnss.atmosphere import L1_HZ, TYPICAL, klobuchar, saastamoinen
from air.gnss.ephemerides import Ephemerides
from air.gnss.least_squares import chi_square_limit, cofactor_of, worst_residual
from air.gnss.orbit import geometric_range
from air.gnss.ranges import Ranges, clean_ranges
from air.gnss.settings import PositioningSettings
from air.gnss.signals import LIGHT
from air.gnss.velocity import PointVelocity, find_velocity
from common.arrays import F64, Bool
from common.geo import ecef_to_geodetic
from common.measurements import GnssEpoch, Ionosphere

MAX_ITERATIONS = 20
COARSE_STEP = 1000.0
"""While steps are longer, elevations mean nothing yet: no mask, no atmosphere, equal weights."""
CONVERGED_STEP = 1e-4
_GLONASS_FACTOR = 1.5
_SIGMA_CODE, _SIGMA_BIAS = 0.3, 0.3


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
    errors = _Errors(ranges, epoch.t_ns, broadcast.ionosphere() or TYPICAL, settings)
    fit = _fit(errors, near)
    if isinstance(fit, str) and near is not None:
        fit = _fit(errors, None)
    if isinstance(fit, str):
        return Refused(epoch.t_ns, fit, ranges.rejected)
    velocity = find_velocity(ranges, fit.used, fit.position, settings)
    rejected = ranges.rejected | _rejected(ranges, fit)
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
    """A converged position; arrays have a row for each range, those not used included.

    `worst` is the range that contradicts the others most, None where others cannot tell; `excluded` maps those that
    were left out to their residuals, m.
    """

    position: F64
    clocks: dict[str, float]
    covariance: F64
    used: Bool
    residuals: F64
    azimuth: F64
    elevation: F64
    pdop: float
    chi_square: float
    redundancy: int
    worst: int | None
    excluded: dict[int, float]


@dataclass(frozen=True, eq=False)
class _Errors:
    """What is needed to model the errors of ranges."""

    ranges: Ranges
    t_ns: int
    ionosphere: Ionosphere
    settings: PositioningSettings


def _fit(errors: _Errors, near: F64 | None) -> _Fit | str:
    """The position that fits best after outliers were excluded, or why there is none."""
    fit = _converge(errors, near, {})
    while isinstance(fit, _Fit) and _contradictory(fit) and errors.settings.exclude_outliers:
        # One range more must stay for each that goes: those that agree shall outnumber those that do not.
        enough = fit.redundancy - 1 >= errors.settings.min_redundancy + len(fit.excluded) + 1
        if fit.worst is None or not enough:
            break
        fit = _converge(errors, fit.position, fit.excluded | {fit.worst: float(fit.residuals[fit.worst])})
    return fit


def _converge(errors: _Errors, near: F64 | None, excluded: dict[int, float]) -> _Fit | str:
    """The weighted least squares position without some of the ranges, or why there is none."""
    ranges = errors.ranges
    allowed = ~np.isin(np.arange(len(ranges.satellites)), list(excluded))
    clocks: dict[str, float] = {}
    position, coarse = (np.zeros(3), True) if near is None else (near, False)
    for _ in range(MAX_ITERATIONS):
        model = _coarse_model(ranges, position) if coarse else _model(errors, position)
        used = model.above & allowed
        groups = sorted({name for name, use in zip(ranges.clock, used, strict=True) if use})
        redundancy = int(used.sum()) - 3 - len(groups)
        if redundancy < 0:
            return f"too few ranges: {used.sum()} for {3 + len(groups)} unknowns"
        H = np.column_stack([-model.line[used], *(_belongs(ranges.clock, used, name) for name in groups)])
        v = (ranges.pseudorange - model.expected - _bias(ranges, clocks))[used]
        sigma = model.sigma[used]
        try:
            cofactor = cofactor_of(H, sigma)
            step = cofactor @ (H.T @ (v / sigma**2))
        except np.linalg.LinAlgError:
            return "ranges do not determine a position"
        position = position + step[:3]
        clocks = {name: clocks.get(name, 0.0) + d for name, d in zip(groups, step[3:].tolist(), strict=True)}
        length = float(np.linalg.norm(step))
        if not length < 1e9:
            return "the solution diverges"
        if not coarse and length < CONVERGED_STEP:
            break
        coarse = coarse and length > COARSE_STEP
    else:
        return "the solution does not converge"

    v = v - H @ step
    worst = worst_residual(v, sigma, H, cofactor)
    return _Fit(
        position=position,
        clocks=clocks,
        covariance=cofactor[:3, :3],
        used=used,
        residuals=ranges.pseudorange - model.expected - _bias(ranges, clocks),
        azimuth=model.azimuth,
        elevation=model.elevation,
        pdop=float(np.sqrt(np.trace(cofactor_of(H, np.ones(len(H)))[:3, :3]))),
        chi_square=float(v / sigma @ (v / sigma)),
        redundancy=redundancy,
        worst=None if worst is None else int(np.flatnonzero(used)[worst]),
        excluded=excluded,
    )


def _contradictory(fit: _Fit) -> bool:
    return fit.redundancy > 0 and fit.chi_square > chi_square_limit(fit.redundancy)


def _rejected(ranges: Ranges, fit: _Fit) -> dict[str, str]:
    """Why ranges were not used, by satellite."""
    reasons = {i: f"residual of {residual:.0f} m" for i, residual in fit.excluded.items()}
    names = enumerate(ranges.satellites)
    return {name: reasons.get(i, "below the elevation mask") for i, name in names if not fit.used[i]}


def _bias(ranges: Ranges, clocks: dict[str, float]) -> F64:
    return np.array([clocks.get(name, 0.0) for name in ranges.clock])


def _doubts(fit: _Fit, velocity: PointVelocity, settings: PositioningSettings) -> str:
    """Why a converged position is not to be believed, empty when it is."""
    height = float(ecef_to_geodetic(fit.position)[2])
    speed = float(np.linalg.norm(velocity.velocity))
    if fit.redundancy < settings.min_redundancy + len(fit.excluded):
        return f"nothing to check it with: redundancy {fit.redundancy}, {len(fit.excluded)} ranges excluded"
    if _contradictory(fit):
        return f"ranges contradict each other: χ² {fit.chi_square:.0f} of {fit.redundancy} degrees of freedom"
    if not fit.pdop <= settings.max_pdop:
        return f"poor geometry: PDOP {fit.pdop:.0f}"
    if not settings.min_height <= height <= settings.max_height:
        return f"impossible height: {height:.0f} m"
    if speed > settings.max_speed:
        return f"impossible speed: {speed:.0f} m/s"
    return ""


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


def _model(errors: _Errors, position: F64) -> _Model:
    ranges, settings = errors.ranges, errors.settings
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
        delay_i, sigma_i = (
            scale * value for value in klobuchar(errors.ionosphere, errors.t_ns, geodetic, azimuth, angle)
        )
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
