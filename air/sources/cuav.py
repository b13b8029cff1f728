"""A folder of images beside a telemetry log, opened as `cuav:DIR`: frames by the UTC in their names, and the log.

That is how CanberraUAV record: `2018080501004480Z.jpg` was taken at 01:00:44.80 UTC.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from PIL import Image

from air.sensors.calibration import Calibration, read_calibration
from air.sources.imported import GEOID_SIGMA, Faults, Imported, find_folder, gpst_of_unix, in_time_order, one_line
from air.sources.mavlink_file import open_mavlink
from air.sources.source import Sensed
from common import ned
from common.counts import Counts
from common.errors import LuojiaError, SourceError
from common.mavlink import Packet, PacketScanner
from common.measurements import CameraFrame, Encoding, FixKind, ImuSample, ReceiverSolution

CAMERA, RECEIVER = "camera", "gps"
CALIBRATIONS = "params*.json"
CHUNK_BYTES = 65_536
G = 9.80665
_NAME = re.compile(r"(\d{14})(\d{0,9})Z?\.jpe?g", re.IGNORECASE)
_FIXES = {2: FixKind.FIX_2D, 3: FixKind.FIX_3D, 4: FixKind.DIFFERENTIAL, 5: FixKind.RTK_FLOAT, 6: FixKind.RTK_FIXED}
_U16_UNKNOWN = 65_535


def open_cuav(url: str, rest: str) -> Imported:
    """Frames as they lie in the folder, and from the log states, IMU samples in `body` and the receiver's solutions.

    The log's stamps are those of its arrival on the ground. Raises SourceError for a folder without such images or
    without a `.tlog`, and for one with several.
    """
    folder = find_folder(url, rest)
    stamped = {path: t_ns for path in sorted(folder.iterdir()) if (t_ns := time_of(path.name)) is not None}
    logs = sorted(folder.glob("*.tlog"))
    if not stamped or len(logs) != 1:
        what = f"{len(stamped)} images named by UTC and {len(logs)} *.tlog"
        raise SourceError(f"source {url!r}: {str(folder)!r} holds {what}; there must be images and one log")
    calibrations, why_not = _calibrations(folder, next(iter(stamped)))
    log = logs[0]

    def read(faults: Faults) -> Iterator[Sensed]:
        for text in why_not:
            faults.add("calibration", text)
        states = open_mavlink(f"mavlink:{log}", str(log))
        yield from in_time_order(_frames(stamped, faults), states, _from_log(log, faults))
        for problem in states.problems:
            faults.add(problem.name, problem.text)

    return Imported(url, read, calibrations)


def time_of(name: str) -> int | None:
    """GPST, ns, of an image by its name, or None for another name."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    try:
        second = datetime.strptime(match[1], "%Y%m%d%H%M%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    return gpst_of_unix(int(second.timestamp()) * 1_000_000_000 + int(match[2].ljust(9, "0")))


def _calibrations(folder: Path, image: Path) -> tuple[dict[str, Calibration], list[str]]:
    """The calibration beside the images, or one folder up, that was made for their size, or why there is none."""
    why_not = []
    try:
        with Image.open(image) as opened:
            size = opened.size
    except Exception as error:  # Pillow raises nearly every built-in exception on damaged headers.
        return {}, [f"{image.name} is no readable image: {one_line(error)}"]
    for path in (*sorted(folder.glob(CALIBRATIONS)), *sorted(folder.parent.glob(CALIBRATIONS))):
        try:
            calibration = read_calibration(path)
        except LuojiaError as error:
            why_not.append(str(error))
            continue
        if (calibration.camera.width, calibration.camera.height) == size:
            return {CAMERA: calibration}, []
    return {}, why_not


def _frames(stamped: dict[Path, int], faults: Faults) -> Iterator[CameraFrame]:
    for index, (path, t_ns) in enumerate(sorted(stamped.items(), key=lambda item: item[1])):
        try:
            jpeg = path.read_bytes()
            with Image.open(io.BytesIO(jpeg)) as opened:
                width, height = opened.size
        except Exception as error:  # as above
            faults.add(path.name, f"is no readable image: {one_line(error)}")
            continue
        yield CameraFrame(t_ns, CAMERA, index, width, height, Encoding.JPEG, jpeg)


def _from_log(log: Path, faults: Faults) -> Iterator[Sensed]:
    """What the log tells beyond the vehicle's state."""
    scanner = PacketScanner(Counts(), tlog=True)
    try:
        with log.open("rb") as file:
            while chunk := file.read(CHUNK_BYTES):
                for packet in scanner.feed(chunk):
                    if packet.t_ns is None:
                        continue
                    if packet.name == "RAW_IMU":
                        yield imu_sample(packet, packet.t_ns)
                    elif packet.name == "GPS_RAW_INT":
                        yield solution(packet, packet.t_ns)
    except OSError as error:
        faults.add(log.name, f"cannot be read to its end: {error.strerror}")


def imu_sample(packet: Packet, t_ns: int) -> ImuSample:
    """The sample of a RAW_IMU message, which ArduPilot fills in milli-g and milliradians per second."""
    m = packet.message
    accel_frd = np.array([m.xacc, m.yacc, m.zacc]) * (G * 1e-3)
    return ImuSample(t_ns, accel=ned.flu(accel_frd), gyro=ned.flu(np.array([m.xgyro, m.ygyro, m.zgyro]) * 1e-3))


def solution(packet: Packet, t_ns: int) -> ReceiverSolution:
    """The receiver's solution in a GPS_RAW_INT message; accuracies of zero are unknown, as are ellipsoidal heights."""
    m = packet.message
    nan, course = float("nan"), np.radians(m.cog / 100)
    moving = m.vel != _U16_UNKNOWN and m.cog != _U16_UNKNOWN
    return ReceiverSolution(
        t_ns=t_ns,
        receiver=RECEIVER,
        kind=_FIXES.get(m.fix_type, FixKind.NONE),
        latitude_deg=m.lat * 1e-7,
        longitude_deg=m.lon * 1e-7,
        height=(m.alt_ellipsoid or m.alt) * 1e-3,
        sigma_horizontal=m.h_acc * 1e-3 or nan,
        sigma_vertical=float(np.hypot(m.v_acc * 1e-3 or nan, 0.0 if m.alt_ellipsoid else GEOID_SIGMA)),
        v_enu=np.array([np.sin(course), np.cos(course), nan]) * (m.vel * 1e-2 if moving else nan),
        sigma_velocity=m.vel_acc * 1e-3 or nan,
        sigma_time=nan,
        satellites=0 if m.satellites_visible == 255 else m.satellites_visible,
    )
