"""What is true of a simulated flight: tables of flat rows, told in order of time, and written as files.

No estimator and no mapper reads any of it. In a recording the rows lie on channels `truth/…`, which are no streams.
"""

from __future__ import annotations

import csv
import heapq
import json
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

from air.sources.simulated.aircraft import Aircraft
from air.sources.simulated.gnss.gnss import Observed
from air.sources.simulated.sites.site import Site
from air.sources.simulated.sites.surface import CELL
from common.errors import ExportError
from common.export.datum import write_datum
from common.export.laz import write_points
from common.export.raster import write_dsm
from common.export.surface import Surface
from common.export.trajectory import tum_line
from common.messages import Datum
from common.recording.reader import Recording
from common.se3 import SE3, matrix_to_quaternion

TRUTH = "truth"
"""What stands before the names of the tables in a recording."""
RATE_HZ = 200
CLOUD_SPACING, CLOUD_POINTS = 0.1, 5e6
"""Between points of the true surface, m, as long as there are not more of them than this."""
FLIGHT, STATE, CLOCKS, SATELLITES = "flight", "state", "clocks", "satellites"
_STEP_NS = 1_000_000_000 // RATE_HZ
_SECOND_NS = 1_000_000_000
_VECTORS = ("p_world", "v_world", "a_world", "omega_body", "accel_bias", "gyro_bias")
_COLUMNS = tuple(f"{name}_{axis}" for name in _VECTORS for axis in "xyz")


class Row(NamedTuple):
    """A line of the truth at `t_ns` (GPST): which table, and values by name, SI units unless the name says more."""

    t_ns: int
    table: str
    values: dict[str, float | int | str]


