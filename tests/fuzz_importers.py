"""The readers of other programs' files that are fuzzed: our own parsers, and the libraries behind our boundaries."""

from __future__ import annotations

import tempfile
from pathlib import Path

import gpmf_samples as gpmf
import numpy as np
from bag_samples import write_bag
from log_samples import FORMATS, write_log, write_ulog

from air.sources import gopro_karma, gopro_telemetry
from air.sources.ardupilot import boot_time, sensed
from air.sources.dataflash import LogScanner
from air.sources.gopro_telemetry import Payload, Telemetry
from air.sources.gpmf import read_series
from air.sources.source import open_source
from common.counts import Counts
from common.errors import SourceError


def read_gpmf(data: bytes) -> None:
    """Every use of a GoPro's telemetry, with the bytes as three payloads of a second."""
    series = tuple(read_series(data))
    telemetry = Telemetry([Payload(float(i), 1.0, series) for i in range(3)])
    gopro_telemetry.utc_of_video(telemetry)
    gopro_karma.utc_of_video(telemetry)
    for measurements in (gopro_telemetry, gopro_karma):
        list(measurements.solutions(telemetry))
    list(gopro_telemetry.imu_samples(telemetry))
    list(gopro_karma.vehicle_states(telemetry))


def gpmf_seeds() -> list[bytes]:
    streams = [gpmf.imu_stream(key, np.full((20, 3), 0.5), 20, gpmf.text("ORIN", "YxZ")) for key in ("GYRO", "ACCL")]
    gps = gpmf.table("GPS5", "l", ">i4", [[331_253_680, -1_173_310_640, 15_445, 590, 60]] * 18)
    streams.append(gpmf.nested("STRM", gpmf.item("GPSU", "U", 16, 1, b"170417192757.500"), gps))
    for key, columns in {"ATTD": 8, "GLPI": 9, "GPRI": 10, "SYST": 2, "GPS9": 9}.items():
        types = gpmf.text("TYPE", "f" * columns)
        rows = np.ones((4, columns), ">f4")
        streams.append(gpmf.nested("STRM", types, gpmf.item(key, "?", 4 * columns, 4, rows.tobytes())))
    return [gpmf.payload(*streams)]


def read_dataflash(data: bytes) -> None:
    counts = Counts()
    scanner = LogScanner(frozenset(FORMATS), counts)
    step = 1 + len(data) % 4999
    messages = [m for at in range(0, len(data), step) for m in scanner.feed(data[at : at + step])]
    scanner.close()
    assert counts.received_bytes == len(data)
    assert 0 <= counts.dropped_bytes <= len(data)
    list(sensed(messages, boot_time(messages) or 0))


def dataflash_seeds() -> list[bytes]:
    return [write_log()[:20_000]]


def read_file(scheme: str, data: bytes) -> None:
    """Opens a file of these bytes as a source; it may be refused, in one line, and no more."""
    with tempfile.NamedTemporaryFile(suffix=f".{scheme}") as file:
        file.write(data)
        file.flush()
        refusal = ""
        try:
            for _ in open_source(f"{scheme}:{file.name}"):
                pass
        except SourceError as error:
            refusal = str(error)
        assert "\n" not in refusal


def ulog_seeds() -> list[bytes]:
    return [write_ulog()]


def bag_seeds() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        return [write_bag(Path(folder) / "f.bag", ros1=True).read_bytes()]
