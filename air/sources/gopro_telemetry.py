"""All telemetry of a GoPro's video: payloads, their times in the video, the camera's own IMU and GPS.

A camera's X, Y and Z point left, back and up. That was found on a HERO5: its GYRO follows the flow in its images, its
ACCL the acceleration of the drone that carried it. Later models name the order and the signs of their channels by the
same letters (ORIN). The IMU's stamps are those of its payloads; on that HERO5 they lie 18 ms before the frames'.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from air.sources.gpmf import Series
from air.sources.imported import GEOID_SIGMA
from common.arrays import F64
from common.measurements import FixKind, ImuSample, ReceiverSolution

RECEIVER = "gopro"
HERO5_ORDER = "ZXY"
_BODY_OF = {"X": (1, 1.0), "Y": (0, -1.0), "Z": (2, 1.0)}
"""Row and sign of the camera's axes in `body`."""
MOST_SAMPLES = 1e9
"""A larger count is damaged."""
FARTHEST_S = 2.0
"""How far the steady rate may lead from where a sample's payload lies; two payloads."""
UERE = 3.0
"""m. Error of one range, which the dilution of precision turns into one of position."""
_KINDS = {2: FixKind.FIX_2D, 3: FixKind.FIX_3D}
_Y2K_S = 946_684_800


@dataclass(frozen=True, eq=False)
class Payload:
    """One packet of telemetry: where it lies in the video, s, and the series in it."""

    start_s: float
    duration_s: float
    series: tuple[Series, ...]


@dataclass
class Telemetry:
    """All telemetry of a file. `start_ns` is the GPST of the start of the video."""

    payloads: list[Payload] = field(default_factory=list)
    start_ns: int = 0

    def of(self, key: str, columns: int) -> list[tuple[Payload, Series]]:
        """The series of one key that hold samples of so many columns, in the order of the file."""
        series = ((p, s) for p in self.payloads for s in p.series if s.key == key and len(s.values))
        return [(p, s) for p, s in series if s.values.shape[1] == columns]

    def rows(self, key: str, columns: int) -> list[F64]:
        """The samples (columns,) of these series."""
        return [row for _, series in self.of(key, columns) for row in series.values]


def sample_times(series: list[tuple[Payload, Series]]) -> F64:
    """Times (N,) s in the video of the samples of one key, at the steady rate that fits the payloads best.

    A payload holds what was measured while it lasted, and TSMP counts the samples up to its end. Where no line fits,
    samples are spread evenly over their payload.
    """
    counts = [len(s.values) for _, s in series]
    spread = [p.start_s + p.duration_s * np.arange(n) / n for (p, _), n in zip(series, counts, strict=True)]
    evenly = np.concatenate([np.zeros(0), *spread])
    ends_s = np.array([p.start_s + p.duration_s for p, _ in series])
    totals = np.array([_number(s, "TSMP") for _, s in series])
    sound = np.isfinite(totals).all() and np.all(np.diff(totals) > 0) and totals[-1:].sum() < MOST_SAMPLES
    full = np.array(counts) > 0.9 * np.median(counts or [0])  # the last is not, but lasts as long as the others
    if full.sum() < 3 or not sound:
        return evenly
    period_s, start_s = np.polyfit(totals[full], ends_s[full], 1)
    indices = [total + np.arange(-n, 0) for total, n in zip(totals, counts, strict=True)]
    steady = np.asarray(start_s + period_s * np.concatenate(indices))
    return steady if np.abs(steady - evenly).max() < FARTHEST_S else evenly


def imu_samples(telemetry: Telemetry) -> Iterator[ImuSample]:
    """Samples at the gyro's rate, the acceleration interpolated to it, in `body` at the camera: forward is its view."""
    gyro, accel = telemetry.of("GYRO", 3), telemetry.of("ACCL", 3)
    if not gyro or not accel:
        return
    times_s, accel_s = sample_times(gyro), sample_times(accel)
    gyro_body, accel_body = (np.concatenate([to_body(s) for _, s in part]) for part in (gyro, accel))
    accel_there = np.stack([np.interp(times_s, accel_s, accel_body[:, i]) for i in range(3)], axis=1)
    for t_s, a, w in zip(times_s, accel_there, gyro_body, strict=True):
        if np.isfinite(a).all() and np.isfinite(w).all():
            yield ImuSample(telemetry.start_ns + round(t_s * 1e9), accel=a, gyro=w)


def to_body(series: Series) -> F64:
    """Samples (N, 3) in `body`, by the order and signs of the channels; a small letter is a negated axis."""
    order = series.texts.get("ORIN", HERO5_ORDER)
    order = order if sorted(order.upper()) == ["X", "Y", "Z"] else HERO5_ORDER
    body = np.empty_like(series.values)
    for channel, axis in enumerate(order):
        row, sign = _BODY_OF[axis.upper()]
        body[:, row] = (sign if axis.isupper() else -sign) * series.values[:, channel]
    return body


def solutions(telemetry: Telemetry) -> Iterator[ReceiverSolution]:
    """What the camera's own GPS says (GPS5, later GPS9); these do not tell the direction of motion."""
    gps5, gps9 = telemetry.of("GPS5", 5), telemetry.of("GPS9", 9)
    quality = [(_number(s, "GPSP") / 100, _number(s, "GPSF")) for _, s in gps5 for _ in s.values]
    quality += [(float(row[7]), float(row[8])) for _, s in gps9 for row in s.values]
    sea_level = [s.texts.get("GPSA") == "MSLV" for _, s in gps5 + gps9 for _ in s.values]
    rows = [row for _, s in gps5 + gps9 for row in s.values]
    times_s = np.concatenate([sample_times(gps5), sample_times(gps9)])
    for t_s, row, (dop, kind), at_sea_level in zip(times_s, rows, quality, sea_level, strict=True):
        if np.isfinite([*row, t_s]).all():
            yield ReceiverSolution(
                t_ns=telemetry.start_ns + round(t_s * 1e9),
                receiver=RECEIVER,
                kind=_KINDS.get(int(np.nan_to_num(kind)), FixKind.NONE),
                latitude_deg=float(row[0]),
                longitude_deg=float(row[1]),
                height=float(row[2]),
                sigma_horizontal=UERE * dop,
                sigma_vertical=float(np.hypot(1.5 * UERE * dop, GEOID_SIGMA if at_sea_level else 0.0)),
                v_enu=np.full(3, np.nan),
                sigma_velocity=float("nan"),
                sigma_time=float("nan"),
                satellites=0,
            )


def utc_of_video(telemetry: Telemetry) -> list[float]:
    """Unix time of the start of the video, s, once for each payload in which the camera's GPS had a fix."""
    fixed = [(p, s) for p, s in telemetry.of("GPS5", 5) if _number(s, "GPSF") >= 2]
    starts_s = [_unix_s(s.texts.get("GPSU", "")) - p.start_s for p, s in fixed]
    for payload, series in telemetry.of("GPS9", 9):
        row = series.values[0]
        if row[8] >= 2:
            starts_s.append(float(_Y2K_S + row[5] * 86_400 + row[6] - payload.start_s))
    return starts_s


def _unix_s(text: str) -> float:
    """Unix time of GPSU's `yymmddhhmmss.sss`, NaN where it is none."""
    try:
        return datetime.strptime(text, "%y%m%d%H%M%S.%f").replace(tzinfo=UTC).timestamp()
    except ValueError:
        return float("nan")


def _number(series: Series, key: str) -> float:
    return float(series.numbers.get(key, np.full(1, np.nan))[0])
