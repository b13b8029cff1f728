"""The simulated GNSS: errors with switches, bytes for the driver."""

from __future__ import annotations

import hashlib
import tracemalloc
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from gnss_scene import (
    DATUM,
    T_ECEF_WORLD,
    broadcast,
    circling,
    correlation_time,
    longest_gap,
    rover,
    sky,
)

from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS, from_week, to_week
from air.gnss.positioning import PointPosition, find_position
from air.gnss.settings import PositioningSettings
from air.gnss.signals import LIGHT
from air.sensors.gnss_ublox import UbloxReceiver
from air.sources.simulated.gnss.antenna import carried_antenna
from air.sources.simulated.gnss.gnss_options import GnssOptions, intervals
from air.sources.simulated.gnss.receiver_clock import ReceiverClock
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.simulated.motion.multirotor import fly
from air.sources.simulated.survey import START_NS
from common.arrays import F64, Bool
from common.config import parse
from common.errors import ConfigError, SourceError
from common.geo import geodetic_to_enu
from common.measurements import (
    FixKind,
    GlonassEphemeris,
    GnssEpoch,
    Ionosphere,
    KeplerEphemeris,
    Measurement,
    ReceiverSolution,
)

PERFECT = GnssOptions.perfect()
DEFAULT = GnssOptions()


def decoded(packets: Iterator[tuple[float, bytes]]) -> list[Measurement]:
    """What the driver makes of a receiver's bytes."""
    driver = UbloxReceiver()
    found = [measurement for _, data in packets for measurement in driver.feed(data, 0)]
    assert driver.counts.dropped_bytes == driver.counts.refused == 0
    return found


def solutions(measurements: list[Measurement]) -> list[ReceiverSolution]:
    return [m for m in measurements if isinstance(m, ReceiverSolution)]


# Measurements


def test_doppler_is_the_derivative_of_the_carrier() -> None:
    """Without noise, central differences over 0.2 s; bytes round Doppler to 0.05 mm/s (32 bits of up to 5 kHz)."""
    options = replace(PERFECT, clock_drift_ppm=0.5)
    epochs = [o.epoch for o in rover(options, 30.0).observations()]
    checked = 0
    for before, now, after in zip(epochs, epochs[1:], epochs[2:], strict=False):
        if not before.satellites == now.satellites == after.satellites:
            continue
        rate_hz = (after.carrier_phase - before.carrier_phase) / ((after.t_ns - before.t_ns) / SECOND_NS)
        error = (rate_hz + now.doppler) * LIGHT / 1575.42e6
        assert np.nanmax(np.abs(error)) < 1e-3
        checked += np.isfinite(error).sum()
    assert checked > 10_000


def test_code_minus_carrier_is_constant_but_for_twice_the_ionosphere() -> None:
    epochs = [o.epoch for o in rover(replace(PERFECT, ionosphere=0.0), 20.0).observations()]
    key = ("G", "1C")
    held: dict[str, list[float]] = {}
    for epoch in epochs:
        for i, (satellite, signal) in enumerate(zip(epoch.satellites, epoch.signals, strict=True)):
            if (satellite[0], signal) == key:
                metres = epoch.carrier_phase[i] * LIGHT / 1575.42e6
                held.setdefault(satellite, []).append(epoch.pseudorange[i] - metres)
    assert len(held) > 5
    assert max(np.ptp(values) for values in held.values()) < 1e-5


def test_ambiguities_are_whole_numbers_that_only_slips_change() -> None:
    observed = list(rover(replace(DEFAULT, slips=400.0, jamming="20-50", jamming_db=14.0), 60.0).observations())
    last: dict[tuple[str, str], tuple[float, float]] = {}
    lost: set[tuple[str, str]] = set()
    slips = found_again = 0
    for o in observed:
        e = o.epoch
        for i, key in enumerate(zip(e.satellites, e.signals, strict=True)):
            if np.isnan(e.carrier_phase[i]):
                last.pop(key, None)
                lost.add(key)
                continue
            if key in lost:
                lost.remove(key)
                found_again += 1
                assert e.lock_s[i] == 0.0
            whole = o.ambiguity[i] if not e.half_cycle[i] else np.floor(o.ambiguity[i])
            assert whole == round(whole)
            if key in last and last[key][0] != whole:
                slips += 1
                assert e.lock_s[i] < last[key][1] + 0.1
                assert e.lock_s[i] < 1.0
            last[key] = whole, e.lock_s[i]
    assert slips > 5
    assert found_again > 5


