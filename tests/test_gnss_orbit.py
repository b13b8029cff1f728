"""Satellites are where RTKLIB and precise orbits say they are, and their clocks show what they say."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rtklib
from gnss_samples import ALPHA, BETA, DELAYS, NAVIGATION, STATES, WEEK
from hypothesis import given
from hypothesis import strategies as st

from air.gnss.atmosphere import klobuchar, saastamoinen
from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS, from_week
from air.gnss.orbit import (
    EARTH_RATE,
    clock_at,
    geometric_range,
    is_geostationary,
    states_at,
    states_at_transmission,
)
from air.gnss.precise_orbit import PreciseOrbit, fit_ephemeris, read_sp3
from air.gnss.rinex_lines import Lines
from air.gnss.rinex_navigation import read_navigation
from air.gnss.signals import LIGHT, frequency
from air.sources.source import open_source
from common.measurements import Ephemeris, GnssEpoch, Ionosphere, KeplerEphemeris

BROADCAST = {
    message.satellite: message
    for message in read_navigation(Lines(NAVIGATION.splitlines()))
    if not isinstance(message, Ionosphere)
}
KINDS = sorted(BROADCAST)
NOON_NS = from_week(WEEK, 116_700.0)


def state(ephemeris: Ephemeris, offset_s: float):
    states = states_at([ephemeris], NOON_NS, np.array([offset_s]))
    return states.position[0], states.velocity[0], states.clock[0], states.drift[0]


@pytest.mark.parametrize(("satellite", "tow", "position", "clock"), STATES)
def test_states_are_those_of_rtklib(satellite: str, tow: float, position: tuple[float, ...], clock: float) -> None:
    ours, _, our_clock, _ = state(BROADCAST[satellite], tow - 116_700.0)
    assert np.abs(ours - position).max() < 2e-6  # printed to a micrometre
    assert abs(our_clock - clock) < 1e-15


@pytest.mark.parametrize("satellite", KINDS)
@given(offset_s=st.floats(-1500, 1500))
def test_velocity_and_drift_are_the_rates_of_position_and_clock(satellite: str, offset_s: float) -> None:
    step_s = 0.5
    before, after = state(BROADCAST[satellite], offset_s - step_s), state(BROADCAST[satellite], offset_s + step_s)
    _, velocity, _, drift = state(BROADCAST[satellite], offset_s)
    # The third derivative of an orbit's position is below 1e-3 m/s³: it changes this difference by 4e-5 m/s.
    assert velocity == pytest.approx((after[0] - before[0]) / (2 * step_s), abs=1e-4)
    assert drift == pytest.approx((after[2] - before[2]) / (2 * step_s), abs=1e-14)


@given(offset_s=st.floats(-600, 600), range_m=st.floats(1.9e7, 4.2e7), clock_s=st.floats(-1e-3, 1e-3))
def test_a_signal_left_when_the_satellites_clock_said_so(offset_s: float, range_m: float, clock_s: float) -> None:
    """Found from the receiver's time tag and pseudorange alone, whatever the receiver's clock shows."""
    ephemerides = [BROADCAST[satellite] for satellite in KINDS]
    sent = states_at(ephemerides, NOON_NS, np.full(len(KINDS), offset_s))
    shown = clock_at(ephemerides, NOON_NS, np.full(len(KINDS), offset_s) + sent.clock)
    tag_ns = NOON_NS + round((offset_s + range_m / LIGHT + clock_s) * 1e9)
    tag_s = (tag_ns - NOON_NS) * 1e-9
    pseudorange = LIGHT * (tag_s - (offset_s + shown))
    found = states_at_transmission(ephemerides, tag_ns, pseudorange)
    assert np.abs(found.position - sent.position).max() < 1e-4  # 30 ns of relativity at 3.9 km/s
    assert np.abs(found.clock - sent.clock).max() < 1e-15


@given(st.lists(st.floats(-3e7, 3e7), min_size=3, max_size=3), st.floats(-6e6, 6e6))
def test_the_sagnac_correction_is_the_rotation_of_the_earth_during_the_flight(sat: list[float], y: float) -> None:
    p, receiver = np.array(sat), np.array([6.3e6, y, 1e6])
    if np.linalg.norm(p) < 2e7:
        return
    found = geometric_range(p[None], receiver)[0][0]
    flight_s = np.linalg.norm(p - receiver) / LIGHT
    for _ in range(5):
        a = EARTH_RATE * flight_s
        turned = np.array([p[0] * np.cos(a) + p[1] * np.sin(a), p[1] * np.cos(a) - p[0] * np.sin(a), p[2]])
        flight_s = np.linalg.norm(turned - receiver) / LIGHT
    assert found == pytest.approx(LIGHT * flight_s, abs=2e-3)  # the usual correction is of first order


@pytest.mark.parametrize(("tow", "place", "angles", "ionosphere", "troposphere"), DELAYS)
def test_delays_are_those_of_rtklib(tow, place, angles, ionosphere, troposphere) -> None:
    position = np.array([np.radians(place[0]), np.radians(place[1]), place[2]])
    azimuth, elevation = (np.array([np.radians(angle)]) for angle in angles)
    model = Ionosphere(0, "G", ALPHA, BETA)
    delay, sigma = klobuchar(model, from_week(WEEK, tow), position, azimuth, elevation)
    assert delay == pytest.approx(ionosphere, abs=2e-6)
    assert sigma == delay / 2
    assert saastamoinen(position, elevation)[0] == pytest.approx(troposphere, abs=2e-6)


def test_no_ephemeris_and_a_senseless_one_give_nan() -> None:
    broken = dict.fromkeys(("sqrt_a", "e"), float("nan"))
    ephemeris = KeplerEphemeris(**{**vars(BROADCAST["G06"]), **broken})
    states = states_at([None, ephemeris, BROADCAST["G06"]], NOON_NS, np.zeros(3))
    assert np.isnan(states.position).all(axis=1).tolist() == [True, True, False]
    far = states_at([BROADCAST["R01"]], NOON_NS + 400 * 86_400 * SECOND_NS, np.zeros(1))
    assert np.isnan(far.position).all()


def test_the_closest_issue_is_found_until_it_is_too_old() -> None:
    first = BROADCAST["G06"]
    second = KeplerEphemeris(**{**vars(first), "toe_ns": first.toe_ns + 7200 * SECOND_NS})
    store = Ephemerides([second, first])
    assert store.find("G06", first.toe_ns + 3500 * SECOND_NS) == first
    assert store.find("G06", first.toe_ns + 3700 * SECOND_NS) == second
    assert store.find("G06", second.toe_ns + 7100 * SECOND_NS) == second
    assert store.find("G06", second.toe_ns + 7300 * SECOND_NS) is None
    assert store.find("G07", first.toe_ns) is None


def test_frequencies_follow_bands_and_glonass_channels() -> None:
    assert frequency("G01", "1C") == frequency("E01", "1X") == 1575.42e6
    assert frequency("R07", "1C", -7) == pytest.approx(1598.0625e6)
    assert frequency("R07", "2C", 6) == pytest.approx(1248.625e6)
    assert frequency("C01", "2I") == 1561.098e6
    assert np.isnan(
        [frequency("R07", "1C", 9), frequency("X01", "1C"), frequency("G01", ""), frequency("", "1C")]
    ).all()
    assert is_geostationary("C03")
    assert is_geostationary("C60")
    assert not is_geostationary("C06")


# Real recordings


RECORDINGS = {
    "matrtklib_static": ("matrtklib_static/rover.obs", "matrtklib_static/base.nav", 1000),
    "16dBatt": (
        "16dBatt_no_interference_coldstart.obs.gz",
        "16dBatt_no_interference_coldstart.nav.gz",
        10_000,
    ),
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_satellites_of_a_recording_are_where_rtklib_puts_them(
    name: str, real_data: Callable[[str], Path], tmp_path: Path
) -> None:
    obs, nav, least = RECORDINGS[name]
    gnss = real_data("gnss")
    paths = [plain(gnss / obs, tmp_path), plain(gnss / nav, tmp_path)]
    rtklib.single_point(tmp_path, *paths, "GREJC", 10.0, trace=4)
    traced: dict[int, dict[str, tuple[np.ndarray, float]]] = {}
    for t_ns, satellite, position, clock in rtklib.traced_states(tmp_path / "out.pos.trace"):
        traced.setdefault(t_ns, {})[satellite] = position, clock
    broadcast = Ephemerides()
    compared = 0
    for item in open_source(f"rinex:{paths[0]},{paths[1]}"):
        broadcast.add(item)
        known = traced.get(round(item.t_ns, -6), {}) if isinstance(item, GnssEpoch) else {}
        rows = {satellite: i for i, satellite in reversed(list(enumerate(item.satellites)))} if known else {}
        names = [s for s in rows if s in known and np.isfinite(item.pseudorange[rows[s]])]
        if not names:
            continue
        pseudorange = item.pseudorange[[rows[s] for s in names]]
        states = states_at_transmission([broadcast.find(s, item.t_ns) for s in names], item.t_ns, pseudorange)
        assert np.abs(states.position - [known[s][0] for s in names]).max() < 0.01
        assert np.abs(states.clock - [known[s][1] for s in names]).max() < 1e-10
        compared += len(names)
    assert compared > least


def plain(path: Path, folder: Path) -> Path:
    """The file, unpacked into a folder where it is gzipped: RTKLIB would need gzip in its path."""
    import gzip

    if path.suffix != ".gz":
        return path
    unpacked = folder / path.stem
    unpacked.write_bytes(gzip.decompress(path.read_bytes()))
    return unpacked


def test_an_ephemeris_fitted_to_precise_orbits_tells_where_the_satellite_is_in_between(
    real_data: Callable[[str], Path],
) -> None:
    """One position is left out; the fit to the others finds it."""
    text = (real_data("comma2k19") / "Sta20124_excerpt_GPS.sp3.txt").read_text()
    orbits = read_sp3(Lines(text.splitlines()))
    assert len(orbits) == 9
    for orbit in orbits:
        rest = np.arange(len(orbit.t_ns)) != 2
        fit = fit_ephemeris(
            PreciseOrbit(orbit.satellite, orbit.t_ns[rest], orbit.position[rest], orbit.clock[rest]),
            int(orbit.t_ns[2]),
        )
        assert fit is not None
        found = states_at([fit], int(orbit.t_ns[2]), np.zeros(1))
        assert np.abs(found.position[0] - orbit.position[2]).max() < 1.0
        relativity = found.clock[0] - orbit.clock[2]
        assert abs(relativity) < 5e-8  # up to 45 ns at an eccentricity of 0.02


def test_damaged_orbits_are_counted() -> None:
    lines = Lines(
        ["*  2018 08 02 15 45  0.00000000", "PG02 -14618.0 x", "PG03", "*  2018 13 02", "PG02 1.0 2.0 3.0 4.0"]
    )
    assert read_sp3(lines) == []
    assert lines.damaged == 3
