"""Raw epochs are cleaned: what is left of good ones is the truth, what is bad is left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from gnss_scene import BASE_ECEF, BASE_WORLD, DATUM, broadcast, circling, rover, sky
from hypothesis import given, settings
from hypothesis import strategies as st

from air.gnss.ephemerides import HeldEphemerides, is_healthy
from air.gnss.gnss_time import SECOND_NS
from air.gnss.orbit import geometric_range
from air.gnss.positioning import Refused
from air.odometry.gnss_base import MAX_AGE_S
from air.odometry.gnss_carrier import CarrierLocks
from air.odometry.gnss_corrections import correct
from air.odometry.gnss_preprocessing import CleanEpoch, GnssPreprocessor
from air.odometry.gnss_settings import GnssSelection, GnssSettings
from air.sources.simulated.gnss.antenna import fixed_antenna
from air.sources.simulated.gnss.gnss import BASE_STATION, Observed, SimulatedReceiver
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.survey import START_NS
from air.sources.source import open_source
from common.arrays import F64
from common.measurements import GnssEpoch, KeplerEphemeris

PERFECT, DEFAULT = GnssOptions.perfect(), GnssOptions()


def preprocessor(options: GnssOptions = PERFECT, base: F64 | None = None, carrier: bool = True) -> GnssPreprocessor:
    found = GnssPreprocessor(GnssSettings(selection=GnssSelection(carrier=carrier)), base)
    for message in broadcast(sky(options), 10.0):
        found.add(message)
    return found


def observed(options: GnssOptions = PERFECT, seconds: float = 3.0) -> list[Observed]:
    return list(rover(options, seconds).observations())


def clean_all(cleaner: GnssPreprocessor, epochs: list[GnssEpoch]) -> list[CleanEpoch]:
    cleaned = [cleaner.clean(epoch) for epoch in epochs]
    return [clean for clean in cleaned if isinstance(clean, CleanEpoch)]


def spread(clean: CleanEpoch, values: F64) -> F64:
    """Measurements less the range to the true antenna, and less what all of a system share."""
    p, _ = circling(np.array([(clean.t_ns - START_NS) / SECOND_NS]))
    left = values - geometric_range(clean.p_satellite, p[0])[0]
    systems = np.array(clean.systems)
    for name in set(clean.systems):
        left[systems == name] -= np.nanmedian(left[systems == name])
    return np.asarray(left)


def test_without_errors_nothing_is_left_but_clocks() -> None:
    """Broadcast ephemerides are rounded: some centimetres; GLONASS's are integrated otherwise than flown."""
    last = clean_all(preprocessor(), [o.epoch for o in observed()])[-1]
    kepler = np.array([name != "R" for name in last.systems])
    assert len(last.satellites) > 20
    assert np.abs(spread(last, last.code)[kepler]).max() < 0.1
    assert np.sum([arc != "" for arc in last.arcs]) > 20


def test_the_time_of_an_epoch_is_free_of_the_receivers_clock() -> None:
    options = replace(PERFECT, clock=1.0, clock_drift_ppm=0.5)
    epochs = observed(options)
    cleaned = clean_all(preprocessor(options), [o.epoch for o in epochs])
    off_ns = [clean.t_ns - (START_NS + o.t_s * SECOND_NS) for clean, o in zip(cleaned, epochs, strict=True)]
    assert max(map(abs, off_ns)) < 100  # 30 m of clock; the tags differ by up to half a millisecond
    assert max(abs(o.epoch.t_ns - START_NS - o.t_s * SECOND_NS) for o in epochs) > 10_000


def with_change(epoch: GnssEpoch, name: str, satellite: str, change: float) -> GnssEpoch:
    values = getattr(epoch, name).copy()
    values[[one == satellite for one in epoch.satellites]] += change
    return replace(epoch, **{name: values})


