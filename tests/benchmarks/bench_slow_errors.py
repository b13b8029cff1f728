"""What satellites and air do to antennas whose place is known: of real ones and of the simulated one.

Codes of the first band, free of what the broadcast models know, less the true ranges. An ionosphere that errs by the
same everywhere at the zenith, and by gradients to north and east, is fitted to the means of GPS and Galileo; what is
left of each satellite is its orbit and clock, multipath and delays between signals. Carriers drift against the mean of
their system: by all, and by what two bands tell is not the ionosphere.

python tests/benchmarks/bench_slow_errors.py
"""

import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from figures import recording
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gnss_scene import BASE_ECEF, BASE_WORLD, DATUM, broadcast, rover, sky

from air.gnss.ephemerides import Ephemerides
from air.gnss.orbit import geometric_range
from air.gnss.positioning import azimuth_elevation
from air.odometry.gnss_corrections import correct
from air.sources.simulated.gnss.antenna import fixed_antenna
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.source import open_source
from common.geo import ecef_to_geodetic, geodetic_to_ecef
from common.measurements import GnssEpoch

EARTH, SHELL = 6.371, 0.350
"""Radius of the earth and height of the ionosphere's layer, 1000 km."""
LOWEST = np.radians(15.0)
SEEDS, DURATION_S = range(1, 9), 300.0


def main():
    """Print the table."""
    heads = ("antenna", "satellites", "zenith, m", "north, m/1000 km", "east", "GPS, Galileo before, m", "after, m")
    heads += tuple(f"{system} drifts, mm/s" for system in ("GPS", "Galileo", "BeiDou", "GLONASS"))
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for name in ("rover", "base"):
        folder = recording("gnss") / "matrtklib_static"
        place = geodetic_to_ecef(*map(float, (folder / f"{name}_position.txt").read_text().split()))
        source = open_source(f"rinex:{folder / f'{name}.obs'},{folder / 'base.nav'}")
        print(f"| matrtklib {name} | {' | '.join(cells(list(source), place))} |", flush=True)
    for seed in tqdm(SEEDS, leave=False, disable=None):
        print(f"| simulated, seed {seed} | {' | '.join(cells(simulated(seed), BASE_ECEF))} |", flush=True)


def simulated(seed):
    """What a simulated receiver that stands measures, and what the satellites broadcast."""
    options = replace(GnssOptions(), rate_hz=0.2, missing=0.0)
    standing = rover(options, DURATION_S, seed, fixed_antenna(BASE_WORLD, DATUM))
    return [*broadcast(sky(options, seed), DURATION_S), *(observed.epoch for observed in standing.observations())]


def cells(messages, place):
    """The row of an antenna at a place (3,) m, ECEF."""
    known = Ephemerides(message for message in messages if not isinstance(message, GnssEpoch))
    geodetic = ecef_to_geodetic(place) * (np.pi / 180, np.pi / 180, 1.0)
    codes, carriers, seen = defaultdict(list), defaultdict(list), {}
    for epoch in (message for message in messages if isinstance(message, GnssEpoch)):
        signals = correct(epoch, known, place)
        away = signals.ranges(place)
        azimuth, elevation = azimuth_elevation(geometric_range(signals.p_satellite, place)[1], geodetic)
        second = {name: j for j, name in enumerate(signals.satellites) if not signals.first[j]}
        for i in np.flatnonzero(signals.first & (elevation > LOWEST)).tolist():
            name, b1 = signals.satellites[i], signals.bend[i]
            seen[name] = azimuth[i], elevation[i], signals.slant[i]
            codes[name].append(signals.code[i] - away[i])
            if name in second:
                j = second[name]
                L1, L2, b2 = signals.carrier[i] - away[i], signals.carrier[j] - away[j], signals.bend[j]
                carriers[name].append((epoch.t_ns / 1e9, L1, (b2 * L1 - b1 * L2) / (b2 - b1)))
    fitted = air({name: np.mean(values) for name, values in codes.items() if name[0] in "GE"}, seen)
    return f"{len(seen)}", *(f"{value:.2f}" for value in fitted), *(drifts(carriers, system) for system in "GECR")


def air(codes, seen):
    """Zenith m, gradients m/1000 km, and the satellites' RMS before and after these are taken off."""
    azimuth, elevation, slant = np.array([seen[name] for name in codes]).T
    away = EARTH * (np.pi / 2 - elevation - np.arcsin(EARTH / (EARTH + SHELL) * np.cos(elevation)))
    clocks = np.array([[name[0] == system for system in sorted({name[0] for name in codes})] for name in codes], float)
    shapes = slant * np.stack([np.ones_like(away), away * np.cos(azimuth), away * np.sin(azimuth)])
    A, y = np.column_stack([clocks, *shapes]), np.array(list(codes.values()))
    before, after = (y - part @ np.linalg.lstsq(part, y, rcond=None)[0] for part in (clocks, A))
    return *np.linalg.lstsq(A, y, rcond=None)[0][-3:], np.std(before), np.std(after)


def drifts(carriers, system):
    """RMS drift of unbroken carriers of a system, and of their part without the ionosphere, as a cell."""
    whole = [np.array(rows) for name, rows in carriers.items() if name[0] == system]
    longest = max((len(rows) for rows in whole), default=0)
    whole = [rows for rows in whole if len(rows) == longest and np.abs(np.diff(rows[:, 1] - rows[:, 2])).max() < 0.1]
    if len(whole) < 3:
        return "–"
    shared = np.mean([rows[:, 1:] for rows in whole], axis=0)
    slopes = np.array([np.polyfit(rows[:, 0] - rows[0, 0], rows[:, 1:] - shared, 1)[0] for rows in whole]) * 1e3
    total, satellites = np.sqrt(np.sum(slopes**2, axis=0) / (len(whole) - 1))
    return f"{total:.2f}, {satellites:.2f}"


if __name__ == "__main__":
    main()
