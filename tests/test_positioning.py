"""A position from one epoch: exact where ranges are, honest where they are not, refused where they contradict."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rtklib
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from air.gnss.atmosphere import TYPICAL, klobuchar, saastamoinen
from air.gnss.ephemerides import Ephemerides
from air.gnss.gnss_time import SECOND_NS, from_week
from air.gnss.least_squares import chi_square_limit
from air.gnss.orbit import EARTH_RATE, geometric_range, states_at
from air.gnss.positioning import (
    PointPosition,
    Refused,
    azimuth_elevation,
    find_position,
)
from air.gnss.ranges import group_delay
from air.gnss.rinex_writer import write_navigation, write_observations
from air.gnss.settings import PositioningSettings
from air.gnss.signals import LIGHT, frequency
from air.sources.source import open_source
from common.arrays import F64
from common.errors import ConfigError
from common.geo import ecef_to_geodetic, geodetic_to_ecef
from common.measurements import Ephemeris, GnssEpoch, Ionosphere, KeplerEphemeris

NOON_NS = from_week(2320, 129_600.0)
SIGNALS = {"G": ("1C", "2W"), "E": ("1C", "7Q")}
SETTINGS = PositioningSettings(systems="GE")


def test_beidou_s_ionosphere_is_that_of_gps_told_otherwise() -> None:
    """Both of 2021-10-31, over England, are 0.3 m apart, of 4 m; BeiDou's numbers in GPS's formula are not."""
    gps = Ionosphere(0, "G", (1.2107e-8, 0.0, -1.19209e-7, 0.0), (94_208.0, 0.0, -196_608.0, 0.0))
    alpha, beta = (1.490116e-8, 7.45058e-8, -8.34465e-7, 1.430511e-6), (131_072.0, -262_144.0, -262_144.0, 1_179_648.0)
    place, south, angle = np.array([*np.radians([51.76, -1.26]), 100.0]), np.array([np.pi]), np.radians([30.0])
    told, by_beidou, misread = (
        klobuchar(model, from_week(2181, 15 * 3600.0), place, south, angle)[0][0]
        for model in (gps, Ionosphere(0, "C", alpha, beta), Ionosphere(0, "G", alpha, beta))
    )
    assert told == pytest.approx(4.0, abs=0.2)
    assert abs(by_beidou - told) < 0.3 < abs(misread - told)


def constellation() -> list[KeplerEphemeris]:
    """Thirty satellites each of GPS and Galileo in six planes, with clocks of microseconds and group delays."""
    return [
        KeplerEphemeris(
            t_ns=NOON_NS,
            satellite=f"{system}{plane * 5 + slot + 1:02d}",
            source="LNAV" if system == "G" else "INAV",
            toe_ns=NOON_NS - 600 * SECOND_NS,
            toc_ns=NOON_NS - 600 * SECOND_NS,
            iode=1,
            iodc=1,
            af0=1e-5 * (plane - slot),
            af1=1e-12 * slot,
            af2=0.0,
            sqrt_a=sqrt_a,
            e=0.002 * slot,
            i0=0.96,
            omega0=plane * np.pi / 3 + shift,
            omega=0.3,
            m0=slot * 2 * np.pi / 5 + plane * 0.5 + shift,
            delta_n=4e-9,
            idot=1e-10,
            omega_dot=-8e-9,
            cuc=1e-6,
            cus=5e-6,
            crc=250.0,
            crs=-40.0,
            cic=1e-8,
            cis=-5e-8,
            group_delay=(1e-9 * slot, 2e-9 * plane),
            accuracy=2.0,
            health=0,
        )
        for system, sqrt_a, shift in (("G", 5153.7, 0.0), ("E", 5440.6, 0.4))
        for plane in range(6)
        for slot in range(5)
    ]


CONSTELLATION = constellation()
BROADCAST = Ephemerides(CONSTELLATION)


def observe(
    place: F64,
    velocity: F64 | None = None,
    clock_s: float = 0.0,
    drift: float = 0.0,
    errors: dict[str, float] | None = None,
    rate_errors: dict[str, float] | None = None,
    mask_deg: float = 11.0,
    keep: int = 99,
) -> GnssEpoch:
    """What a perfect receiver measures at a place (ECEF m) while its clock is ahead by `clock_s`."""
    velocity = np.zeros(3) if velocity is None else velocity
    n = len(CONSTELLATION)
    sent_s = np.full(n, -0.07)
    for _ in range(6):  # when the signals left that arrive at noon, GPST
        states = states_at(CONSTELLATION, NOON_NS, sent_s)
        distance, line = geometric_range(states.position, place)
        sent_s = -distance / LIGHT
    geodetic = ecef_to_geodetic(place) * (np.pi / 180, np.pi / 180, 1)
    azimuth, elevation = azimuth_elevation(line, geodetic)
    up = np.flatnonzero(elevation > np.radians(mask_deg))[:keep]
    shown = states.clock  # with relativity: how far the satellite's clock is ahead
    tropo = saastamoinen(geodetic, elevation[up])[0]
    iono = klobuchar(TYPICAL, NOON_NS + round(clock_s * 1e9), geodetic, azimuth[up], elevation[up])[0]
    turn = EARTH_RATE / LIGHT
    p, v = states.position, states.velocity
    rate = (
        np.einsum("ij,ij->i", v - velocity, line)
        + turn * (v[:, 1] * place[0] - v[:, 0] * place[1] + p[:, 1] * velocity[0] - p[:, 0] * velocity[1])
        + LIGHT * (drift - states.drift)
    )
    rows = []
    for j, i in enumerate(up):
        ephemeris = CONSTELLATION[i]
        for signal in SIGNALS[ephemeris.satellite[0]]:
            f = frequency(ephemeris.satellite, signal)
            code = distance[i] + LIGHT * (clock_s - shown[i]) + tropo[j] + iono[j] * (1575.42e6 / f) ** 2
            code += group_delay(ephemeris, signal, f) + (errors or {}).get(ephemeris.satellite, 0.0)
            doppler = -(rate[i] + (rate_errors or {}).get(ephemeris.satellite, 0.0)) * f / LIGHT
            rows.append((ephemeris.satellite, signal, code, doppler))
    return epoch_of(rows, NOON_NS + round(clock_s * 1e9))


def epoch_of(rows: list[tuple[str, str, float, float]], t_ns: int) -> GnssEpoch:
    n = len(rows)
    unknown = np.full(n, np.nan)
    return GnssEpoch(
        t_ns=t_ns,
        receiver="gnss",
        satellites=tuple(row[0] for row in rows),
        signals=tuple(row[1] for row in rows),
        pseudorange=np.array([row[2] for row in rows], float),
        carrier_phase=unknown,
        doppler=np.array([row[3] for row in rows], float),
        cn0=np.full(n, 45.0),
        lock_s=unknown,
        half_cycle=np.zeros(n, bool),
        sigma_pseudorange=unknown,
        sigma_carrier_phase=unknown,
        sigma_doppler=unknown,
        channel=np.zeros(n, np.int32),
    )


WUHAN = geodetic_to_ecef(30.5, 114.4, 60.0)


def solved(epoch: GnssEpoch, settings: PositioningSettings = SETTINGS, **options) -> PointPosition:
    found = find_position(epoch, BROADCAST, settings, **options)
    assert isinstance(found, PointPosition), found
    return found


@settings(max_examples=40)
@given(
    latitude=st.floats(-89, 89),
    longitude=st.floats(-180, 180),
    height=st.floats(-50, 9000),
    clock_ms=st.floats(-20, 20),
    drift=st.floats(-1e-6, 1e-6),
    velocity=st.lists(st.floats(-100, 100), min_size=3, max_size=3),
    dual=st.booleans(),
)
def test_place_velocity_and_clock_are_found_from_nothing(
    latitude: float, longitude: float, height: float, clock_ms: float, drift: float, velocity: list[float], dual: bool
) -> None:
    place = geodetic_to_ecef(latitude, longitude, height)
    epoch = observe(place, np.array(velocity), clock_ms * 1e-3, drift)
    found = solved(epoch, dataclasses.replace(SETTINGS, ionosphere_free=dual))
    # The clock is counted in whole ns, 0.15 m of range common to all; the atmosphere at the place found is the same.
    assert found.position == pytest.approx(place, abs=2e-3)
    assert found.velocity == pytest.approx(velocity, abs=1e-4)
    assert found.drift == pytest.approx(drift, abs=1e-12)
    assert list(found.clocks.values()) == pytest.approx([clock_ms * 1e-3] * len(found.clocks), abs=2e-9)
    assert found.chi_square < 1e-3


def test_a_start_nearby_leads_to_the_same_place() -> None:
    epoch = observe(WUHAN)
    cold, warm = solved(epoch), solved(epoch, near=WUHAN + 300.0)
    assert warm.position == pytest.approx(cold.position, abs=1e-5)
    assert warm.used == cold.used
    lost = solved(epoch, near=-WUHAN)
    assert lost.position == pytest.approx(cold.position, abs=1e-5)


def test_sigma_tells_how_large_errors_are() -> None:
    """Errors drawn from the model of errors give positions that scatter as the covariance says."""
    rng = np.random.default_rng(3)
    clean = solved(observe(WUHAN))
    normalised = []
    for _ in range(150):
        errors = {satellite: rng.normal(0, 3.0) for satellite in clean.used}
        found = solved(observe(WUHAN, errors=errors), dataclasses.replace(SETTINGS, exclude_outliers=False))
        off = found.position - WUHAN
        normalised.append(off @ np.linalg.solve(found.covariance, off) / 3)
    assert 0.5 < np.mean(normalised) < 2.0  # the model says 2.6 to 4 m by elevation, drawn were 3 m for all


@pytest.mark.parametrize(
    "faults", [{"G01": 150.0}, {"G01": -90.0, "E01": 200.0}, {"G01": 1e5, "E01": 80.0, "E02": -300.0}]
)
def test_wrong_ranges_are_excluded_and_named(faults: dict[str, float]) -> None:
    visible = solved(observe(WUHAN)).used
    rename = dict(zip(faults, visible[:: len(visible) // len(faults)], strict=False))
    wrong = {rename[name]: error for name, error in faults.items()}
    found = solved(observe(WUHAN, errors=wrong))
    assert {satellite for satellite, why in found.rejected.items() if "residual" in why} == set(wrong)
    assert np.abs(found.position - WUHAN).max() < 0.01


def test_a_wrong_doppler_spoils_neither_velocity_nor_position() -> None:
    wrong = solved(observe(WUHAN)).used[2]
    found = solved(observe(WUHAN, np.array([3.0, -2.0, 1.0]), rate_errors={wrong: 12.0}))
    assert found.rejected_rates == (wrong,)
    assert found.velocity == pytest.approx([3.0, -2.0, 1.0], abs=1e-4)


def test_an_epoch_that_contradicts_itself_is_refused() -> None:
    rng = np.random.default_rng(1)
    wild = {satellite: rng.normal(0, 400.0) for satellite in solved(observe(WUHAN)).used}
    found = find_position(observe(WUHAN, errors=wild), BROADCAST, SETTINGS)
    assert isinstance(found, Refused)
    assert "contradict" in found.reason


def test_what_cannot_be_checked_is_refused() -> None:
    """Four satellites of one system place a receiver anywhere if one of them is wrong, and nothing shows it."""
    gps = PositioningSettings(systems="G")
    found = find_position(observe(WUHAN, keep=4), BROADCAST, gps)
    assert isinstance(found, Refused)
    assert found.reason.startswith("nothing to check it with")
    found = find_position(observe(WUHAN, keep=3), BROADCAST, gps)
    assert isinstance(found, Refused)
    assert found.reason == "too few ranges: 3 for 4 unknowns"
    one_wrong = observe(WUHAN, keep=5, errors={"G01": 0.0})
    assert isinstance(find_position(one_wrong, BROADCAST, gps), PointPosition)


def test_poor_geometry_and_impossible_heights_are_refused() -> None:
    narrow = dataclasses.replace(SETTINGS, elevation_mask_deg=55.0, max_pdop=3.0)
    found = find_position(observe(WUHAN), BROADCAST, narrow)
    assert isinstance(found, Refused)
    assert found.reason.startswith(("poor geometry", "nothing to check", "too few"))
    found = find_position(observe(geodetic_to_ecef(30.5, 114.4, 30_000.0)), BROADCAST, SETTINGS)
    assert isinstance(found, Refused)
    assert found.reason.startswith("impossible height")


def test_satellites_are_left_out_for_a_reason() -> None:
    epoch = observe(WUHAN)
    names = sorted(set(epoch.satellites))
    sick = [dataclasses.replace(e, health=63 if e.satellite == names[0] else 0) for e in CONSTELLATION]
    broadcast = Ephemerides(e for e in sick if e.satellite != names[1])
    cn0 = epoch.cn0.copy()
    cn0[[name == names[2] for name in epoch.satellites]] = 18.0
    pseudorange = epoch.pseudorange.copy()
    pseudorange[[name == names[3] for name in epoch.satellites]] = np.nan
    found = find_position(dataclasses.replace(epoch, cn0=cn0, pseudorange=pseudorange), broadcast, SETTINGS)
    assert isinstance(found, PointPosition)
    assert found.rejected == dict(
        zip(names[:4], ("unhealthy", "no ephemeris", "weak signal", "no code on the first band"), strict=True)
    )


@given(
    pseudorange=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=0, max_size=12),
    doppler=st.floats(allow_nan=True, allow_infinity=True),
)
def test_senseless_measurements_never_raise(pseudorange: list[float], doppler: float) -> None:
    rows = [(f"{'GE'[i % 2]}{i + 1:02d}", "1C", value, doppler) for i, value in enumerate(pseudorange)]
    assert isinstance(find_position(epoch_of(rows, NOON_NS), BROADCAST, SETTINGS), PointPosition | Refused)


def test_the_limit_of_chi_square_is_exceeded_once_in_a_thousand_times() -> None:
    for degrees in range(1, 60):
        assert chi_square_limit(degrees) == pytest.approx(chi2.ppf(0.999, degrees), rel=0.035)


def test_impossible_settings_are_named() -> None:
    with pytest.raises(ConfigError, match="systems"):
        PositioningSettings(systems="GX")
    with pytest.raises(ConfigError, match="elevation_mask_deg"):
        PositioningSettings(elevation_mask_deg=90.0)


# Real recordings


RECORDINGS = {
    "nhm": "ubx:{gnss}/nhm.ubx",
    "16dBatt": "rinex:{gnss}/16dBatt_no_interference_coldstart.obs.gz,{gnss}/16dBatt_no_interference_coldstart.nav.gz",
    "matrtklib_static": "rinex:{gnss}/matrtklib_static/rover.obs,{gnss}/matrtklib_static/base.nav",
    "comma2k19": "comma2k19:{gnss}/../comma2k19/segment",
}


def as_rtklib(ephemeris: Ephemeris) -> Ephemeris:
    """RTKLIB 2.4.3 b34 reads Galileo's usual accuracy of 3.12 m as 2.96 m, which changes weights."""
    if isinstance(ephemeris, KeplerEphemeris) and ephemeris.satellite[0] == "E":
        return dataclasses.replace(ephemeris, accuracy=2.96)
    return ephemeris