@pytest.mark.parametrize("cycles", [1.0, -2.0, 40.0])
def test_a_slipped_carrier_begins_a_new_arc(cycles: float) -> None:
    epochs = [o.epoch for o in observed(seconds=2.0)]
    later = [with_change(epoch, "carrier_phase", "G07", cycles) for epoch in epochs[10:]]
    cleaner = preprocessor()
    before = clean_all(cleaner, epochs[:10])[-1]
    after = clean_all(cleaner, later)
    old = dict(zip(before.satellites, before.arcs, strict=True))
    assert [dict(zip(e.satellites, e.arcs, strict=True))["G07"] for e in after[:5]] == [""] * 5  # not locked for long
    others = {name: arc for name, arc in zip(after[-1].satellites, after[-1].arcs, strict=True) if name != "G07"}
    assert {name: old[name] for name in others} == others


def test_a_pseudorange_that_its_doppler_contradicts_is_left_out() -> None:
    epochs = [o.epoch for o in observed(seconds=1.0)]
    cleaner = preprocessor()
    clean_all(cleaner, epochs[:5])
    wild = cleaner.clean(with_change(epochs[5], "pseudorange", "G07", 20.0))
    assert isinstance(wild, CleanEpoch)
    kept = dict(zip(wild.satellites, wild.code.tolist(), strict=True))
    assert np.isnan(kept.get("G07", np.nan))
    assert np.isfinite(list(kept.values())).sum() >= len(kept) - 1


def test_weak_low_and_new_signals_are_left_out() -> None:
    epochs = [o.epoch for o in observed(seconds=0.5)]
    one = epochs[0].satellites[0]
    weak = replace(epochs[0], cn0=np.where([s == one for s in epochs[0].satellites], 20.0, epochs[0].cn0))
    first = preprocessor().clean(weak)
    assert isinstance(first, CleanEpoch)
    assert one not in first.satellites
    assert first.elevation.min() >= np.radians(10.0)
    fresh = replace(epochs[0], lock_s=np.zeros(len(epochs[0].satellites)))
    none = preprocessor().clean(fresh)
    assert isinstance(none, CleanEpoch)
    assert none.satellites == ()


def test_too_few_satellites_still_serve_who_knows_where_it_is() -> None:
    epochs = [o.epoch for o in observed(seconds=1.0)]
    cleaner = preprocessor()
    clean_all(cleaner, epochs[:5])
    keep = np.array([s in ("G07", "G03", "G14") for s in epochs[5].satellites])
    names = {name: getattr(epochs[5], name) for name in epochs[5].__dataclass_fields__}
    few = replace(
        epochs[5],
        **{name: value[keep] for name, value in names.items() if isinstance(value, np.ndarray)},
        satellites=tuple(np.array(epochs[5].satellites)[keep]),
        signals=tuple(np.array(epochs[5].signals)[keep]),
    )
    assert isinstance(cleaner.clean(few), Refused)
    near = circling(np.array([0.5]))[0][0]
    clean = cleaner.clean(few, near)
    assert isinstance(clean, CleanEpoch)
    assert 2 <= len(clean.satellites) <= 3


def test_a_base_takes_off_what_both_have() -> None:
    """Satellites and air of metres are gone; the antennas' own noise and multipath are off here."""
    options = replace(
        PERFECT, orbit=0.6, satellite_clock=0.5, ionosphere_residual=1.0, troposphere_residual=0.1, inter_system=1.0
    )
    above = sky(options)
    base = SimulatedReceiver("base", fixed_antenna(BASE_WORLD, DATUM), above, options, 1, 3.0, BASE_STATION)
    alone, helped = preprocessor(options), preprocessor(options, BASE_ECEF)
    for epoch in [o.epoch for o in base.observations()]:
        if epoch.t_ns <= START_NS + 2 * SECOND_NS:
            helped.add_base(epoch)
    last = observed(options, 2.5)[-8:]
    apart = clean_all(alone, [o.epoch for o in last])[-1]
    both = clean_all(helped, [o.epoch for o in last])[-1]
    assert set(both.systems) <= {"G-base", "E-base", "R-base", "C-base"}
    assert np.abs(spread(apart, apart.code)).max() > 1.0
    assert np.abs(spread(both, both.code)).max() < 0.05
    # What stays are the echoes around the base, which its carriers cannot tell from anything else in two seconds.
    assert both.sigma_slow.max() < 0.15 * apart.sigma_slow.max()
    assert both.sigma_drift.max() < 0.1 * apart.sigma_drift.max()


