"""Positions joined by carrier phase: on real recordings, and with carriers that slip unnoticed."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from gnss_scene import broadcast, rover, sky
from hypothesis import given, settings
from hypothesis import strategies as st

from air.__main__ import main
from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS
from air.gnss.orbit import geometric_range
from air.gnss.positioning import PointPosition, find_position
from air.gnss.settings import PositioningSettings
from air.odometry.carrier_smoothing import Carriers, CarrierSmoother, Way, way_by_carriers
from air.positions import find_smooth_positions
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.source import open_source
from common.arrays import F64
from common.geo import geodetic_to_ecef
from common.measurements import GnssEpoch

NEAR = geodetic_to_ecef(30.5, 114.4, 50.0)


def smooth(url: str) -> tuple[list[PointPosition], list[PointPosition], list[Way | None]]:
    """Single points of a recording, the same smoothed, and the ways between them as carriers or Dopplers tell."""
    known, options = Ephemerides(), PositioningSettings()
    smoother, single, ways = CarrierSmoother(known, options), list[PointPosition](), list[Way | None]()
    for message in open_source(url):
        known.add(message)
        if isinstance(message, GnssEpoch):
            fix = find_position(message, known, options, single[-1].position if single else None)
            if isinstance(fix, PointPosition):
                single.append(fix)
                ways.append(smoother.add(message, fix))
    return single, smoother.smoothed(), ways


def jumps(positions: list[PointPosition], ways: list[Way | None]) -> F64:
    """By how much (J,) m the step from one position to the next differs from the way between them."""
    steps = zip(pairwise(positions), ways[1:], strict=True)
    return np.array([np.linalg.norm(b.position - a.position - way.moved) for (a, b), way in steps if way is not None])


def test_positions_of_a_walk_do_not_jump(real_data: Callable[[str], Path]) -> None:
    """A walk with an F9P in the hand at 1 Hz, with houses around: single points jump by up to nine metres."""
    single, smoothed, ways = smooth(f"ubx:{real_data('gnss') / 'nhm.ubx'}")
    assert len(jumps(single, ways)) > 80
    assert jumps(single, ways).max() > 3.0
    assert jumps(smoothed, ways).max() < 0.5
    for a, b in pairwise(smoothed):
        # An independent witness: the mean of two Dopplers, between which the hand swings, by a metre at most.
        step, dt = b.position - a.position, (b.t_ns - a.t_ns) / SECOND_NS
        assert np.linalg.norm(step - (a.velocity + b.velocity) / 2 * dt) < 1.0
        assert np.linalg.norm(step) < 2.0 * dt


def test_positions_at_rest_stay_where_they_are_and_know_how_well(real_data: Callable[[str], Path]) -> None:
    folder = real_data("gnss") / "matrtklib_static"
    truth = geodetic_to_ecef(*map(float, (folder / "rover_position.txt").read_text().split()))
    single, smoothed, _ = smooth(f"rinex:{folder / 'rover.obs'},{folder / 'base.nav'}")
    single_spread, spread = (np.std([one.position for one in some], axis=0).max() for some in (single, smoothed))
    assert spread < 0.05 < 0.2 < single_spread
    off = [one.position - truth for one in smoothed]
    squares = [e @ np.linalg.solve(one.covariance, e) for e, one in zip(off, smoothed, strict=True)]
    assert np.linalg.norm(off, axis=1).max() < 4.0
    assert max(squares) < 14.2  # χ² of three, once in 370


def carriers(moved: F64, clock: float, seed: int = 0, count: int = 8) -> Carriers:
    """Carriers without errors at a place beside NEAR, with ambiguities that stay."""
    rng = np.random.default_rng(seed)
    up = NEAR / np.linalg.norm(NEAR)
    directions = rng.normal(size=(count, 3))
    directions += up * (0.3 * np.linalg.norm(directions, axis=1) - directions @ up)[:, None].clip(0)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    p_satellite = NEAR + 2.2e7 * directions
    carrier = geometric_range(p_satellite, NEAR + moved)[0] + rng.normal(0, 1e6, count) + clock
    return Carriers(np.arange(count), carrier, p_satellite)


def test_a_slip_that_nobody_noticed_is_left_out() -> None:
    moved = np.array([1.2, -0.7, 0.3])
    now = carriers(moved, 1e5)
    now.carrier[3] += 0.19
    way = way_by_carriers(carriers(np.zeros(3), 0.0), now, NEAR + 5.0)
    assert way is not None
    assert way.moved == pytest.approx(moved, abs=0.005)  # the line of sight turns with the place


def test_too_few_carriers_tell_no_way() -> None:
    before, now = carriers(np.zeros(3), 0.0, count=5), carriers(np.ones(3), 0.0, count=5)
    assert way_by_carriers(before, now, NEAR) is not None
    now.carrier[2] += 0.5
    assert way_by_carriers(before, now, NEAR) is None
    four = Carriers(now.arc[:4], now.carrier[:4], now.p_satellite[:4])
    assert way_by_carriers(before, four, NEAR) is None
    none = Carriers(now.arc[:0], now.carrier[:0], now.p_satellite[:0])
    assert way_by_carriers(before, none, NEAR) is None


def test_a_car_keeps_its_way_where_bridges_break_most_carriers(real_data: Callable[[str], Path]) -> None:
    single, smoothed, ways = smooth(f"comma2k19:{real_data('comma2k19') / 'segment'}")
    assert sum(way is None for way in ways) < 5
    assert jumps(single, ways).max() > 2.0
    assert jumps(smoothed, ways).max() < 0.5


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_nonsense_never_ends_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    known, options = Ephemerides(broadcast(sky(GnssOptions()), 10.0)), PositioningSettings()
    smoother = CarrierSmoother(known, options)
    for o in EPOCHS:
        change = {
            name: np.where(rng.random(len(o.satellites)) < 0.1, rng.choice([np.nan, 0.0, -1e9, 1e300]), value)
            for name, value in vars(o).items()
            if isinstance(value, np.ndarray) and value.dtype == np.float64
        }
        fix = find_position(epoch := replace(o, **change), known, options)
        if isinstance(fix, PointPosition):
            smoother.add(epoch, fix)
    assert all(np.isfinite(one.position).all() for one in smoother.smoothed())


EPOCHS = [o.epoch for o in rover(GnssOptions(), 1.5).observations()]


def test_the_command_writes_smooth_positions(
    real_data: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, url = tmp_path / "positions.csv", f"ubx:{real_data('gnss') / 'nhm.ubx'}"
    assert main(["position", url, "--out", str(out), "--quiet", "--smooth"]) == 0
    assert "of 114 epochs gave a position" in capsys.readouterr().out
    rows = [row for row in csv.DictReader(out.open()) if not row["refused"]]
    places = [geodetic_to_ecef(*(float(row[n]) for n in ("latitude_deg", "longitude_deg", "height_m"))) for row in rows]
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 2.0  # it walks


def test_refused_epochs_stay_in_their_place(real_data: Callable[[str], Path]) -> None:
    outcomes = list(find_smooth_positions(open_source(f"ubx:{real_data('gnss') / 'nhm.ubx'}"), PositioningSettings()))
    assert len(outcomes) == 114
    assert all(epoch.t_ns == outcome.t_ns for epoch, outcome in outcomes)
