"""Any flight as files that OpenVINS, GICI-LIB, RTKLIB and their like read: EuRoC, RINEX, TUM and calibrations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from tqdm import tqdm

from air.conversion.calibrations import kalibr_cameras, kalibr_imu
from air.conversion.euroc import EurocWriter
from air.gnss.rinex_export import export_rinex
from air.sources.known import Known, read_known
from air.sources.recorded import RecordedSource
from air.sources.simulated.flight_truth import Row, pose_of, recorded_states
from air.sources.simulated.flown import SimulatedFlight
from air.sources.source import Problem, Sensed, Source, open_source
from common.errors import ExportError
from common.export.trajectory import tum_line
from common.measurements import (
    CameraFrame,
    GlonassEphemeris,
    GnssEpoch,
    ImuSample,
    Ionosphere,
    KeplerEphemeris,
    Measurement,
)

EUROC, RINEX = "euroc", "rinex"
FORMATS = (EUROC, RINEX)


@dataclass(frozen=True)
class Converted:
    """How much was written by kind, and what was wrong on the way."""

    counts: Counter[str]
    problems: tuple[Problem, ...]


def convert(url: str, formats: str, out: Path, calibration: Path | None = None, quiet: bool = True) -> Converted:
    """Write a flight into a folder, which is created, in formats such as `euroc+rinex`.

    euroc: `mav0/…`, Kalibr's `kalibr/camchain.yaml` and `kalibr/imu.yaml`, and with a known truth `truth.tum` and
    `mav0/state_groundtruth_estimate0`. rinex: `rinex/gnss.obs`, `rinex/base.obs`, `rinex/broadcast.nav`. `calibration`
    is a folder as `simulate` writes it; what lies beside a recording is found without. Raises SourceError, ConfigError
    and ExportError.
    """
    wanted = formats.split("+")
    if not set(wanted) <= set(FORMATS):
        raise ExportError(f"format {formats!r} is unknown; allowed: {', '.join(FORMATS)}, joined by +")
    source = open_source(url)
    known = read_known(calibration) if calibration else _known(source)
    counts: Counter[str] = Counter()
    try:
        out.mkdir(parents=True, exist_ok=True)
        with EurocWriter(out) as euroc:
            passing = tqdm(source, unit=" messages", leave=False, disable=True if quiet else None)
            rest = _sensed(passing, euroc if EUROC in wanted else None, known, counts)
            if RINEX in wanted:
                positions = {} if known.p_base_ecef is None else {"base": tuple(known.p_base_ecef.tolist())}
                export_rinex(rest, out / RINEX, positions)
            else:
                counts["passed over"] = sum(1 for _ in rest)
            if EUROC in wanted:
                counts["true states"] = _write_truth(_true_states(source), euroc, out)
                _write_kalibr(euroc, known, out / "kalibr")
    except OSError as error:
        raise ExportError(f"{error.filename or out}: cannot be written: {error.strerror}") from error
    return Converted(counts, (*source.problems, *euroc.problems))


def _sensed(
    items: Iterable[Sensed], euroc: EurocWriter | None, known: Known, counts: Counter[str]
) -> Iterator[Measurement]:
    """The measurements of GNSS; those of IMU and cameras are written on the way."""
    for item in items:
        match item:
            case ImuSample() if euroc is not None:
                counts["IMU samples"] += 1
                euroc.add_sample(item)
            case CameraFrame() if euroc is not None:
                counts["frames"] += 1
                euroc.add_frame(item, known.cameras.get(item.camera))
            case GnssEpoch():
                counts[f"epochs of {item.receiver}"] += 1
                yield item
            case KeplerEphemeris() | GlonassEphemeris() | Ionosphere():
                counts["navigation messages"] += 1
                yield item
            case _:
                pass


def _known(source: Source) -> Known:
    """What comes with a source: all of a simulated or recorded flight, cameras alone of a folder."""
    known: Known | None = getattr(source, "known", None)
    return Known(getattr(source, "calibrations", {})) if known is None else known


def _true_states(source: Source) -> Iterator[Row]:
    if isinstance(source, SimulatedFlight):
        return source.truth.states()
    return recorded_states(source.path) if isinstance(source, RecordedSource) else iter(())


def _write_truth(states: Iterator[Row], euroc: EurocWriter, out: Path) -> int:
    """How many states were written; without any there are no files."""
    first = next(states, None)
    if first is None:
        return 0
    count = 0
    with (out / "truth.tum").open("w", encoding="ascii") as tum:
        for state in chain([first], states):
            tum.write(tum_line(state.t_ns, pose_of(state)))
            euroc.add_truth(state)
            count += 1
    return count


def _write_kalibr(euroc: EurocWriter, known: Known, folder: Path) -> None:
    cameras = {name: known.cameras[camera] for camera, name in euroc.cameras.items() if camera in known.cameras}
    folder.mkdir(exist_ok=True)
    (folder / "imu.yaml").write_text(kalibr_imu(), encoding="utf-8")
    if cameras:
        (folder / "camchain.yaml").write_text(kalibr_cameras(cameras), encoding="utf-8")
