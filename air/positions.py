"""Positions of all epochs of a source, as a table of comma-separated values and in a few words."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from air.gnss.calendar import to_calendar
from air.gnss.ephemerides import Ephemerides
from air.gnss.positioning import PointPosition, Refused, find_position
from air.gnss.settings import PositioningSettings
from air.odometry.carrier_smoothing import CarrierSmoother
from air.sources.source import Sensed
from common.arrays import F64
from common.errors import ExportError
from common.geo import T_ecef_enu, ecef_to_geodetic
from common.measurements import GnssEpoch
from common.messages import Datum

COLUMNS = (
    *("gpst", "t_ns", "receiver", "latitude_deg", "longitude_deg", "height_m"),
    *("sigma_east_m", "sigma_north_m", "sigma_up_m"),
    *("v_east_mps", "v_north_mps", "v_up_mps", "sigma_v_east_mps", "sigma_v_north_mps", "sigma_v_up_mps"),
    *("clock_s", "drift", "satellites", "rejected", "pdop", "refused"),
)
Outcome = PointPosition | Refused


def find_positions(
    items: Iterable[Sensed], settings: PositioningSettings, broadcast: Ephemerides | None = None
) -> Iterator[tuple[GnssEpoch, Outcome]]:
    """Each epoch with its position, from what was broadcast until then, which `broadcast` keeps."""
    broadcast = Ephemerides() if broadcast is None else broadcast
    last: dict[str, F64] = {}
    for item in items:
        broadcast.add(item)
        if isinstance(item, GnssEpoch):
            outcome = find_position(item, broadcast, settings, last.get(item.receiver))
            if isinstance(outcome, PointPosition):
                last[item.receiver] = outcome.position
            yield item, outcome


def find_smooth_positions(
    items: Iterable[Sensed], settings: PositioningSettings
) -> Iterator[tuple[GnssEpoch, Outcome]]:
    """Each epoch with its position, joined to the others by carrier phase; all at the end, for each tells of all."""
    broadcast = Ephemerides()
    smoothers: dict[str, CarrierSmoother] = {}
    single = []
    for epoch, outcome in find_positions(items, settings, broadcast):
        single.append((epoch, outcome))
        if isinstance(outcome, PointPosition):
            smoother = smoothers.setdefault(epoch.receiver, CarrierSmoother(broadcast, settings))
            smoother.add(epoch, outcome)
    smooth = {receiver: iter(smoother.smoothed()) for receiver, smoother in smoothers.items()}
    for epoch, outcome in single:
        yield epoch, next(smooth[epoch.receiver]) if isinstance(outcome, PointPosition) else outcome


def write_positions(path: Path, outcomes: Iterable[tuple[GnssEpoch, Outcome]]) -> list[Outcome]:
    """The outcomes, after a row for each has been written. Raises ExportError where the file cannot be written."""
    passed = []
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            table = csv.writer(file)
            table.writerow(COLUMNS)
            for epoch, outcome in outcomes:
                table.writerow(_row(epoch, outcome))
                passed.append(outcome)
    except OSError as error:
        raise ExportError(f"{str(path)!r} cannot be written: {error.strerror}") from error
    return passed


def in_words(outcomes: list[Outcome]) -> list[str]:
    """Lines that sum up what became of the epochs: how many, where, how sure, and why others were refused."""
    found = [outcome for outcome in outcomes if isinstance(outcome, PointPosition)]
    lines = [f"{len(found)} of {len(outcomes)} epochs gave a position"]
    if found:
        middle = np.median([fix.position for fix in found], axis=0)
        latitude, longitude, height = ecef_to_geodetic(middle)
        satellites = [len(fix.used) for fix in found]
        sigma = [np.sqrt(np.trace(fix.covariance)) for fix in found]
        lines.append(f"median at {latitude:.7f}°, {longitude:.7f}°, {height:.1f} m above the ellipsoid")
        lines.append(f"median of {np.median(satellites):.0f} satellites, one sigma of {np.median(sigma):.1f} m")
        speeds = [float(np.linalg.norm(fix.velocity)) for fix in found if np.isfinite(fix.velocity).all()]
        if speeds:
            lines.append(f"velocity of {len(speeds)} epochs, median speed {np.median(speeds):.2f} m/s")
    refused = Counter(outcome.reason.partition(":")[0] for outcome in outcomes if isinstance(outcome, Refused))
    return lines + [f"{count} refused: {reason}" for reason, count in refused.most_common()]


def _row(epoch: GnssEpoch, outcome: Outcome) -> list[str]:
    start = [f"{to_calendar(epoch.t_ns):%Y-%m-%dT%H:%M:%S.%f}", str(epoch.t_ns), epoch.receiver]
    if isinstance(outcome, Refused):
        satellites = len(set(epoch.satellites)) - len(outcome.rejected)
        blank = [""] * (len(COLUMNS) - len(start) - 4)
        return [*start, *blank, str(satellites), _rejections(outcome.rejected), "", outcome.reason]
    latitude, longitude, height = ecef_to_geodetic(outcome.position).tolist()
    R_ecef_enu = T_ecef_enu(Datum("", latitude, longitude, height)).R
    velocity = R_ecef_enu.T @ outcome.velocity
    sigma, sigma_v = (
        np.sqrt(np.diag(R_ecef_enu.T @ covariance @ R_ecef_enu))
        for covariance in (outcome.covariance, outcome.velocity_covariance)
    )
    return [
        *start,
        *(f"{latitude:.9f}", f"{longitude:.9f}", f"{height:.4f}"),
        *(_number(value, 3) for value in (*sigma, *velocity, *sigma_v)),
        *(f"{next(iter(outcome.clocks.values())):.12f}", _number(outcome.drift, 12)),
        *(str(len(outcome.used)), _rejections(outcome.rejected), f"{outcome.pdop:.2f}", ""),
    ]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else ""


def _rejections(rejected: dict[str, str]) -> str:
    return "; ".join(f"{satellite} {reason}" for satellite, reason in sorted(rejected.items()))
