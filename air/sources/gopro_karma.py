"""What a Karma drone adds to the telemetry of its GoPro: attitude, position and receiver at 4 Hz, on its own clock.

The columns are named in the file itself (STNM, UNIT); they are MAVLink's ATTITUDE, GLOBAL_POSITION_INT, GPS_RAW_INT
and SYSTEM_TIME.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from air.sources.gopro_telemetry import Telemetry
from air.sources.imported import GEOID_SIGMA
from common import ned
from common.arrays import F64
from common.measurements import FixKind, ReceiverSolution, VehicleState

DRONE, SYSTEM = "karma", 1
LONGEST_S = 86_400.0
"""Nobody flies for a day: stamps further than this from the drone's start, or from the video's, are damaged."""
_KINDS = {2: FixKind.FIX_2D, 3: FixKind.FIX_3D, 4: FixKind.DIFFERENTIAL, 5: FixKind.RTK_FLOAT, 6: FixKind.RTK_FIXED}


def boot_time_of_video(telemetry: Telemetry) -> float:
    """The drone's time since boot at the start of the video, s; NaN without a drone.

    Its samples reach the camera late by an unknown time, so this is good to some tenths of a second.
    """
    starts_s = [
        row[0] - (payload.start_s + payload.duration_s * i / len(series.values))
        for payload, series in telemetry.of("ATTD", 8)
        for i, row in enumerate(series.values)
        if abs(row[0]) < LONGEST_S
    ]
    return float(np.median(starts_s)) if starts_s else float("nan")


def utc_of_video(telemetry: Telemetry) -> list[float]:
    """Unix time of the start of the video, s, once for each time message of the drone."""
    boot_s = boot_time_of_video(telemetry)
    return [float(row[1] - row[0] + boot_s) for row in telemetry.rows("SYST", 2) if np.isfinite(row).all()]


def solutions(telemetry: Telemetry) -> Iterator[ReceiverSolution]:
    """The drone's GPS; heights are above mean sea level."""
    boot_s = boot_time_of_video(telemetry)
    for row in _sound(telemetry, "GPRI", 10, boot_s):
        _, latitude, longitude, height, eph, epv, speed, course_deg, kind, satellites = (float(x) for x in row)
        course = np.radians(course_deg)
        yield ReceiverSolution(
            t_ns=telemetry.start_ns + round(float(row[0] - boot_s) * 1e9),
            receiver=DRONE,
            kind=_KINDS.get(int(kind), FixKind.NONE),
            latitude_deg=latitude,
            longitude_deg=longitude,
            height=height,
            sigma_horizontal=eph,
            sigma_vertical=float(np.hypot(epv, GEOID_SIGMA)),
            v_enu=np.array([speed * np.sin(course), speed * np.cos(course), np.nan]),
            sigma_velocity=float("nan"),
            sigma_time=float("nan"),
            satellites=int(satellites),
        )


def vehicle_states(telemetry: Telemetry) -> Iterator[VehicleState]:
    """The drone's attitude, each with its latest position."""
    boot_s = boot_time_of_video(telemetry)
    positions = _sound(telemetry, "GLPI", 9, boot_s)
    times_s = np.array([row[0] for row in positions])
    for row in _sound(telemetry, "ATTD", 8, boot_s):
        i = int(np.searchsorted(times_s, row[0], side="right")) - 1
        where = positions[i] if i >= 0 else None
        yield VehicleState(
            t_ns=telemetry.start_ns + round(float(row[0] - boot_s) * 1e9),
            system=SYSTEM,
            q_enu_body=ned.attitude_of_angles(*(float(angle) for angle in row[1:4])),
            latitude_deg=None if where is None else float(where[1]),
            longitude_deg=None if where is None else float(where[2]),
            height_msl=None if where is None else float(where[3]),
            height_home=None if where is None else float(where[4]),
            v_enu=None if where is None else ned.enu(where[5:8]),
        )


def _sound(telemetry: Telemetry, key: str, columns: int, boot_s: float) -> list[F64]:
    """The finite rows of a key whose stamps lie near the video's, in the order of the drone's clock."""
    finite = (row for row in telemetry.rows(key, columns) if np.isfinite(row).all())
    return sorted((row for row in finite if abs(row[0] - boot_s) < LONGEST_S), key=lambda row: float(row[0]))