def test_the_clock_stays_within_half_a_millisecond_and_says_when_it_jumps() -> None:
    options = replace(PERFECT, rate_hz=2.0, clock=1.0, clock_drift_ppm=10.0, systems="G")
    observed = list(rover(options, 300.0).observations())
    assert max(abs(o.clock) for o in observed) <= 0.5e-3 + 1e-5
    jumps = [b.clock - a.clock for a, b in pairwise(observed) if b.epoch.clock_reset]
    assert jumps
    assert all(abs(abs(jump) - 1e-3) < 1e-4 for jump in jumps)
    tags = [o.epoch.t_ns - START_NS - round(o.t_s * 1e9) - round(o.clock * 1e9) for o in observed]
    assert max(map(abs, tags)) <= 2  # the tag is the true time and the clock's error, to the rounding of both


def test_a_clock_is_a_smooth_function_of_time() -> None:
    clock = ReceiverClock(1.0, 0.5, 1, 54)
    t_s = np.linspace(0.0, 300.0, 3001)
    bias, drift = clock.at(t_s)
    np.testing.assert_allclose(np.diff(bias) / 0.1, (drift[1:] + drift[:-1]) / 2, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(ReceiverClock(1.0, 0.5, 1, 54).at(t_s[::-1])[0][::-1], bias)
    np.testing.assert_allclose(clock.time_of(t_s + bias), t_s, rtol=0, atol=1e-12)
    assert not ReceiverClock(0.0, 0.0, 1, 54).at(t_s)[0].any()


@pytest.mark.parametrize(
    ("field", "least"),
    [
        *(("multipath", 0.2), ("code", 0.1), ("orbit", 0.1), ("satellite_clock", 0.1)),
        *(("ionosphere_residual", 0.2), ("ionosphere_gradient", 0.2), ("ionosphere_ripples", 0.03)),
    ],
)
def test_every_error_has_its_switch(field: str, least: float) -> None:
    options = replace(PERFECT, rate_hz=1.0)
    clean, spoilt = (
        list(rover(o, 2.0).observations())[1].epoch
        for o in (options, replace(options, **{field: getattr(DEFAULT, field)}))
    )
    assert clean.satellites == spoilt.satellites
    assert np.std(clean.pseudorange - spoilt.pseudorange) > least


def test_noise_is_as_large_as_the_receiver_says() -> None:
    """In units of the receiver's own sigma, which it rounds to powers of two; GLONASS is half as noisy again."""
    noisy = replace(PERFECT, code=0.3)
    pairs = zip(rover(PERFECT, 20.0).observations(), rover(noisy, 20.0).observations(), strict=True)
    z = np.concatenate([(a.epoch.pseudorange - b.epoch.pseudorange) / b.epoch.sigma_pseudorange for a, b in pairs])
    assert 0.7 < z.std() < 1.6
    assert np.abs(z).max() < 10.0


def test_multipath_stays_for_a_minute_where_it_is_told_to() -> None:
    options = replace(PERFECT, multipath=2.0, multipath_s=60.0, rate_hz=1.0, systems="C")
    observed = list(rover(options, 900.0, antenna=circling).observations())
    times = []
    for name in ("C01", "C03", "C04"):
        values = [o.multipath[o.epoch.satellites.index(name)] for o in observed]
        times.append(correlation_time(np.array(values), 1.0))
    assert 25.0 < np.mean(times) < 110.0  # an estimate of 60 s from three stretches of fifteen minutes


# What is received


def test_nothing_is_received_in_an_outage_and_all_comes_back() -> None:
    observed = list(rover(replace(DEFAULT, outage="10-20"), 30.0).observations())
    count = {round(o.t_s, 1): len(o.epoch.satellites) for o in observed}
    assert all(n == 0 for t, n in count.items() if 10.05 < t < 19.95)
    assert all(n > 50 for t, n in count.items() if t < 9.95 or t > 22)
    back = next(o.epoch for o in observed if o.t_s > 24)
    assert np.nanmax(back.lock_s) < 5.0


def test_jamming_makes_signals_weak_then_loses_them() -> None:
    observed = list(rover(replace(DEFAULT, jamming="5-45", jamming_db=30.0, rate_hz=2.0), 60.0).observations())
    at = {round(o.t_s): o.epoch for o in observed}
    assert np.median(at[10].cn0) < np.median(at[2].cn0) - 5
    assert len(at[25].satellites) < 0.2 * len(at[2].satellites)
    assert len(at[58].satellites) > 0.9 * len(at[2].satellites)


def test_buildings_hide_satellites() -> None:
    asked = []

    def wall(p_world: F64, direction: F64) -> Bool:
        asked.append(p_world)
        return np.asarray(direction[:, 0] > 0)

    observed = list(rover(replace(DEFAULT, rate_hz=1.0), 5.0, blocked=wall).observations())
    assert all((np.sin(o.azimuth) <= 1e-3).all() and len(o.azimuth) > 10 for o in observed)
    np.testing.assert_allclose(asked[0], [30.0, 0.0, 40.0], atol=1e-6)


def test_faulty_satellites_do_not_say_so_and_are_found_out() -> None:
    options = replace(PERFECT, rate_hz=1.0, fault=2, fault_bias=50.0, fault_start=5.0, systems="GE")
    above = sky(options)
    names = {name for name, bad in zip(above.satellites, above.faulty, strict=True) if bad}
    assert len(names) == 2
    known = Ephemerides(broadcast(above, 10.0))
    before, after = (o.epoch for o in rover(options, 10.0).observations() if round(o.t_s) in (4, 8))
    found = find_position(after, known, PositioningSettings())
    assert isinstance(found, PointPosition)
    assert {name for name, why in found.rejected.items() if "residual" in why} == names
    assert isinstance(find_position(before, known, PositioningSettings()), PointPosition)


def test_epochs_come_at_7_to_8_hz_as_in_the_paper() -> None:
    times = [o.t_s for o in rover(replace(DEFAULT, systems="G"), 120.0).observations()]
    assert 7.0 < len(times) / 120 < 8.0
    assert 0.25 < longest_gap(times) < 1.5
    assert len(list(rover(replace(DEFAULT, systems="G", missing=0.0), 10.0).observations())) in (100, 101)


# Bytes


def test_the_driver_gives_back_the_same_measurements_and_ephemerides() -> None:
    receiver = rover(replace(DEFAULT, missing=0.5), 65.0)
    packets = list(receiver.packets())
    times = [t for t, _ in packets]
    assert times == sorted(times)
    found = decoded(iter(packets))
    epochs = [m for m in found if isinstance(m, GnssEpoch)]
    for epoch, told in zip(epochs, (o.epoch for o in receiver.observations()), strict=True):
        for field in fields(GnssEpoch):
            ours, theirs = getattr(told, field.name), getattr(epoch, field.name)
            if isinstance(ours, np.ndarray):
                np.testing.assert_array_equal(theirs, ours, err_msg=field.name)
            else:
                assert theirs == ours
    assert [s.kind for s in solutions(found)] == [FixKind.FIX_3D] * len(epochs)
    above = sky(DEFAULT)
    sent = {(e.satellite, e.toe_ns): e for e in broadcast(above, 65.0) if not isinstance(e, Ionosphere)}
    heard = [m for m in found if isinstance(m, KeplerEphemeris | GlonassEphemeris)]
    assert {m.satellite[0] for m in heard} == set("GREC")
    assert {m.satellite for m in heard} >= set(epochs[-1].satellites) - {
        name for name in epochs[-1].satellites if name not in epochs[0].satellites
    }
    for message in heard:
        assert message == replace(sent[message.satellite, message.toe_ns], t_ns=message.t_ns)
    (model,) = {replace(m, t_ns=0) for m in found if isinstance(m, Ionosphere)}
    assert model == replace(above.constellation.beidou_ionosphere, t_ns=0)


def test_the_ionosphere_of_gps_comes_with_its_page() -> None:
    """Page 18 of 25, each 30 s: from 8 min 30 s after a multiple of 12 min 30 s of the week."""
    week, tow_s = to_week(START_NS)
    start_ns = from_week(week, tow_s // 750 * 750 + 500)
    receiver = rover(replace(DEFAULT, systems="G", rate_hz=1.0, missing=0.0), 45.0, start_ns=start_ns)
    assert [m.system for m in decoded(receiver.packets()) if isinstance(m, Ionosphere)] == ["G"]


def test_the_receivers_own_solution_follows_the_flight() -> None:
    trajectory, _ = fly(FlightOptions(start="air"), 1, 30.0, np.zeros(3))
    arm = np.array([-0.12, 0.02, 0.22])
    antenna = carried_antenna(trajectory, arm, DATUM)
    packets = list(rover(PERFECT, 30.0, antenna=antenna).packets())
    errors, speed_errors = [], []
    for solution in solutions(decoded(iter(packets)))[20:]:
        t_s = np.array([(solution.t_ns - START_NS) / SECOND_NS])
        p_world = geodetic_to_enu(DATUM, solution.latitude_deg, solution.longitude_deg, solution.height)
        p, v = antenna(t_s)
        errors.append(p_world - T_ECEF_WORLD.inverse().apply(p[0]))
        speed_errors.append(solution.v_enu - v[0] @ T_ECEF_WORLD.R)
    # Without errors of the signals what is left are the filter's lag in turns and gusts, and millimetres of NAV-PVT.
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 0.15
    assert np.sqrt(np.mean(np.square(speed_errors), axis=0)).max() < 0.3


def test_the_receivers_own_position_is_of_the_one_and_a_half_metre_class_from_the_first_fix() -> None:
    """The median of horizontal errors is what such receivers are named by; heights are 1.7 times as uncertain.

    Of a flight the air's error is one draw: a dozen tell the median to a fifth.
    """
    errors = []
    for seed in range(1, 13):
        first = next(iter(solutions(decoded(rover(DEFAULT, 1.0, seed).packets()))))
        p_world = geodetic_to_enu(DATUM, first.latitude_deg, first.longitude_deg, first.height)
        truth, _ = circling(np.array([(first.t_ns - START_NS) / SECOND_NS]))
        errors.append(p_world - T_ECEF_WORLD.inverse().apply(truth[0]))
    east, north, up = np.array(errors).T
    assert 0.6 < np.median(np.hypot(east, north)) < 1.5 * 1.2
    assert np.sqrt(np.mean(up**2)) < 1.7 * 1.5 * 1.2


def test_an_antenna_moves_as_the_body_turns() -> None:
    trajectory, _ = fly(FlightOptions(), 1, 60.0, np.zeros(3))
    antenna = carried_antenna(trajectory, np.array([0.5, -0.3, 0.2]), DATUM)
    t_s, h = np.arange(10.0, 50.0, 0.37), 1e-3
    rate = (antenna(t_s + h)[0] - antenna(t_s - h)[0]) / (2 * h)
    np.testing.assert_allclose(rate, antenna(t_s)[1], rtol=0, atol=1e-5)


def test_a_cold_receiver_finds_satellites_and_its_position_within_a_minute_or_so() -> None:
    found = decoded(rover(replace(DEFAULT, cold=1, rate_hz=1.0, missing=0.0), 100.0).packets())
    epochs = [m for m in found if isinstance(m, GnssEpoch)]
    assert not epochs[5].satellites
    assert len(epochs[-1].satellites) > 50
    kinds = [s.kind for s in solutions(found)]
    assert kinds[20] is FixKind.NONE
    first = kinds.index(FixKind.FIX_3D)
    assert 40 < first < 95
    assert set(kinds[first:]) == {FixKind.FIX_3D}


def test_the_same_seed_gives_the_same_bytes() -> None:
    def digest(seed: int) -> str:
        return hashlib.sha256(b"".join(data for _, data in rover(DEFAULT, 12.0, seed).packets())).hexdigest()

    assert digest(1) == digest(1) != digest(2)
    receiver = rover(DEFAULT, 5.0)
    assert list(receiver.packets()) == list(receiver.packets())


def test_a_long_flight_takes_little_memory() -> None:
    packets = rover(replace(DEFAULT, rate_hz=2.0, missing=0.0, systems="GE"), 200.0).packets()
    for _ in range(200):
        next(packets)
    tracemalloc.start()
    for _ in packets:
        pass
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2e6  # an epoch alone takes 10 kB: they are not kept


# Options


def test_impossible_options_are_named() -> None:
    with pytest.raises(SourceError, match=r"'outage' is '60'.*60-180"):
        intervals("60", "outage")
    with pytest.raises(SourceError, match="'jamming'"):
        rover(replace(DEFAULT, jamming="9-5"), 10.0)
    with pytest.raises(SourceError, match=r"'systems' is 'GX', must be some of GREC"):
        sky(replace(DEFAULT, systems="GX"))
    with pytest.raises(ConfigError, match="multipat"):
        parse({"multipat": 0.0}, GnssOptions)
    with pytest.raises(ConfigError, match="missing"):
        parse({"missing": 2.0}, GnssOptions)
    assert intervals("1-2,3.5-4", "outage") == ((1.0, 2.0), (3.5, 4.0))
