"""A segment of the data set comma2k19, opened as `comma2k19:DIR[,NAV…]`: u-blox M8 raw GNSS and a phone's IMU.

Source: the data set's README (Schafer et al., A Commute in Data, arXiv:1812.05752). Its stamps count from the phone's
start; `global_pose/frame_gps_times` tells what GPST that is. The IMU's axes are forward, right and down there; here y
and z are turned, to `body`. The reference poses are left alone: they are the truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from air.gnss.gnss_time import from_week
from air.gnss.precise_orbit import fit_ephemeris, read_sp3
from air.gnss.rinex_navigation import read_navigation
from air.gnss.signals import LIGHT, frequency
from air.sources.imported import Faults, Imported, in_time_order
from air.sources.rinex import kind_of, lines_of
from air.sources.source import Sensed
from common.arrays import F64
from common.errors import SourceError
from common.measurements import GnssEpoch, ImuSample

RECEIVER = "gnss"
_SIGNAL = "1C"
_FLU_FRD = np.array([1.0, -1.0, -1.0])
_GNSS_COLUMNS = 8


def open_comma2k19(url: str, rest: str) -> Imported:
    """What the satellites broadcast, then epochs and IMU samples by time.

    The data set holds no ephemerides. They come from RINEX navigation files named in the URL, or else are fitted to
    the SP3 files in the folder or the one above it; without either the epochs come alone. `DIR` holds `GNSS` and
    `IMU`, itself or in its `processed_log` or `segment`. Raises SourceError for a folder without raw GNSS.
    """
    names = rest.split(",")
    folder = Path(names[0]).expanduser()
    root = next((folder / sub for sub in ("", "processed_log", "segment") if (folder / sub / "GNSS").is_dir()), None)
    if root is None:
        raise SourceError(f"source {url!r}: {str(folder)!r} holds no folder GNSS; name one of the segments")
    gnss = _load(url, root / "GNSS" / "raw_gnss_ublox" / "value", _GNSS_COLUMNS)
    navigation = [Path(name).expanduser() for name in names[1:] if name]
    for path in navigation:
        if kind_of(url, path) != "N":
            raise SourceError(f"source {url!r}: {str(path)!r} is no navigation file; name those of the day")
    orbits = [] if navigation else sorted({*folder.glob("*.sp3*"), *folder.resolve().parent.glob("*.sp3*")})
    imu = list(_imu(url, root)) if (root / "IMU").is_dir() else []
    epochs = [_epoch(rows) for rows in _by_time(gnss)]

    def read(faults: Faults) -> Iterator[Sensed]:
        for path in navigation:
            with lines_of(path, faults) as lines:
                yield from read_navigation(lines)
        for path in orbits if epochs else ():
            with lines_of(path, faults) as lines:
                gps = [orbit for orbit in read_sp3(lines) if orbit.satellite[0] == "G"]
            fitted = (fit_ephemeris(orbit, epochs[0].t_ns) for orbit in gps)
            yield from (ephemeris for ephemeris in fitted if ephemeris is not None)
        yield from in_time_order(epochs, imu)

    return Imported(url, read)


def _load(url: str, path: Path, columns: int) -> F64:
    """Rows (N, ≥ `columns`) of an array file; a plain list is one column."""
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise SourceError(f"source {url!r}: {str(path)!r} is no array that NumPy can read: {error}") from error
    table = array[:, None] if array.ndim == 1 else array
    if table.ndim != 2 or table.shape[1] < columns or table.dtype.kind not in "fiu":
        raise SourceError(f"source {url!r}: {str(path)!r} has the shape {array.shape}, not (N, {columns} or more)")
    return np.asarray(table, np.float64)


def _imu(url: str, root: Path) -> Iterator[ImuSample]:
    """Samples by time, in `body`; the gyro is the one that the phone did not correct."""
    places = (root / "global_pose", root.parent / "global_pose", root.parent / "global_pos")
    pose = next((place for place in places if place.is_dir()), places[0])
    boot_s = _load(url, pose / "frame_times", 1)[:, 0]
    week, seconds = _load(url, pose / "frame_gps_times", 2)[:, :2].T
    accel_s = _load(url, root / "IMU" / "accelerometer" / "t", 1)[:, 0]
    accel = _load(url, root / "IMU" / "accelerometer" / "value", 3)[:, :3] * _FLU_FRD
    gyro_s = _load(url, root / "IMU" / "gyro_uncalibrated" / "t", 1)[:, 0]
    gyro = _load(url, root / "IMU" / "gyro_uncalibrated" / "value", 3)[:, :3] * _FLU_FRD
    if not len(boot_s) == len(week) > 0 or len(accel) != len(accel_s) or not len(gyro) == len(gyro_s) > 0:
        raise SourceError(f"source {url!r}: the arrays of {str(root / 'IMU')!r} and {str(pose)!r} differ in length")
    offset_s = float(np.median(seconds - boot_s))
    turning = np.column_stack([np.interp(accel_s, gyro_s, column) for column in gyro.T])
    for t_s, force, rate in zip(accel_s.tolist(), accel, turning, strict=True):
        yield ImuSample(from_week(int(week[0]), t_s + offset_s), accel=force, gyro=rate)


def _by_time(table: F64) -> list[F64]:
    """The rows of each epoch, which share week and second."""
    table = table[np.isfinite(table[:, 1:3]).all(axis=1) & np.isin(table[:, 0], list(_SATELLITES))]
    table = table[np.lexsort((table[:, 0], table[:, 2], table[:, 1]))]
    changes = np.flatnonzero((np.diff(table[:, 1:3], axis=0) != 0).any(axis=1)) + 1
    return [rows for rows in np.split(table, changes) if len(rows)]


_SATELLITES = {float(n): f"G{n:02d}" for n in range(1, 33)} | {float(64 + n): f"R{n:02d}" for n in range(1, 28)}
"""By NMEA's numbers, which the data set uses."""


def _epoch(rows: F64) -> GnssEpoch:
    n = len(rows)
    satellites = tuple(_SATELLITES[number] for number in rows[:, 0].tolist())
    channel = np.nan_to_num(rows[:, 3]).astype(np.int32)
    f = np.array([frequency(*row) for row in zip(satellites, (_SIGNAL,) * n, channel.tolist(), strict=True)])
    unknown = np.full(n, np.nan)
    return GnssEpoch(
        t_ns=from_week(int(rows[0, 1]), float(rows[0, 2])),
        receiver=RECEIVER,
        satellites=satellites,
        signals=(_SIGNAL,) * n,
        pseudorange=rows[:, 4],
        carrier_phase=rows[:, 9] if rows.shape[1] > 9 else unknown,
        doppler=-rows[:, 6] * f / LIGHT,
        cn0=rows[:, 8] if rows.shape[1] > 8 else unknown,
        lock_s=unknown,
        half_cycle=np.zeros(n, bool),
        sigma_pseudorange=rows[:, 5],
        sigma_carrier_phase=unknown,
        sigma_doppler=rows[:, 7] * f / LIGHT,
        channel=channel,
    )
