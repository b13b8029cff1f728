"""A simulated sky with a rover that flies circles and a base, for tests and benchmarks of the simulated GNSS."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from air.gnss.rinex_export import export_rinex
from air.sources.simulated.gnss.antenna import Antenna, fixed_antenna
from air.sources.simulated.gnss.constellation import constellation
from air.sources.simulated.gnss.gnss import BASE_STATION, ROVER, Observed, SimulatedReceiver
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.gnss.observables import Blocked
from air.sources.simulated.gnss.sky import Sky
from air.sources.simulated.survey import START_NS
from common.arrays import F64
from common.geo import T_ecef_enu
from common.measurements import Ephemeris, Ionosphere
from common.messages import Datum

DATUM = Datum("gnss-scene", 30.5355, 114.3655, 62.0)
T_ECEF_WORLD = T_ecef_enu(DATUM)
BASE_WORLD = np.array([100.0, -150.0, 1.0])
BASE_ECEF = T_ECEF_WORLD.apply(BASE_WORLD)
_RADIUS, _TURN, _CLIMB = 30.0, 0.1, 0.05


def circling(t_s: F64) -> tuple[F64, F64]:
    """An antenna that flies circles at 3 m/s, 40 m up, rising and sinking."""
    a, b = _TURN * t_s, _CLIMB * t_s
    p = np.stack([_RADIUS * np.cos(a), _RADIUS * np.sin(a), 40 + 5 * np.sin(b)], axis=1)
    v = np.stack([-_RADIUS * _TURN * np.sin(a), _RADIUS * _TURN * np.cos(a), 5 * _CLIMB * np.cos(b)], axis=1)
    return T_ECEF_WORLD.apply(p), v @ T_ECEF_WORLD.R.T


def circling_low(t_s: F64) -> tuple[F64, F64]:
    """The same circles as high as the base, so that both antennas have the same air above them."""
    p, v = circling(t_s)
    p_world, v_world = T_ECEF_WORLD.inverse().apply(p), v @ T_ECEF_WORLD.R
    p_world[:, 2], v_world[:, 2] = BASE_WORLD[2], 0.0
    return T_ECEF_WORLD.apply(p_world), v_world @ T_ECEF_WORLD.R.T


def sky(options: GnssOptions, seed: int = 1, start_ns: int = START_NS) -> Sky:
    return Sky(constellation(options, start_ns, seed), options, DATUM, start_ns, seed)


def rover(
    options: GnssOptions,
    duration_s: float,
    seed: int = 1,
    antenna: Antenna = circling,
    blocked: Blocked | None = None,
    start_ns: int = START_NS,
) -> SimulatedReceiver:
    return SimulatedReceiver("gnss", antenna, sky(options, seed, start_ns), options, seed, duration_s, ROVER, blocked)


@dataclass(frozen=True, eq=False)
class Exported:
    """A flight's RINEX files, and the rover's epochs with their truth."""

    rover: Path
    base: Path
    nav: Path
    observed: list[Observed]
    antenna: Antenna

    def errors(self, t_ns: Iterable[int], positions: Iterable[F64]) -> F64:
        """East, north, up (N, 3) m of positions in ECEF against the truth at GPST (RTKLIB takes its clock off)."""
        truth, _ = self.antenna((np.array(list(t_ns)) - START_NS) / 1e9)
        return (np.array(list(positions)) - truth) @ T_ECEF_WORLD.R


def exported(
    folder: Path,
    options: GnssOptions,
    base: GnssOptions | None,
    duration_s: float,
    seed: int = 1,
    antenna: Antenna = circling,
) -> Exported:
    """A flight, with a base station or without, as RINEX files."""
    above = sky(options, seed)
    flying = SimulatedReceiver("gnss", antenna, above, options, seed, duration_s)
    observed = list(flying.observations())
    epochs = [o.epoch for o in observed]
    if base is not None:
        ground = fixed_antenna(BASE_WORLD, DATUM)
        standing = SimulatedReceiver("base", ground, above, base, seed, duration_s, BASE_STATION)
        epochs += [o.epoch for o in standing.observations()]
    export_rinex([*epochs, *broadcast(above, duration_s)], folder)
    return Exported(folder / "gnss.obs", folder / "base.obs", folder / "broadcast.nav", observed, antenna)


def broadcast(above: Sky, duration_s: float) -> list[Ephemeris | Ionosphere]:
    """All that satellites broadcast during a flight."""
    found: dict[Ephemeris | Ionosphere, None] = {above.constellation.ionosphere: None}
    for second in range(0, int(duration_s) + 1, 30):
        for name in above.satellites:
            found[above.constellation.issue(name, above.start_ns + second * 1_000_000_000)] = None
    return list(found)


def correlation_time(values: F64, step_s: float) -> float:
    """When the autocorrelation of values (N,) falls below 1/e, s."""
    x = values - values.mean()
    correlation = np.correlate(x, x, "full")[len(x) - 1 :]
    below = np.flatnonzero(correlation < correlation[0] / np.e)
    return float(below[0] * step_s) if len(below) else len(x) * step_s


def longest_gap(times: list[float]) -> float:
    return max(later - earlier for earlier, later in pairwise(times))
