"""Single-point positions of the recordings: against RTKLIB where both give one, against the truth where it is known.

RTKLIB's rnx2rtkp gets the same measurements and the ephemerides that were used, as RINEX, and the same settings: one
band, broadcast ionosphere, Saastamoinen, elevation mask 10°, all systems. "Apart" compares on epochs that both
accept, without our exclusion of outliers; the other columns are ours with its defaults, and RTKLIB's with its own.

python tests/benchmarks/bench_positioning.py
"""

import dataclasses
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from figures import recording

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import rtklib

from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS, to_week
from air.gnss.positioning import PointPosition, find_position
from air.gnss.rinex_writer import write_navigation, write_observations
from air.gnss.settings import PositioningSettings
from air.sources.source import open_source
from common.geo import geodetic_to_ecef
from common.measurements import GnssEpoch, KeplerEphemeris

ALL = "GREJC"


def recordings():
    """Name, URL and truth (a function of GPST in ns to ECEF m) of each recording.

    The antenna of 16dBatt stood still, where is not known: the median of our positions serves.
    """
    gnss, comma = recording("gnss"), recording("comma2k19")
    surveyed = (gnss / "matrtklib_static" / "rover_position.txt").read_text().split()
    antenna = geodetic_to_ecef(*map(float, surveyed))
    pose = comma / "segment" / "global_pose"
    seconds, places = np.load(pose / "frame_gps_times")[:, 1], np.load(pose / "frame_positions")

    def car(t_ns):
        return np.array([np.interp(to_week(t_ns)[1], seconds, column) for column in places.T])

    cold = gnss / "16dBatt_no_interference_coldstart"
    static = gnss / "matrtklib_static"
    yield "nhm (F9P, walking)", f"ubx:{gnss / 'nhm.ubx'}", lambda t_ns: np.full(3, np.nan)
    yield "16dBatt (fading signals)", f"rinex:{cold}.obs.gz,{cold}.nav.gz", None
    yield "matrtklib (static)", f"rinex:{static / 'rover.obs'},{static / 'base.nav'}", lambda t_ns: antenna
    yield "comma2k19 (car)", f"comma2k19:{comma / 'segment'}", car


def main():
    """Print the table."""
    if shutil.which("rnx2rtkp") is None:
        print("skipped: RTKLIB's rnx2rtkp is not installed (Debian: apt install rtklib)")
        return
    head = ("recording", "epochs", "positions", "refused", "RTKLIB's positions", "on both", "apart, most")
    head += ("error, median", "RTKLIB's", "error, most", "RTKLIB's", "µs per epoch")
    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for name, url, truth in recordings():
        print(f"| {' | '.join((name, *figures_of(url, truth)))} |", flush=True)
    print("\nBold: misses the target of 0.1 m. Errors of 16dBatt are distances from the median of our positions.")


def figures_of(url, truth):
    """Cells of one recording."""
    items = list(open_source(url))
    epochs = [item for item in items if isinstance(item, GnssEpoch)]
    broadcast = Ephemerides(items)
    found, spent_s = solve(epochs, broadcast, PositioningSettings())
    theirs, ours = alike(epochs, broadcast)
    apart = [np.linalg.norm(ours[t].position - theirs[t].position) for t in ours.keys() & theirs.keys()]
    middle = np.median([fix.position for fix in found.values()], axis=0)
    truth = truth or (lambda t_ns: middle)
    errors = [np.linalg.norm(fix.position - truth(t - clock_ns(fix))) for t, fix in found.items()]
    their_errors = [np.linalg.norm(fix.position - truth(fix.t_ns)) for fix in theirs.values()]
    worst = max(apart)

    def metres(value, digits=2):
        return f"{value:.{digits}f} m" if np.isfinite(value) else "–"

    return (
        str(len(epochs)),
        str(len(found)),
        str(len(epochs) - len(found)),
        str(len(theirs)),
        str(len(apart)),
        f"{worst:.4f} m" if worst <= 0.1 else f"**{worst:.4f} m**",
        metres(np.median(errors)),
        metres(np.median(their_errors)),
        metres(max(errors), 1),
        metres(max(their_errors), 1),
        f"{spent_s / len(epochs) * 1e6:.0f}",
    )


def solve(epochs, broadcast, settings):
    """Positions by time tag, and the seconds that all took."""
    begun = time.perf_counter()
    outcomes = [find_position(epoch, broadcast, settings) for epoch in epochs]
    spent_s = time.perf_counter() - begun
    return {fix.t_ns: fix for fix in outcomes if isinstance(fix, PointPosition)}, spent_s


def clock_ns(fix):
    """How far the receiver's clock was ahead, ns."""
    return round(next(iter(fix.clocks.values())) * 1e9)


def alike(epochs, broadcast):
    """RTKLIB's positions and ours by time tag, from the same ephemerides and with the same model of errors."""
    used = {broadcast.find(satellite, epoch.t_ns) for epoch in epochs for satellite in set(epoch.satellites)} - {None}
    model = [broadcast.ionosphere()] if broadcast.ionosphere() else []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with (folder / "x.obs").open("w") as file:
            write_observations(file, epochs)
        with (folder / "x.nav").open("w") as file:
            write_navigation(file, [*used, *model])
        solutions = rtklib.single_point(folder, folder / "x.obs", folder / "x.nav", ALL, 10.0)
    settings = PositioningSettings(ALL, 10.0, min_cn0=0.0, exclude_outliers=False)
    ours, _ = solve(epochs, Ephemerides([*map(as_rtklib, used), *model]), settings)
    tags = np.array([epoch.t_ns for epoch in epochs])
    theirs = {int(tags[np.argmin(np.abs(tags - s.t_ns))]): s for s in solutions}
    return {t: s for t, s in theirs.items() if abs(t - s.t_ns) < 0.04 * SECOND_NS}, ours


def as_rtklib(ephemeris):
    """RTKLIB 2.4.3 b34 reads Galileo's usual accuracy of 3.12 m as 2.96 m, which changes weights."""
    galileo = isinstance(ephemeris, KeplerEphemeris) and ephemeris.satellite[0] == "E"
    return dataclasses.replace(ephemeris, accuracy=2.96) if galileo else ephemeris


if __name__ == "__main__":
    main()