@pytest.mark.parametrize("name", RECORDINGS)
def test_positions_of_a_recording_are_those_of_rtklib(
    name: str, real_data: Callable[[str], Path], tmp_path: Path
) -> None:
    """RTKLIB gets the same measurements and the ephemerides that were used: of several it takes odd group delays."""
    items = list(open_source(RECORDINGS[name].format(gnss=real_data("gnss"))))
    epochs = [item for item in items if isinstance(item, GnssEpoch)]
    epochs = epochs[:: 1 + len(epochs) // 120]
    broadcast = Ephemerides(items)
    used = {broadcast.find(s, epoch.t_ns) for epoch in epochs for s in set(epoch.satellites)} - {None}
    model = broadcast.ionosphere()
    with (tmp_path / "x.obs").open("w") as file:
        write_observations(file, epochs)
    with (tmp_path / "x.nav").open("w") as file:
        write_navigation(file, [*used, *([model] if model else [])])
    theirs = rtklib.single_point(tmp_path, tmp_path / "x.obs", tmp_path / "x.nav", "GREJC", 10.0)

    ours = Ephemerides([as_rtklib(ephemeris) for ephemeris in used] + ([model] if model else []))
    plain = PositioningSettings(elevation_mask_deg=10.0, min_cn0=0.0, exclude_outliers=False)
    compared = list(both(epochs, ours, plain, theirs))
    assert len(compared) > 0.4 * len(epochs)
    off = np.array([np.linalg.norm(mine.position - other.position) for mine, other in compared])
    assert off.max() < 0.1
    rates = [np.linalg.norm(m.velocity - o.velocity) for m, o in compared if not m.rejected_rates]
    assert np.nanmax(rates) < 0.05


def both(
    epochs: list[GnssEpoch], broadcast: Ephemerides, settings: PositioningSettings, theirs: list[rtklib.Solution]
) -> Iterator[tuple[PointPosition, rtklib.Solution]]:
    """Solutions of the epochs that both accept. RTKLIB's time is that of the tag without the receiver's error.

    RTKLIB knows nothing of what the receiver thinks of its Dopplers.
    """
    times = np.array([solution.t_ns for solution in theirs])
    for epoch in epochs:
        alike = dataclasses.replace(epoch, sigma_doppler=np.full(len(epoch.satellites), np.nan))
        mine = find_position(alike, broadcast, settings)
        if isinstance(mine, PointPosition):
            i = int(np.argmin(np.abs(times - epoch.t_ns)))
            if abs(times[i] - epoch.t_ns) < 0.04 * SECOND_NS:
                yield mine, theirs[i]


def test_wild_epochs_of_a_recording_are_refused(real_data: Callable[[str], Path]) -> None:
    """The signal fades until four satellites are left; RTKLIB then puts the antenna up to 69 km away."""
    gnss = real_data("gnss")
    items = list(open_source(RECORDINGS["16dBatt"].format(gnss=gnss)))
    broadcast = Ephemerides(items)
    epochs = [item for item in items if isinstance(item, GnssEpoch)][::3]
    outcomes = [find_position(epoch, broadcast, PositioningSettings()) for epoch in epochs]
    found = [outcome.position for outcome in outcomes if isinstance(outcome, PointPosition)]
    off = np.linalg.norm(np.array(found) - np.median(found, axis=0), axis=1)
    assert len(found) > len(epochs) // 2
    assert off.max() < 60.0
    assert len(outcomes) - len(found) > len(epochs) // 4


def test_a_position_of_a_surveyed_antenna_is_within_metres(real_data: Callable[[str], Path]) -> None:
    gnss = real_data("gnss")
    truth = geodetic_to_ecef(*map(float, (gnss / "matrtklib_static" / "rover_position.txt").read_text().split()))
    items = list(open_source(RECORDINGS["matrtklib_static"].format(gnss=gnss)))
    broadcast = Ephemerides(items)
    epochs = [item for item in items if isinstance(item, GnssEpoch)]
    for dual in (False, True):
        found = [find_position(e, broadcast, PositioningSettings(ionosphere_free=dual)) for e in epochs[::10]]
        off = [np.linalg.norm(f.position - truth) for f in found if isinstance(f, PointPosition)]
        assert len(off) == len(found)
        assert max(off) < 5.0
        still = [np.linalg.norm(f.velocity) for f in found if isinstance(f, PointPosition)]
        assert max(still) < 0.1
