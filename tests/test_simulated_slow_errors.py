"""What orbits, clocks and air do to simulated signals: as much as real ones, and shared as they share it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from gnss_scene import BASE_ECEF, T_ECEF_WORLD, sky

from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.gnss.sky import Sky
from common.arrays import F64

PERFECT = GnssOptions.perfect()
DEFAULT = GnssOptions()


def unmodelled(above: Sky, t_s: float, place: F64) -> F64:
    """What the model of the ionosphere does not tell (S,) m, as if each satellite stood at the zenith."""
    clean = sky(replace(above.options, ionosphere_residual=0.0, ionosphere_gradient=0.0, ionosphere_ripples=0.0))
    found = above.air(t_s, place)
    slant = 1.0 + 16.0 * (0.53 - np.maximum(found.elevation, np.radians(5.0)) / np.pi) ** 3
    return np.asarray((found.ionosphere - clean.air(t_s, place).ionosphere) / slant)


def test_neighbours_in_the_sky_share_the_ionospheres_error() -> None:
    """Those within 15° of each other agree better than any two: gradients are smooth, ripples small."""
    close, any_two = [], []
    for seed in range(1, 11):
        above = sky(DEFAULT, seed)
        air = above.air(60.0, BASE_ECEF)
        high = air.elevation > np.radians(15.0)
        error, direction = unmodelled(above, 60.0, BASE_ECEF)[high], air.direction[high]
        apart = np.subtract.outer(error, error)
        cosine = direction @ direction.T
        close.append(apart[(cosine > np.cos(np.radians(15.0))) & (cosine < 1.0 - 1e-9)])
        any_two.append(apart)
    rms = [np.sqrt(np.mean(np.concatenate([x.ravel() for x in some]) ** 2)) for some in (close, any_two)]
    assert rms[0] < 0.5 * rms[1]


def test_a_base_station_ten_kilometres_away_sees_the_same_air_but_for_centimetres() -> None:
    """Gradients of 0.9 mm/km, to the north and to the east, over 7 km: 9 mm for satellites at the zenith."""
    apart = T_ECEF_WORLD.apply(np.array([7000.0, 7000.0, 40.0]))
    differences = []
    for seed in range(1, 11):
        above = sky(DEFAULT, seed)
        here, there = (unmodelled(above, 60.0, place) for place in (BASE_ECEF, apart))
        differences.append(there - here)
    rms = np.sqrt(np.mean(np.square(differences)))
    assert 0.003 < rms < 0.03


def test_orbits_and_clocks_are_as_wrong_as_published_for_each_system() -> None:
    """Of each system the ranges' error RMS over seeds, against Montenbruck and others (2018), to a quarter or so."""
    found: dict[str, list[F64]] = {}
    for seed in range(1, 13):
        perfect, spoilt = (
            sky(replace(PERFECT, orbit=size, satellite_clock=clock), seed) for size, clock in ((0.0, 0.0), (0.35, 0.5))
        )
        t_s, place = np.array([30.0]), BASE_ECEF[None]
        ranges = [(g.distance - g.clock)[0] for g in (s.geometry(t_s, place, 0.0 * place) for s in (perfect, spoilt))]
        for system in "GREC":
            mine = np.array([name[0] == system for name in perfect.satellites])
            found.setdefault(system, []).append((ranges[1] - ranges[0])[mine])
    rms = {system: float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) for system, errors in found.items()}
    for system, published in {"G": 0.6, "E": 0.2, "C": 1.0, "R": 2.0}.items():
        assert 0.75 * published < rms[system] < 1.33 * published, rms
