"""A simulated flight as a recording: what the devices sent and what was made of it, and the truth beside it."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO

from tqdm import tqdm

from air.config import AirConfig
from air.gnss.calendar import to_calendar
from air.recorder import CameraPacker
from air.sensing import STREAM_OF
from air.sources.known import ENDING
from air.sources.simulated.flight_truth import TRUTH, Row
from air.sources.simulated.flown import SimulatedFlight
from air.sources.source import open_source
from common.clock import GPST_MINUS_UTC_NS
from common.errors import ExportError, SourceError
from common.keys import message_key
from common.measurements import CameraFrame, Measurement
from common.recording.writer import RecordingWriter
from common.wire import encode


def simulate(config: AirConfig, url: str, out: Path, truth: Path | None = None, quiet: bool = True) -> int:
    """How many measurements were recorded into the new file `out`; its calibration is written beside it.

    `truth` is a folder for the truth as files. The same URL and settings give the same bytes. Raises SourceError for a
    source that is no simulated flight, ExportError when a file cannot be written or is there already.
    """
    flight = open_source(url)
    if not isinstance(flight, SimulatedFlight):
        raise SourceError(f"source {url!r} is no simulated flight; use sim:playground?duration=60 or the like")
    try:
        with out.open("xb") as file:
            count = record_flight(flight, file, config, quiet=quiet)
        flight.known.write(out.with_suffix(ENDING))
        if truth is not None:
            flight.truth.write(truth)
    except FileExistsError as error:
        raise ExportError(f"{out}: is there already; remove it or name another file") from error
    except OSError as error:
        raise ExportError(f"{error.filename or out}: cannot be written: {error.strerror}") from error
    return count


def record_flight(
    flight: SimulatedFlight, file: BinaryIO, config: AirConfig, truth: bool = True, quiet: bool = True
) -> int:
    """How many measurements of a flight were written as a recording, with the truth or without. Raises OSError."""
    writer = RecordingWriter(file, _about(flight, config.vehicle), config.recorder.readable)
    packer, log_ns, count = CameraPacker(config.recorder), flight.aircraft.start_ns, 0
    rows = flight.truth.rows() if truth else iter(())
    row = next(rows, None)
    for measurement in _flown(flight, quiet):
        log_ns = max(log_ns, measurement.t_ns)  # when it came, or when what came before it did
        row = _write_until(log_ns, row, rows, writer)
        stream = STREAM_OF[type(measurement)]
        if stream.name not in config.recorder.leave_out:
            payload = encode(measurement)
            payload = packer.pack(payload) if isinstance(measurement, CameraFrame) else payload
            writer.add(message_key(config.vehicle, stream, measurement), payload, log_ns)
            count += 1
    _write_until(None, row, rows, writer)
    writer.close()
    return count


def _flown(flight: SimulatedFlight, quiet: bool) -> Iterator[Measurement]:
    """The measurements of a flight, with a bar that shows its seconds; on terminals only."""
    with tqdm(total=flight.aircraft.options.duration, unit=" s", leave=False, disable=True if quiet else None) as bar:
        for heard in flight.heard():
            bar.update(round(heard.t_s - bar.n, 1))
            yield from heard.measurements


def _write_until(t_ns: int | None, row: Row | None, rows: Iterator[Row], writer: RecordingWriter) -> Row | None:
    """The first row of the truth after `t_ns`; those before it are written."""
    while row is not None and (t_ns is None or row.t_ns <= t_ns):
        writer.add_row(f"{TRUTH}/{row.table}", row.values, row.t_ns)
        row = next(rows, None)
    return row


def _about(flight: SimulatedFlight, vehicle: str) -> dict[str, str]:
    start_ns = flight.aircraft.start_ns
    return {
        "vehicle": vehicle,
        "software": f"luojia {version('luojia')}",
        "source": flight.url,
        "start": to_calendar(start_ns - GPST_MINUS_UTC_NS).strftime("%Y%m%dT%H%M%SZ"),
        "start_t_ns": str(start_ns),
        "time": "GPST: ns since 1970-01-01 without leap seconds",
    }
