"""A flight's GNSS as a folder of RINEX files: observations of each receiver, and all that was broadcast."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from air.gnss.rinex_writer import write_navigation, write_observations
from common.errors import ExportError
from common.measurements import GlonassEphemeris, GnssEpoch, Ionosphere, KeplerEphemeris

NAVIGATION = "broadcast.nav"


def export_rinex(
    measurements: Iterable[object], folder: Path, positions: Mapping[str, tuple[float, float, float]] | None = None
) -> list[Path]:
    """The files written: `{receiver}.obs` of each receiver, `broadcast.nav` where anything was broadcast.

    Other measurements are passed over. `positions` (m, ECEF) of antennas that are known go into the headers, by
    receiver. An epoch takes some 10 kB of memory until the end. Raises ExportError when a file cannot be written.
    """
    epochs: dict[str, list[GnssEpoch]] = {}
    broadcast: dict[KeplerEphemeris | GlonassEphemeris | Ionosphere, None] = {}
    for measurement in measurements:
        if isinstance(measurement, GnssEpoch):
            epochs.setdefault(measurement.receiver, []).append(measurement)
        elif isinstance(measurement, KeplerEphemeris | GlonassEphemeris | Ionosphere):
            broadcast[measurement] = None
    written = []
    path = folder / NAVIGATION
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for receiver, rows in sorted(epochs.items()):
            path = folder / f"{receiver}.obs"
            with path.open("w", encoding="ascii") as file:
                write_observations(file, rows, position=(positions or {}).get(receiver, (0.0, 0.0, 0.0)))
            written.append(path)
        if broadcast:
            path = folder / NAVIGATION
            with path.open("w", encoding="ascii") as file:
                write_navigation(file, broadcast)
            written.append(path)
    except OSError as error:
        raise ExportError(f"{path}: cannot be written: {error.strerror}") from error
    return written
