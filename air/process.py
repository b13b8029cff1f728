"""A flight in one go: source → odometry → alignment → adjustment → map → files. No bus, no clock in the result."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from operator import length_hint
from pathlib import Path

from tqdm import tqdm

from air.alignment.alignment import Alignment
from air.config import AirConfig
from air.jump import Jump
from air.mapping.mapper import Mapper
from air.odometry_report import Consistency, Told
from air.preparation import prepared
from air.report import Report, Stopwatch, counts, known_cells, peak_memory, problems_of
from air.sources.navigated import Navigated
from air.sources.source import PhotoSource, Source, open_photos
from common.errors import ExportError, SourceError
from common.export.datum import read_datum
from common.export.products import write_products
from common.export.trajectory import read_tum, write_tum
from common.geo import T_world_other
from common.messages import Datum, Keyframe, MapTile

CHUNK = 10
ODOMETRY, TRUTH = "odometry.tum", "truth"


def process(config: AirConfig, url: str, out: Path, quiet: bool = False) -> Report:
    """Map of a source, written as standard files with a report into a folder.

    Raises SourceError when the source cannot be opened or none of its photos could be placed, and ExportError when
    the folder cannot be written to, before any work is done.
    """
    watch, told = Stopwatch(), Told()

    def photos_of(source: Source) -> Navigated:
        return Navigated(source, config.odometry, tell=told.add, stage=watch.stage)

    source = open_photos(url, photos_of=photos_of)
    _make_folder(out)
    alignment = Alignment("offline", config.alignment)
    mapper = Mapper(replace(config.mapping, revisable=False))
    with watch.stage("alignment"):
        _align(source, alignment, mapper, config, quiet)
    with watch.stage("adjustment"):
        keyframes = alignment.finish()
    if alignment.datum is None:
        read = len(alignment.statuses())
        if not read:
            raise SourceError(f"{url}: gives no photos: no camera frames with positions from the air")
        raise SourceError(f"{url}: none of {read} photos could be placed: {_why(alignment, source)}")
    with watch.stage("mapping"):
        tiles = _map(keyframes, mapper, alignment, quiet)
    with watch.stage("export"):
        _write(out, source, alignment.datum, tiles, keyframes)
        _write_odometry(out, told, alignment.datum)
    report = _report(source, alignment, tiles, told, config, watch, out)
    report.write(out / "report.json")
    return report


def _make_folder(out: Path) -> None:
    """Create the folder and prove that it takes files: work of minutes must not end on a full or foreign disk."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise ExportError(f"{out}: cannot be written to ({error.strerror}): choose another folder") from error


def _align(source: PhotoSource, alignment: Alignment, mapper: Mapper, config: AirConfig, quiet: bool) -> None:
    photos = prepared(source, config.alignment)
    index = 0
    for photo in tqdm(photos, "aligning", length_hint(source) or None, unit="photo", disable=quiet):
        if isinstance(photo, Jump):
            alignment.move(photo)
            continue
        alignment.add(photo)
        if photo.image is not None:
            mapper.add_image(index, photo.image)
        index += 1


def _map(keyframes: list[Keyframe], mapper: Mapper, alignment: Alignment, quiet: bool) -> list[MapTile]:
    with tqdm(desc="mapping", total=len(keyframes), unit="photo", disable=quiet) as bar:
        for start in range(0, len(keyframes), CHUNK):
            chunk = keyframes[start : start + CHUNK]
            mapper.place(chunk, alignment.ground_height())
            bar.update(len(chunk))
    return mapper.fuse(alignment.flight)


def _write(out: Path, source: PhotoSource, datum: Datum, tiles: list[MapTile], keyframes: list[Keyframe]) -> None:
    write_products(out, datum, tiles, keyframes)
    if source.truth is not None:
        source.truth.write(out / TRUTH)


def _write_odometry(out: Path, told: Told, datum: Datum) -> None:
    """Write the odometry's own trajectory of the body, in the world of the map."""
    if told.datum is not None and len(told.poses):
        T = T_world_other(datum, told.datum)
        write_tum(out / ODOMETRY, told.poses.t_ns, (T @ T_world_body for T_world_body in told.poses))


def _against_truth(told: Told, out: Path) -> Consistency | None:
    """The odometry against the truth that was written beside it; None where nothing was told."""
    if not len(told.poses):
        return None
    return told.compare(read_tum(out / TRUTH / "trajectory.tum"), read_datum(out / TRUTH / "datum.json"))


def _why(alignment: Alignment, source: PhotoSource) -> str:
    problems = problems_of(alignment.statuses(), source.problems)
    return "; ".join(f"{p['photo']}: {p['reason']}" for p in problems[:3]) + ("; …" if len(problems) > 3 else "")


def _report(
    source: PhotoSource,
    alignment: Alignment,
    tiles: list[MapTile],
    told: Told,
    config: AirConfig,
    watch: Stopwatch,
    out: Path,
) -> Report:
    cells = known_cells(tiles)
    odometry = source.navigator.odometry if isinstance(source, Navigated) and source.navigator else None
    return Report(
        source=source.url,
        photos=counts(alignment.statuses()),
        problems=problems_of(alignment.statuses(), source.problems),
        cameras=alignment.cameras,
        reprojection_rms_px=alignment.residual_px(),
        tiles=len(tiles),
        cells=cells,
        odometry=None if odometry is None else told.report(odometry),
        odometry_against_truth=_against_truth(told, out) if source.truth is not None else None,
        area_m2=cells * config.mapping.cell**2,
        stages_s={name: round(s, 3) for name, s in watch.stages.items()},
        wall_s=round(watch.total, 3),
        peak_memory_bytes=peak_memory(),
    )
