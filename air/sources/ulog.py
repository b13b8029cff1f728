"""A log of PX4, opened as `ulog:F.ulg`: IMU, GPS and the state of the vehicle.

Source: PX4 guide, "ULog file format" and the definitions of the messages sensor_combined, vehicle_gps_position
(sensor_gps), vehicle_attitude and others.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pyulog import ULog

from air.sources.imported import Faults, Imported, find_file, gpst_of_unix, in_time_order, one_line
from air.sources.source import Sensed
from common import ned
from common.arrays import F64
from common.errors import SourceError
from common.measurements import FixKind, ImuSample, ReceiverSolution, VehicleState

RECEIVER = "gps"
GPS = ("vehicle_gps_position", "sensor_gps")
"""The same message under its older and its newer name; the first one in a log is read."""
MESSAGES = (
    *("sensor_combined", "vehicle_attitude", "vehicle_global_position", "vehicle_local_position"),
    *("vehicle_status", "battery_status", *GPS),
)
_FIXES = {
    2: FixKind.FIX_2D,
    3: FixKind.FIX_3D,
    4: FixKind.DIFFERENTIAL,
    5: FixKind.RTK_FLOAT,
    6: FixKind.RTK_FIXED,
}
_ARMED = 2

Table = Mapping[str, Any]
"""Columns of one message by name, all equally long, `timestamp` in µs since boot."""


def open_ulog(url: str, rest: str) -> Imported:
    """IMU samples in `body` (at the autopilot), solutions of the receiver, and states with every attitude, by time.

    Stamps are on GNSS time where the log has a GPS with time, and else count from the autopilot's start. Raises
    SourceError for a file that is no ULog.
    """
    path = find_file(url, rest)
    with path.open("rb") as file:
        if file.read(len(ULog.HEADER_BYTES)) != ULog.HEADER_BYTES:
            raise SourceError(f"source {url!r}: {path.name} is no ULog; its first bytes are others")
    return Imported(url, partial(_read, path))


def _read(path: Path, faults: Faults) -> Iterator[Sensed]:
    tables = read_tables(path, faults)
    gps = next((tables[name] for name in GPS if name in tables), None)
    boot_ns = boot_time(gps)
    if boot_ns is None:
        faults.add(path.name, "has no GNSS time; stamps count from the autopilot's start")
    return in_time_order(
        imu_samples(tables.get("sensor_combined"), boot_ns or 0),
        solutions(gps, boot_ns or 0),
        vehicle_states(tables, boot_ns or 0),
    )


def read_tables(path: Path, faults: Faults) -> dict[str, Table]:
    """The messages of a log that are used, by name, sorted by time; the first instance of each."""
    try:
        with redirect_stdout(io.StringIO()):  # pyulog prints what it thinks of a damaged file
            log = ULog(str(path), list(MESSAGES), True)
    except Exception as error:  # on damage, pyulog raises nearly everything
        faults.add(path.name, f"cannot be read: {one_line(error)}")
        return {}
    if log.file_corruption:
        faults.add(path.name, "is damaged; what could be read is here")
    for dropout in log.dropouts:
        faults.add(path.name, "the autopilot lost data while it logged", f"{dropout.duration} ms")
    return {
        data.name: {name: column[order] for name, column in data.data.items()}
        for data in log.data_list
        if data.multi_id == 0 and "timestamp" in data.data
        for order in [np.argsort(data.data["timestamp"], kind="stable")]
    }


def boot_time(gps: Table | None) -> int | None:
    """GPST of the autopilot's start, ns, or None where no GPS tells."""
    if gps is None or "time_utc_usec" not in gps:
        return None
    known = gps["time_utc_usec"] > 1_200_000_000_000_000
    if not known.any():
        return None
    starts_us = gps["time_utc_usec"][known].astype(np.int64) - gps["timestamp"][known].astype(np.int64)
    return gpst_of_unix(int(np.median(starts_us)) * 1000)


def imu_samples(table: Table | None, boot_ns: int) -> Iterator[ImuSample]:
    """Samples of sensor_combined, which are in forward-right-down, in `body`."""
    gyro, accel = _vectors(table, "gyro_rad"), _vectors(table, "accelerometer_m_s2")
    if table is None or gyro is None or accel is None:
        return
    for t_us, a, w in zip(table["timestamp"], ned.flu(accel), ned.flu(gyro), strict=True):
        if np.isfinite(a).all() and np.isfinite(w).all():
            yield ImuSample(boot_ns + int(t_us) * 1000, accel=a, gyro=w)