def heard(base: list[GnssEpoch], seconds: float) -> tuple[GnssPreprocessor, list[tuple[float, bool]]]:
    """A receiver's seconds, and whether differences were taken, with a base that nothing is known of beforehand."""
    cleaner, found = preprocessor(DEFAULT), list[tuple[float, bool]]()
    for o in rover(replace(DEFAULT, rate_hz=1.0), seconds).observations():
        for epoch in base:
            if 0 <= o.epoch.t_ns - epoch.t_ns < SECOND_NS:
                cleaner.add_base(epoch)
        clean = cleaner.clean(o.epoch)
        found += [(round(o.t_s), clean.differential)] if isinstance(clean, CleanEpoch) else []
    return cleaner, found


def standing(seconds: float) -> list[GnssEpoch]:
    above, options = sky(DEFAULT), GnssOptions.base()
    antenna = fixed_antenna(BASE_WORLD, DATUM)
    base = SimulatedReceiver("base", antenna, above, options, 1, seconds, BASE_STATION)
    return [replace(o.epoch, t_ns=round(o.epoch.t_ns, -6), p_ecef=BASE_ECEF) for o in base.observations()]


def test_differences_begin_when_a_base_says_where_it_stands_and_end_when_it_falls_silent() -> None:
    told = standing(20.0)
    untold = [replace(epoch, p_ecef=None) for epoch in told[2:5]]
    cleaner, found = heard([*untold, *told[5:8], *(replace(epoch, p_ecef=None) for epoch in told[8:10])], 30.0)
    assert found
    for t_s, differential in found:
        if t_s != 9 + MAX_AGE_S:  # the receiver's clock decides
            assert differential == (5 <= t_s < 9 + MAX_AGE_S)
    assert cleaner.base.fault == ""
    waiting, found = heard(untold, 8.0)
    assert "has not said where it stands" in waiting.base.fault
    assert not any(differential for _, differential in found)


def test_a_base_that_moves_is_refused_until_it_is_back() -> None:
    told = standing(12.0)
    moved = [replace(epoch, p_ecef=BASE_ECEF + (0.0, 1.5, 2.0)) for epoch in told[5:8]]
    cleaner, found = heard([*told[:5], *moved], 9.0)
    assert cleaner.base.fault == "the base station has moved by 2.50 m: put it back, or begin a new flight"
    assert [differential for _, differential in found] == [t_s < 5 for t_s, _ in found]
    cleaner, found = heard([*told[:5], *moved, *told[8:]], 11.0)
    assert cleaner.base.fault == ""
    assert found[-1][1]


def test_ranges_of_satellites_that_tell_no_group_delay_are_worth_less() -> None:
    """A precise orbit comes without one, and GPS's differ by 5 m."""
    told, untold = preprocessor(), GnssPreprocessor(GnssSettings())
    for message in broadcast(sky(PERFECT), 10.0):
        untold.add(replace(message, source="SP3") if isinstance(message, KeplerEphemeris) else message)
    epochs = [o.epoch for o in observed(seconds=2.0)]
    known, unknown = (clean_all(cleaner, epochs)[-1] for cleaner in (told, untold))
    assert known.satellites == unknown.satellites
    gps = np.array([name == "G" for name in known.systems])
    assert np.all(unknown.sigma_slow[gps] > 3.0)
    assert np.all(known.sigma_slow[gps] < 0.8 * unknown.sigma_slow[gps])


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_nonsense_never_ends_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cleaner = preprocessor()
    for o in EPOCHS:
        change = {
            name: np.where(rng.random(len(o.satellites)) < 0.3, rng.choice([np.nan, 0.0, -1e9, 1e300]), value)
            for name, value in vars(o).items()
            if isinstance(value, np.ndarray) and value.dtype == np.float64
        }
        assert isinstance(cleaner.clean(replace(o, **change)), CleanEpoch | Refused)


EPOCHS = [o.epoch for o in observed(seconds=0.3)]


