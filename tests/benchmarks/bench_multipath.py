"""Noise and multipath of the code, of real receivers and of the simulated one, told by the same estimator.

Code less carrier holds twice the ionosphere, an ambiguity, and the errors of the code; where a satellite has two bands,
their carriers tell the ionosphere (the multipath combination: Misra and Enge, Global Positioning System, 2nd edition,
chapter 5), else a parabola over the arc takes it off, with all else that is as slow. Slips end an arc; its mean is
unknown. White noise, what stays for a while and for how long come from the variogram, half the mean square of
differences over a lag, which knows no mean; the lags reach 60 s. What is slower than the arcs nobody sees, in either.

python tests/benchmarks/bench_multipath.py [NAME=SOURCE …]

Sources besides the recordings beside this checkout, such as f9t=ubx:FILE.
"""

import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from figures import recording
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gnss_scene import broadcast, circling, rover, sky

from air.gnss.atmosphere import L1_HZ
from air.gnss.ephemerides import Ephemerides
from air.gnss.positioning import PointPosition, find_position
from air.gnss.settings import PositioningSettings
from air.gnss.signals import LIGHT, PRIMARY, SECONDARY, frequency, preference
from air.odometry.code_smoothing import divergence
from air.odometry.gnss_carrier import CarrierLocks
from air.odometry.gnss_corrections import Signals
from air.odometry.gnss_settings import GnssSelection
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.source import open_source
from common.measurements import GnssEpoch

SHORTEST_S, LONGEST_LAG_S, STEP_S = 40.0, 60.0, 1.0
JUMP = 5.0
TIMES_S, SLOWEST_S = np.geomspace(1.0, 200.0, 60), 100.0
ELEVATIONS = (10, 30, 50, 90)
CN0 = (25, 35, 40, 45, 60)
SIMULATED_S = 600.0


@dataclass(frozen=True, eq=False)
class Arc:
    """Of one code (N,): seconds of GPST, error m of mean 0, elevation rad, C/N0 dBHz."""

    kind: str
    t_s: np.ndarray
    error: np.ndarray
    elevation: np.ndarray
    cn0: np.ndarray


