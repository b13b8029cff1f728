"""Camera, IMU and GNSS together over simulated video with all errors on: accuracy, what may happen, and what costs it.

Rendering a flight of 300 s takes minutes; with `--keep` that happens once. Each of its runs then takes a minute or two:
four for the accuracy, one without GNSS, five disturbed, 28 of half the length for the error budget. Poses count as they
were told at their time, from when the world was found.

python tests/benchmarks/bench_flights.py [--keep FOLDER] [--flights playground:1 field:1] [--tables accuracy outage]
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from disturbances import DISTURBANCES, without, without_gnss
from error_sources import SEEN, SENSED
from figures import Figure, print_table
from flight_run import accuracy, bridged, compared, rms, run
from flown_flights import flown, sensed_anew
from tqdm import tqdm

BUDGET = "playground:2"
BUDGET_S = 150.0
AWAY_S = 60.0, 180.0
"""GNSS is off from and until then."""
TABLES = ("accuracy", "outage", "disturbances", "budget")


@dataclass(frozen=True)
class Way:
    """What of GNSS is used, and the most, m, that it should leave over the playground; `elsewhere` over other sites."""

    name: str
    carrier: bool
    base: bool
    rmse: float | None = None
    mean: float | None = None
    most: float | None = None
    smoothed: float | None = None
    unaligned: float | None = None
    elsewhere: float | None = None

    def figures(self, site):
        """Rows of its table."""
        home = site == "playground"
        return (
            Figure("RMSE after alignment", most=self.rmse if home else self.elsewhere),
            Figure("mean", most=self.mean if home else None),
            Figure("most", most=self.most if home else None),
            Figure("RMSE smoothed afterwards", most=self.smoothed if home else None),
            Figure("RMSE without alignment", most=self.unaligned if home else None),
            Figure("roll and pitch, RMSE", "°", 3, most=0.1),
            Figure("yaw, RMSE", "°", 3, most=0.3),
            Figure("NEES of the position / 3", "", 2),
            Figure("world found after motion begins", "s", 1, most=4.0),
            Figure("yaw then", "°", 2, most=0.5),
            Figure("CPU for a second of flight", "s", 2, most=0.6),
            Figure("CPU from frame to pose, median", "ms", 0),
            Figure("99 %", "ms", 0, most=60.0),
            Figure("changes of mode", "", 0),
        )


WAYS = (
    Way("code and Doppler", False, False, rmse=0.30, mean=0.26, most=0.80, elsewhere=0.40),
    Way("with carrier phase", True, False, rmse=0.10, smoothed=0.06),
    Way("with a base station, code", False, True, unaligned=0.35),
    Way("with a base station, carrier phase", True, True, unaligned=0.15),
)


class Flights:
    """The flights asked for, by name, and their undisturbed runs with carrier phase."""

    def __init__(self, names, folder):
        self.names, self._folder = names, folder
        self._undisturbed = {}

    def open(self, name, options=""):
        """The flight of a name such as playground:1."""
        site, seed = name.split(":")
        return flown(f"sim:{site}?seed={seed}&duration=300&camera.rate_hz=10&mavlink=off{options}", self._folder)

    def undisturbed(self, name):
        """The run of a flight as it is."""
        if name not in self._undisturbed:
            self._undisturbed[name] = run(self.open(name))
        return self._undisturbed[name]

    def each(self, what):
        """The names, with a bar of progress."""
        return tqdm(self.names, what, leave=False, disable=None)


def print_accuracy(flights):
    """Each site, four ways."""
    for way in WAYS:
        found = {}
        for name in flights.each(way.name):
            as_it_is = way.carrier and not way.base
            flew = flights.undisturbed(name) if as_it_is else run(flights.open(name), way.carrier, way.base)
            found.setdefault(name.split(":")[0], {})[name.replace(":", " ")] = accuracy(flew)
        for site, columns in found.items():
            values = np.array(list(columns.values()))
            print(f"### {site.capitalize()}, {way.name}\n")
            print_table(way.figures(site), {**columns, "median": np.median(values, axis=0)})
            print(f"NEES of the position / 3, mean: {np.mean(values[:, 7]):.2f}; of five flights 95 %: 0.42 to 1.83\n")


def print_outage(flights):
    """Without GNSS for two minutes."""
    rows = (
        Figure("flown meanwhile", "m", 0),
        Figure("error grown at its end", "%", 2, most=0.005),
        Figure("largest step on return", most=0.3),
        Figure("changes of mode", "", 0),
    )
    columns = {}
    for name in flights.each("without GNSS"):
        flew = run(without_gnss(flights.open(name), *AWAY_S))
        columns[name.replace(":", " ")] = [*bridged(flew, *AWAY_S), flew.mode_changes]
    print("### GNSS off from 60 to 180 s\n")
    print_table(rows, columns)


def print_disturbances(flights):
    """RMSE 30 s after, against the undisturbed flight."""
    for disturbance in DISTURBANCES:
        columns = {}
        for name in flights.each(disturbance.name):
            flew = run(disturbance.of(flights.open(name)))
            against = compared(flew, flights.undisturbed(name), disturbance.over_s, disturbance.same_world)
            columns[name.replace(":", " ")] = [*against, *accuracy(flew)[8:10], flew.mode_changes]
        print(f"### Disturbed: {disturbance.name}\n")
        rows = (
            Figure("RMSE, from 30 s later on"),
            Figure("undisturbed"),
            Figure("ratio", "", 2, most=1.5),
            Figure("world found after motion begins", "s", 1, most=4.0),
            Figure("yaw then", "°", 2, most=0.5),
            Figure("changes of mode", "", 0),
        )
        print_table(rows, columns)


def print_budget(flights, camera):
    """What is left when an error of the simulator is turned off."""
    flight = without(flights.open(BUDGET), object, BUDGET_S, np.inf)
    print(f"### Error budget, {BUDGET.replace(':', ' ')}: RMSE in m\n")
    print("| turned off | code and Doppler, aligned | as it is | with carrier phase, aligned | as it is |")
    print("|---|---|---|---|---|")
    _print_left("nothing", flight)
    for name, options in tqdm(SENSED.items(), "errors", leave=False, disable=None):
        _print_left(name, without(sensed_anew(flight, options), object, BUDGET_S, np.inf))
    for name, options in tqdm(SEEN.items() if camera else (), "errors", leave=False, disable=None):
        _print_left(name, without(flights.open(BUDGET, options), object, BUDGET_S, np.inf))


def _print_left(name, flight):
    cells = []
    for flew in (run(flight, carrier=carrier) for carrier in (False, True)):
        known = len(flew.t_s) > 0
        cells += [rms(flew.left()), rms(np.linalg.norm(flew.error, axis=1))] if known else [np.nan, np.nan]
    print(f"| {name} | {' | '.join(f'{cell:.3f}' for cell in cells)} |", flush=True)


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", type=Path, help="folder of the flights, rendered where they are not there yet")
    parser.add_argument("--flights", nargs="+", default=["playground:1"], help="such as playground:1 field:1")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=TABLES[:3])
    parser.add_argument("--camera", action="store_true", help="also render without the errors of the camera: an hour")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        flights = Flights(args.flights, args.keep or Path(temporary))
        if "accuracy" in args.tables:
            print_accuracy(flights)
        if "outage" in args.tables:
            print_outage(flights)
        if "disturbances" in args.tables:
            print_disturbances(flights)
        if "budget" in args.tables:
            print_budget(flights, args.camera)


if __name__ == "__main__":
    main()