def test_unbroken_carriers_of_a_real_receiver_tell_the_way_between_epochs(real_data: Callable[[str], Path]) -> None:
    """A walk with an F9P in the hand at 1 Hz: steps of a walker, where single points jump by metres.

    Doppler tells the velocity at the epochs alone, and the hand swings in between: a metre at most.
    """
    cleaner = GnssPreprocessor(GnssSettings())
    cleaned: list[CleanEpoch] = []
    for message in open_source(f"ubx:{real_data('gnss') / 'nhm.ubx'}"):
        if isinstance(message, GnssEpoch):
            clean = cleaner.clean(message)
            cleaned += [clean] if isinstance(clean, CleanEpoch) and clean.fix is not None else []
        else:
            cleaner.add(message)
    ways = [(way_by_carriers(a, b), a, b) for a, b in pairwise(cleaned)]
    known = [(way, a, b) for way, a, b in ways if way is not None]
    assert len(known) > 15
    for way, a, b in known:
        assert a.fix is not None
        assert b.fix is not None
        dt = (b.t_ns - a.t_ns) / SECOND_NS
        assert np.linalg.norm(way - (a.fix.velocity + b.fix.velocity) / 2 * dt) < 1.0
    lengths = np.array([np.linalg.norm(way) for way, _, _ in known])
    assert np.abs(np.diff(lengths)).max() < 1.0  # it stops within a second
    assert lengths.max() < 1.6


def way_by_carriers(a: CleanEpoch, b: CleanEpoch) -> F64 | None:
    """Displacement (3,) m, ECEF, between two epochs by the carriers that both have, if those are enough."""
    assert a.fix is not None
    here, there = geometric_range(a.p_satellite, a.fix.position)[0], geometric_range(b.p_satellite, a.fix.position)
    then = {arc: a.carrier[i] - here[i] for i, arc in enumerate(a.arcs) if arc}
    both = [i for i, arc in enumerate(b.arcs) if arc in then]
    if len(both) < 8:
        return None
    moved = np.array([b.carrier[i] - there[0][i] - then[b.arcs[i]] for i in both])
    H = np.column_stack([-there[1][both], np.ones(len(both))])
    return np.asarray(np.linalg.lstsq(H, moved, rcond=None)[0][:3])


def test_a_new_model_of_the_ionosphere_or_ephemeris_breaks_no_carrier_unseen() -> None:
    """A model that comes in flight moves codes alone; another ephemeris is taken late, and begins new arcs."""
    held = HeldEphemerides(broadcast(sky(PERFECT), 10.0))
    epoch = observed(PERFECT, 3.0)[-1].epoch
    before = correct(epoch, held, BASE_ECEF)
    newest = held.ionosphere()
    assert newest is not None
    held.add(replace(newest, alpha=tuple(3 * a + 1e-8 for a in newest.alpha)))
    after = correct(epoch, held, BASE_ECEF)
    np.testing.assert_array_equal(after.carrier, before.carrier)
    assert np.nanmax(np.abs(after.code - before.code)) > 0.5

    satellite = before.satellites[0]
    old = held.find(satellite, epoch.t_ns)
    assert old is not None
    fresh = replace(old, toe_ns=epoch.t_ns + 1, t_ns=epoch.t_ns)
    held.add(fresh)
    assert held.find(satellite, epoch.t_ns) is old
    assert held.find(satellite, old.toe_ns + 7300 * SECOND_NS) is fresh
    held.add(replace(fresh, health=1, toe_ns=epoch.t_ns + 2))
    newer = held.find(satellite, epoch.t_ns + 2)
    assert newer is not None
    assert not is_healthy(newer)


def test_an_epoch_whose_satellites_nobody_knows_is_cleaned_to_nothing() -> None:
    epoch = observed(PERFECT, 1.0)[-1].epoch
    nothing = correct(epoch, HeldEphemerides(), BASE_ECEF)
    assert CarrierLocks(GnssSelection()).step(0.0, nothing, np.zeros(0)).shape == (0,)
    cleaner = GnssPreprocessor(GnssSettings(), BASE_ECEF)
    cleaner.add_base(epoch)
    assert isinstance(cleaner.clean(epoch, BASE_ECEF), Refused)