def main():
    """Print the tables."""
    found = {name: arcs_of(open_source(url)) for name, url in tqdm([*recordings()], leave=False, disable=None)}
    found["simulated, in flight"] = arcs_of(simulated(GnssOptions()))
    found["simulated, base station"] = arcs_of(simulated(GnssOptions.base()))
    print("| recording | code | arcs | minutes | C/N0, dBHz | σ, m | in a second, m | white, m | stays, m | over, s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, arcs in found.items():
        kinds = defaultdict(list)
        for arc in arcs:
            kinds[arc.kind].append(arc)
        for kind, some in sorted(kinds.items()):
            print(f"| {name} | {kind} | {' | '.join(parts(some))} |", flush=True)
    heads = [f"{low}–{high}°" for low, high in pairwise(ELEVATIONS)]
    heads += [f"{low}–{high} dBHz" for low, high in pairwise(CN0)]
    print(f"\n| σ, m: stays, and white | {' | '.join(heads)} |\n|{'---|' * (len(heads) + 1)}")
    for name, arcs in found.items():
        cells = [*split(arcs, "elevation", np.radians(ELEVATIONS)), *split(arcs, "cn0", CN0)]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def recordings():
    """Name and URL of each recording."""
    gnss = recording("gnss")
    static = gnss / "matrtklib_static"
    yield "nhm: F9P, walking, weak signals", f"ubx:{gnss / 'nhm.ubx'}"
    weak = gnss / "16dBatt_no_interference_coldstart"
    yield "16dBatt: u-blox, static, 16 dB weaker", f"rinex:{weak}.obs.gz,{weak}.nav.gz"
    yield "matrtklib rover: Septentrio, static", f"rinex:{static / 'rover.obs'},{static / 'base.nav'}"
    yield "matrtklib base: static", f"rinex:{static / 'base.obs'},{static / 'base.nav'}"
    yield "comma2k19: M8, car", f"comma2k19:{recording('comma2k19') / 'segment'}"
    yield from (argument.split("=", 1) for argument in sys.argv[1:])


def simulated(options):
    """What a simulated receiver measures, and what the satellites broadcast."""
    options = replace(options, rate_hz=1.0, missing=0.0)
    yield from broadcast(sky(options), SIMULATED_S)
    yield from (observed.epoch for observed in rover(options, SIMULATED_S, antenna=circling).observations())


def arcs_of(source):
    """Errors of the codes of a recording, by unbroken arcs of their carriers."""
    known, locks, held = Ephemerides(), CarrierLocks(GnssSelection()), defaultdict(list)
    last_s, elevations = -np.inf, {}
    for message in source:
        known.add(message)
        if not isinstance(message, GnssEpoch) or message.t_ns / 1e9 - last_s < STEP_S - 0.05:
            continue
        last_s = t_s = message.t_ns / 1e9
        fix = find_position(message, known, PositioningSettings())
        if isinstance(fix, PointPosition):
            elevations.update(zip(fix.used, fix.elevation.tolist(), strict=True))
        signals = uncorrected(message)
        arcs = locks.step(t_s, signals, message.lock_s[signals.row])
        rows = {key: i for i, key in enumerate(signals.keys)}
        for i in np.flatnonzero(arcs >= 0).tolist():
            satellite, row = signals.satellites[i], signals.row[i]
            other = rows.get((satellite, not signals.first[i]), i)
            two = other != i and arcs[other] >= 0
            split = divergence(signals, i, other) if two else 0.0
            error = signals.code[i] - signals.carrier[i] - split
            kind = f"{satellite[0]} {message.signals[row]}, {'two bands' if two else 'one band'}"
            some = held[kind, satellite, int(arcs[i]), int(arcs[other])]
            some.append((t_s, error, elevations.get(satellite, np.nan), message.cn0[row]))
    series = ((kind, np.array(part).T) for (kind, *_), rows in held.items() for part in unbroken(rows))
    return [arc(kind, columns) for kind, columns in series if columns[0, -1] - columns[0, 0] >= SHORTEST_S]


def uncorrected(epoch):
    """The preferred signal of each satellite's two bands, as measured: what models know is none of our concern."""
    best = {}
    for row, (satellite, signal) in enumerate(zip(epoch.satellites, epoch.signals, strict=True)):
        system = satellite[0]
        if signal[0] in (PRIMARY.get(system), SECONDARY.get(system)) and np.isfinite(epoch.pseudorange[row]):
            key = satellite, signal[0] == PRIMARY[system]
            if key not in best or preference(signal) < preference(epoch.signals[best[key]]):
                best[key] = row
    row = np.array(list(best.values()), int)
    f = np.array([frequency(epoch.satellites[i], epoch.signals[i], int(epoch.channel[i])) for i in row])
    unknown = np.full(len(row), np.nan)
    return Signals(
        row=row,
        satellites=tuple(satellite for satellite, _ in best),
        clocks=tuple(satellite[0] for satellite, _ in best),
        first=np.array([first for _, first in best], bool),
        p_satellite=np.full((len(row), 3), np.nan),
        v_satellite=np.full((len(row), 3), np.nan),
        code=epoch.pseudorange[row],
        carrier=np.where(epoch.half_cycle[row], np.nan, epoch.carrier_phase[row] * LIGHT / f),
        rate=-epoch.doppler[row] * LIGHT / f,
        frequency=f,
        bend=(L1_HZ / f) ** 2,
        slant=unknown,
        elevation=unknown,
        told=np.ones(len(row), bool),
        issue=np.zeros(len(row), np.int64),
        renewed=np.zeros(len(row)),
    )


def unbroken(rows):
    """Parts of an arc between gaps and jumps of the error."""
    ends = [
        i for i in range(1, len(rows)) if rows[i][0] - rows[i - 1][0] > 3 or abs(rows[i][1] - rows[i - 1][1]) > JUMP
    ]
    return [rows[i:j] for i, j in zip([0, *ends], [*ends, len(rows)], strict=True)]


def arc(kind, columns):
    """An arc with its mean, or its parabola, taken off."""
    t_s, error, elevation, cn0 = columns
    x = 2 * (t_s - t_s[0]) / (t_s[-1] - t_s[0]) - 1
    degree = 0 if kind.endswith("two bands") else 2
    return Arc(kind, t_s, error - np.polynomial.Polynomial.fit(x, error, degree)(x), elevation, cn0)


def parts(arcs):
    """Arcs, minutes, mean C/N0, σ, change in a second, white noise, what stays and for how long, as cells."""
    errors, cn0 = np.concatenate([a.error for a in arcs]), np.concatenate([a.cn0 for a in arcs])
    series = [(a.t_s, a.error) for a in arcs]
    change = np.sqrt(gammas(series)[0][0])
    white, stays, over_s = variogram(series)
    metres = [f"{value:.2f}" for value in (np.sqrt(np.mean(errors**2)), change, white, stays)]
    seconds = f"{over_s:.0f}" if over_s < SLOWEST_S else f"> {SLOWEST_S:.0f}"
    return f"{len(arcs)}", f"{len(errors) * STEP_S / 60:.0f}", f"{np.mean(cn0):.0f}", *metres, seconds


def gammas(series):
    """The variogram (L,) m² of series of times and values at lags of whole seconds, and how many differences it has."""
    lags = np.arange(1, int(LONGEST_LAG_S / STEP_S) + 1)
    total, count = np.zeros(len(lags)), np.zeros(len(lags))
    for t_s, values in series:
        seconds = np.round((t_s - t_s[0]) / STEP_S).astype(int)
        even = np.full(seconds[-1] + 1, np.nan)
        even[seconds] = values
        for k in lags[lags < len(even)]:
            difference = even[k:] - even[:-k]
            difference = difference[np.isfinite(difference)]
            total[k - 1] += 0.5 * np.sum(difference**2)
            count[k - 1] += len(difference)
    return total[count > 0] / count[count > 0], count[count > 0], lags[count > 0] * STEP_S


def variogram(series):
    """White noise and what stays, σ, and for how long, s: an exponential fitted to the variogram.

    What stays for longer than the lags tell is given as far as it changes within them.
    """
    gamma, count, lag_s = gammas(series)
    root = np.sqrt(count / lag_s)
    best = (np.inf, 0.0, 0.0, 0.0)
    for over_s in TIMES_S:
        grown = 1 - np.exp(-lag_s / over_s)
        for columns in ((np.ones_like(grown), grown), (np.zeros_like(grown), grown), (np.ones_like(grown), 0 * grown)):
            A = np.stack(columns, axis=1) * root[:, None]
            found = np.linalg.lstsq(A, gamma * root, rcond=None)[0]
            cost = float(np.sum((A @ found - gamma * root) ** 2))
            if (found >= 0).all() and cost < best[0]:
                seen = 1.0 if over_s < SLOWEST_S else grown[-1]
                best = cost, float(np.sqrt(found[0])), float(np.sqrt(found[1] * seen)), float(over_s)
    return best[1:]


def split(arcs, by, edges):
    """What stays and white noise of the parts of arcs between edges, as cells."""
    cells = []
    for low, high in pairwise(edges):
        keeps = [(getattr(a, by) >= low) & (getattr(a, by) < high) for a in arcs]
        series = [(a.t_s[keep], a.error[keep]) for a, keep in zip(arcs, keeps, strict=True) if keep.sum() > 10]
        if sum(len(t_s) for t_s, _ in series) < 100:
            cells.append("–")
            continue
        white, stays, _ = variogram(series)
        cells.append(f"{stays:.2f}, {white:.2f}")
    return cells


if __name__ == "__main__":
    main()
