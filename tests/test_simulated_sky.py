"""The simulated sky: exact ranges, orbits as they are broadcast, satellites of a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gnss_scene import (
    BASE_ECEF,
    broadcast,
    circling,
    rover,
    sky,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS
from air.gnss.orbit import EARTH_RATE, states_at
from air.gnss.positioning import PointPosition, find_position
from air.gnss.settings import PositioningSettings
from air.gnss.signals import LIGHT
from air.sources.simulated.gnss.constellation import constellation
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.survey import START_NS
from air.sources.source import open_source
from common.arrays import F64
from common.errors import SourceError
from common.geo import ecef_to_geodetic
from common.measurements import (
    GlonassEphemeris,
    KeplerEphemeris,
)

PERFECT = GnssOptions.perfect()
DEFAULT = GnssOptions()


def test_the_range_is_that_of_light_between_two_moving_points() -> None:
    """The oracle solves for the moment of transmission in inertial space, with orbits computed at that very moment."""
    above = sky(PERFECT)
    t_s = np.array([0.0, 7.3, 33.37, 119.99, 1800.5])
    places, velocities = circling(t_s)
    geometry = above.geometry(t_s, places, velocities)
    references = above.constellation.reference
    for n, t in enumerate(t_s.tolist()):
        tau = np.full(len(references), 0.07)
        for _ in range(6):
            p = states_at(references, START_NS, t - tau).position
            inertial = np.stack([turn(v, -EARTH_RATE * x) for v, x in zip(p, tau, strict=True)])
            distance = np.linalg.norm(inertial - places[n], axis=1)
            tau = distance / LIGHT
        # The offset of states_at is a float of s: at 8 km/s its rounding is below a nanometre.
        np.testing.assert_allclose(geometry.distance[n], distance, rtol=0, atol=1e-4)


def turn(v: F64, angle: float) -> F64:
    """A vector of ECEF after the earth turned by an angle, seen from the frame as it was."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]])


def test_the_rates_are_the_derivatives_of_the_ranges_and_clocks() -> None:
    above = sky(replace(DEFAULT, fault=2, fault_start=10.0, fault_ramp=0.5))
    t_s, h = np.array([3.0, 15.0, 61.7, 600.0]), 0.05
    before, now, after = (above.geometry(t, *circling(t)) for t in (t_s - h, t_s, t_s + h))
    # Central differences are off by h²/6 times the third derivative (the circle's 0.03 m/s³), and rounding.
    np.testing.assert_allclose((after.distance - before.distance) / (2 * h), now.rate, rtol=0, atol=1e-4)
    np.testing.assert_allclose((after.clock - before.clock) / (2 * h), now.clock_rate, rtol=0, atol=1e-4)


def test_the_nominal_sky_looks_like_the_real_one() -> None:
    above = sky(PERFECT)
    seen = above.air(0.0, BASE_ECEF).elevation > np.radians(10)
    count = Counter(name[0] for name, up in zip(above.satellites, seen, strict=True) if up)
    assert all(7 <= count[system] <= 13 for system in "GE")
    assert 5 <= count["R"] <= 10
    assert 12 <= count["C"] <= 25  # over East Asia
    states = states_at(above.constellation.reference, START_NS, np.zeros(len(above.satellites)))
    longitude = dict(zip(above.satellites, ecef_to_geodetic(states.position), strict=True))
    for name, expected in {"C01": 140.0, "C02": 84.0, "C03": 110.5, "C04": 160.0, "C05": 58.75}.items():
        assert abs(longitude[name][0]) < 0.5
        assert longitude[name][1] == pytest.approx(expected, abs=0.5)
        assert longitude[name][2] == pytest.approx(35_786e3, abs=50e3)


def test_new_issues_describe_the_orbits_that_are_flown() -> None:
    """Their errors are those of rounding: half a metre for GLONASS, some centimetres for the others."""
    found = constellation(DEFAULT, START_NS, 1)
    most = {"G": 0.08, "E": 0.06, "C": 0.08, "R": 1.5}
    changed = Counter[str]()
    for after_s in range(0, 1801, 200):
        t_ns = START_NS + after_s * SECOND_NS
        issues = [found.issue(name, t_ns) for name in found.satellites]
        told, flown = (states_at(e, t_ns, np.zeros(len(issues))) for e in (issues, found.reference))
        error = np.linalg.norm(told.position - flown.position, axis=1) + LIGHT * np.abs(told.clock - flown.clock)
        for name, value, issue, first in zip(found.satellites, error, issues, found.reference, strict=True):
            assert value <= most[name[0]], name
            changed[name[0]] += issue != first
            assert issue.toe_ns != t_ns or name[0] != "E"
    assert all(changed[system] for system in "GER")


@settings(max_examples=20)
@given(st.integers(0, 2**31 - 1), st.integers(0, 10**6))
def test_a_flight_may_start_at_any_time(seed: int, minutes: int) -> None:
    start_ns = START_NS + minutes * 60 * SECOND_NS
    found = constellation(DEFAULT, start_ns, seed)
    assert len(found.satellites) == 31 + 24 + 24 + 9 + 5 + 24
    radius = np.linalg.norm(states_at(found.reference, start_ns, np.zeros(len(found.satellites))).position, axis=1)
    assert radius.min() > 25e6
    assert radius.max() < 43e6


def test_the_satellites_of_a_navigation_file_fly(real_data: Callable[[str], Path]) -> None:
    path = real_data("gnss") / "matrtklib_static" / "base.nav"
    options = replace(PERFECT, nav=str(path), rate_hz=1.0)
    observed = list(rover(options, 20.0).observations())
    filed = {m.satellite for m in open_source(f"rinex:{path}") if isinstance(m, KeplerEphemeris | GlonassEphemeris)}
    assert set(observed[-1].epoch.satellites) <= filed
    known = Ephemerides(broadcast(sky(options), 20.0))
    found = find_position(observed[-1].epoch, known, PositioningSettings())
    assert isinstance(found, PointPosition)
    assert np.linalg.norm(found.position - circling(np.array([observed[-1].t_s]))[0][0]) < 0.05


def test_a_file_without_orbits_is_refused(tmp_path: Path) -> None:
    empty = tmp_path / "empty.nav"
    empty.write_text(f"{'     3.04           N: GNSS NAV DATA    M: MIXED':<60}RINEX VERSION / TYPE\n")
    with pytest.raises(SourceError, match="no usable ephemeris"):
        constellation(replace(DEFAULT, nav=str(empty)), START_NS, 1)
    with pytest.raises(SourceError, match="cannot be read"):
        constellation(replace(DEFAULT, nav=str(tmp_path / "none")), START_NS, 1)