class FlightTruth:
    """The truth of a flight. Rows are computed while they are read."""

    def __init__(self, aircraft: Aircraft):
        self._aircraft = aircraft

    def rows(self) -> Iterator[Row]:
        """What a recording holds: a row with the constants as JSON, then all tables."""
        start_ns = self._aircraft.start_ns
        yield Row(start_ns, FLIGHT, {"t_ns": start_ns, "json": json.dumps(self.constants())})
        yield from self.tables()

    def tables(self) -> Iterator[Row]:
        """All tables, merged in order of time."""
        return heapq.merge(self.states(), self.clocks(), self.satellites(), key=lambda row: row.t_ns)

    def states(self) -> Iterator[Row]:
        """The body in world at 200 Hz, and the biases of the IMU.

        Position, velocity, acceleration and attitude (w first) in world; rates in body axes.
        """
        aircraft = self._aircraft
        imu = aircraft.imu()
        last = int(aircraft.options.duration * RATE_HZ)
        for begin in range(0, last + 1, RATE_HZ):
            k = np.arange(begin, min(begin + RATE_HZ, last + 1))
            motion = aircraft.trajectory.at(k / RATE_HZ)
            biases = imu.biases(k / RATE_HZ)
            vectors = (motion.p_world, motion.v_world, motion.a_world, motion.omega_body, *biases)
            table = np.hstack(vectors).tolist()
            for i, number in enumerate(k.tolist()):
                w, x, y, z = matrix_to_quaternion(motion.R_world_body[i]).tolist()
                q = {"q_world_body_w": w, "q_world_body_x": x, "q_world_body_y": y, "q_world_body_z": z}
                t_ns = aircraft.start_ns + number * _STEP_NS
                yield Row(t_ns, STATE, {"t_ns": t_ns, **dict(zip(_COLUMNS, table[i], strict=True)), **q})

    def clocks(self) -> Iterator[Row]:
        """What each device's clock shows at every full second, s, and by how much it runs too fast, ppm."""
        aircraft = self._aircraft
        for second in range(int(aircraft.options.duration) + 1):
            t_s, t_ns = np.array(float(second)), aircraft.start_ns + second * _SECOND_NS
            values: dict[str, float | int | str] = {"t_ns": t_ns}
            for device, clock in aircraft.clocks.items():
                values[f"{device.name.lower()}_s"] = float(clock.device_s(t_s))
                values[f"{device.name.lower()}_ppm"] = float(clock.rate(t_s)) * 1e6
            yield Row(t_ns, CLOCKS, values)

    def satellites(self) -> Iterator[Row]:
        """Every signal of the first epoch in each second.

        Where its satellite stands, °, the multipath of its code, m, the whole cycles in its phase, and how far the
        receiver's clock is ahead, s.
        """
        aircraft = self._aircraft
        if "gnss" in aircraft.options.off:
            return
        second = -1
        for observed in aircraft.receiver().observations():
            if int(observed.t_s) == second:
                continue
            second = int(observed.t_s)
            t_ns = aircraft.start_ns + round(observed.t_s * _SECOND_NS)
            for i in range(len(observed.epoch.satellites)):
                yield Row(t_ns, SATELLITES, _signal(t_ns, observed, i))

    def constants(self) -> dict[str, object]:
        """What stays the same through the flight: options, extrinsics, intrinsics, matrices of the IMU, offsets."""
        aircraft = self._aircraft
        options, imu = aircraft.options, aircraft.imu()
        return {
            "start_t_ns": aircraft.start_ns,
            "options": asdict(options),
            "T_body_cam": aircraft.extrinsics.T_body_cam.matrix.tolist(),
            "p_body_antenna": aircraft.extrinsics.p_body_antenna.tolist(),
            "p_world_base": aircraft.p_base.tolist(),
            "camera": None if "camera" in options.off else asdict(aircraft.lens),
            "scale_accel": imu.scale_accel.tolist(),
            "scale_gyro": imu.scale_gyro.tolist(),
            "imu_stamp_delay_s": options.imu.delay_s,
        }

    def write(self, folder: Path) -> None:
        """Write the truth as files into a folder, creating it.

        trajectory.tum (body in world), state.csv, clocks.csv, satellites.csv, flight.json, datum.json, and the surface
        as surface.laz and dsm.tif where there is something to see. Raises ExportError when a file cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_datum(folder / "datum.json", self._aircraft.datum)
            text = json.dumps(self.constants(), indent=2) + "\n"
            (folder / "flight.json").write_text(text, encoding="utf-8")
            write_rows(folder, self.tables())
            if self._aircraft.site is not None:
                write_surface(folder, self._aircraft.site, self._aircraft.datum)
        except OSError as error:
            raise ExportError(f"{folder}: the truth cannot be written: {error.strerror}") from error


def write_rows(folder: Path, rows: Iterable[Row]) -> None:
    """Write a table `NAME.csv` of each kind of rows, and the states as trajectory.tum too. Raises OSError."""
    writers: dict[str, csv.DictWriter[str]] = {}
    with ExitStack() as files:
        tum = files.enter_context((folder / "trajectory.tum").open("w", encoding="ascii"))
        for row in rows:
            if row.table not in writers:
                file = files.enter_context((folder / f"{row.table}.csv").open("w", encoding="utf-8", newline=""))
                writers[row.table] = csv.DictWriter(file, list(row.values))
                writers[row.table].writeheader()
            writers[row.table].writerow(row.values)
            if row.table == STATE:
                tum.write(tum_line(row.t_ns, pose_of(row)))


def write_surface(folder: Path, site: Site, datum: Datum) -> None:
    """Write surface.laz, points with their colours, and dsm.tif, 0.125 m; what moves is left out."""
    bounds = site.bounds
    area = (bounds.east - bounds.west) * (bounds.north - bounds.south)
    strips = list(site.cloud(max(CLOUD_SPACING, float(np.sqrt(area / CLOUD_POINTS)))))
    p_world, colour = (np.concatenate([strip[i] for strip in strips]) for i in range(2))
    write_points(folder / "surface.laz", p_world, colour.astype(np.uint8), datum)
    height = site.dsm()
    west, south = site.bounds.west - CELL / 2, site.bounds.south - CELL / 2  # nodes are the middles of cells
    zeros = np.zeros(height.shape, np.uint8)
    blank = np.zeros((*height.shape, 3), np.uint8)
    surface = Surface(CELL, west, south, height, zeros.astype(np.float32), blank, zeros, zeros.astype(bool))
    write_dsm(folder / "dsm.tif", surface, datum)


def recorded_states(path: Path) -> Iterator[Row]:
    """The states of the truth in a recording of a simulated flight; none in any other. Raises SourceError."""
    for recorded in Recording(path).messages(encoding="json"):
        if recorded.key == f"{TRUTH}/{STATE}":
            yield Row(recorded.log_ns, STATE, json.loads(recorded.payload))


def pose_of(row: Row) -> SE3:
    """`T_world_body` of a row of the states."""
    q = [float(row.values[f"q_world_body_{axis}"]) for axis in "wxyz"]
    return SE3.from_quaternion(q, [float(row.values[f"p_world_{axis}"]) for axis in "xyz"])


def _signal(t_ns: int, observed: Observed, i: int) -> dict[str, float | int | str]:
    return {
        "t_ns": t_ns,
        "satellite": observed.epoch.satellites[i],
        "signal": observed.epoch.signals[i],
        "azimuth_deg": float(np.degrees(observed.azimuth[i])),
        "elevation_deg": float(np.degrees(observed.elevation[i])),
        "multipath": float(observed.multipath[i]),
        "ambiguity": float(observed.ambiguity[i]),
        "clock_s": observed.clock,
        "drift": observed.drift,
    }
