"""A folder in the format of EuRoC and ETH's Autonomous Systems Lab, opened as `euroc:DIR`.

Source: Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016, section 4.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from air.sensors.calibration import Calibration, read_calibration
from air.sources.imported import Faults, Imported, find_folder, in_time_order
from air.sources.source import Sensed
from common.errors import LuojiaError, SourceError
from common.measurements import CameraFrame, Encoding, ImuSample

LONGEST_LINE = 4096
"""No line of these tables is near as long; a file without line ends is not read into memory."""


def open_euroc(url: str, rest: str) -> Imported:
    """IMU samples and frames of the cameras, by time; ground truth in the folder is left alone.

    Stamps are those of the files: the clock of the recording computer, which the ground truth shares. The IMU's
    frame is the `body` of the recording, as `imu0/sensor.yaml` defines it. Raises SourceError for a folder without
    IMU and cameras.
    """
    folder = find_folder(url, rest)
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    imu = [path for path in (root / "imu0" / "data.csv",) if path.is_file()]
    cameras = sorted(path.parent for path in root.glob("cam*/data.csv") if path.is_file())
    if not imu and not cameras:
        raise SourceError(f"source {url!r}: {str(root)!r} holds neither imu0/data.csv nor cam0/data.csv")
    calibrations, no_calibration = _calibrations(cameras)

    def read(faults: Faults) -> Iterator[Sensed]:
        for camera, why in no_calibration.items():
            faults.add(camera, why)
        return in_time_order(*(_imu_samples(p, faults) for p in imu), *(_frames(p, faults) for p in cameras))

    return Imported(url, read, calibrations)


def _calibrations(cameras: list[Path]) -> tuple[dict[str, Calibration], dict[str, str]]:
    """The calibrations of the cameras by name, and for the others why there is none."""
    known, unknown = {}, {}
    for path in cameras:
        try:
            known[path.name] = read_calibration(path / "sensor.yaml")
        except LuojiaError as error:
            unknown[path.name] = str(error)
    return known, unknown


def _imu_samples(path: Path, faults: Faults) -> Iterator[ImuSample]:
    for t_ns, fields in _rows(path, 7, faults):
        try:
            values = np.array([float(text) for text in fields])
        except ValueError:
            values = np.full(6, np.nan)
        if np.isfinite(values).all():
            yield ImuSample(t_ns, accel=values[3:], gyro=values[:3])
        else:
            faults.add("imu0/data.csv", "a row does not hold six numbers; left out", f"at {t_ns}")


def _frames(folder: Path, faults: Faults) -> Iterator[CameraFrame]:
    camera = folder.name
    for index, (t_ns, (name,)) in enumerate(_rows(folder / "data.csv", 2, faults)):
        try:
            png = (folder / "data" / Path(name.strip()).name).read_bytes()
            width, height = png_size(png)
        except (OSError, ValueError) as error:
            faults.add(camera, f"a frame is no readable PNG ({type(error).__name__})", name.strip()[:80])
            continue
        yield CameraFrame(t_ns, camera, index, width, height, Encoding.PNG, png)


def png_size(png: bytes) -> tuple[int, int]:
    """Width and height of a PNG in px, from its header. Raises ValueError for other bytes (PNG, 11.2.2)."""
    if len(png) < 33 or png[:8] != b"\x89PNG\r\n\x1a\n" or png[12:16] != b"IHDR":
        raise ValueError("no PNG header")
    width, height = struct.unpack(">II", png[16:24])
    return int(width), int(height)


def _rows(path: Path, columns: int, faults: Faults) -> Iterator[tuple[int, list[str]]]:
    """Stamp and the other fields of each row of a table; rows that are not whole are counted and left out."""
    name = f"{path.parent.name}/{path.name}"
    try:
        with path.open(encoding="utf-8", errors="replace", newline="") as file:
            for line in iter(partial(file.readline, LONGEST_LINE), ""):
                if line.startswith("#") or not line.strip():
                    continue
                fields = line.rstrip("\r\n").split(",")
                if len(fields) == columns and fields[0].strip().isdecimal() and len(fields[0]) < 20:
                    yield int(fields[0]), fields[1:]
                else:
                    faults.add(name, "a row is not whole; left out", repr(line[:40]))
    except OSError as error:
        faults.add(name, f"cannot be read to its end: {error.strerror}")