def solutions(gps: Table | None, boot_ns: int) -> Iterator[ReceiverSolution]:
    """What the receiver said, in both versions of the message: integers in 1e-7° and mm, later degrees and m."""
    if gps is None:
        return
    whole = "lat" in gps
    names = ("lat", "lon", "alt_ellipsoid") if whole else ("latitude_deg", "longitude_deg", "altitude_ellipsoid_m")
    scales = (1e-7, 1e-7, 1e-3) if whole else (1.0, 1.0, 1.0)
    latitude, longitude, height = (_column(gps, name) * scale for name, scale in zip(names, scales, strict=True))
    velocity = np.stack([_column(gps, name) for name in ("vel_n_m_s", "vel_e_m_s", "vel_d_m_s")], axis=1)
    eph, epv, speed_sigma = (_column(gps, name) for name in ("eph", "epv", "s_variance_m_s"))
    fixes, satellites = (np.nan_to_num(_column(gps, name)) for name in ("fix_type", "satellites_used"))
    for i, t_us in enumerate(gps["timestamp"]):
        yield ReceiverSolution(
            t_ns=boot_ns + int(t_us) * 1000,
            receiver=RECEIVER,
            kind=_FIXES.get(int(fixes[i]), FixKind.NONE),
            latitude_deg=float(latitude[i]),
            longitude_deg=float(longitude[i]),
            height=float(height[i]),
            sigma_horizontal=float(eph[i]),
            sigma_vertical=float(epv[i]),
            v_enu=ned.enu(velocity[i]),
            sigma_velocity=float(speed_sigma[i]),
            sigma_time=float("nan"),
            satellites=int(satellites[i]),
        )


def vehicle_states(tables: Mapping[str, Table], boot_ns: int) -> Iterator[VehicleState]:
    """A state for each attitude, with the latest of everything else."""
    attitudes = tables.get("vehicle_attitude")
    if attitudes is None or "q[0]" not in attitudes:
        return
    latest = {name: _Latest(table) for name, table in tables.items()}
    nothing = _Latest({"timestamp": np.zeros(0)})
    where, local, status, battery = (
        latest.get(name, nothing)
        for name in ("vehicle_global_position", "vehicle_local_position", "vehicle_status", "battery_status")
    )
    quaternions = np.stack([_column(attitudes, f"q[{i}]") for i in range(4)], axis=1)
    for t_us, q in zip(attitudes["timestamp"], quaternions, strict=True):
        now = int(t_us)
        velocity = [local.value(name, now) for name in ("vx", "vy", "vz")]
        arming, system = status.value("arming_state", now), status.value("system_id", now)
        yield VehicleState(
            t_ns=boot_ns + now * 1000,
            system=int(system or 1),
            armed=None if arming is None else arming == _ARMED,
            q_enu_body=ned.attitude(q),
            latitude_deg=where.value("lat", now),
            longitude_deg=where.value("lon", now),
            height_msl=where.value("alt", now),
            v_enu=None if None in velocity else ned.enu(np.array(velocity, float)),
            battery=battery.value("remaining", now),
            voltage_v=battery.value("voltage_v", now),
            current_a=battery.value("current_a", now),
        )


class _Latest:
    """The latest value of a column of a table at times that only grow."""

    def __init__(self, table: Table):
        self._table = table
        self._times = table["timestamp"]

    def value(self, name: str, t_us: int) -> float | None:
        """The value at a time, µs since boot; None before the first one, and for what is unknown."""
        row = int(np.searchsorted(self._times, t_us, side="right")) - 1
        if row < 0 or name not in self._table:
            return None
        value = float(self._table[name][row])
        return value if np.isfinite(value) else None


def _vectors(table: Table | None, name: str) -> F64 | None:
    if table is None or f"{name}[0]" not in table:
        return None
    return np.stack([_column(table, f"{name}[{i}]") for i in range(3)], axis=1)


def _column(table: Table, name: str) -> F64:
    """A column as floats; NaN where the log's version of the message has none."""
    with np.errstate(all="ignore"):  # damaged floats are any bit pattern
        return np.asarray(table.get(name, np.full(len(table["timestamp"]), np.nan)), np.float64)
