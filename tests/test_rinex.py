"""RINEX files are read as far as they can be, and what we write is what RTKLIB and we ourselves read."""

from __future__ import annotations

import dataclasses
import gzip
import io
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rtklib
from gnss_samples import ALPHA, BETA, NAVIGATION, OLD_OBSERVATIONS
from hypothesis import given, settings
from hypothesis import strategies as st

from air.gnss.calendar import leap_seconds, to_calendar
from air.gnss.gnss_time import SECOND_NS, from_week
from air.gnss.rinex_lines import Lines
from air.gnss.rinex_navigation import read_navigation
from air.gnss.rinex_observation import read_observations
from air.gnss.rinex_writer import write_navigation, write_observations
from air.sources.source import open_source
from common.errors import SourceError
from common.measurements import GlonassEphemeris, GnssEpoch, Ionosphere, KeplerEphemeris

START_NS = from_week(2320, 116_400.0)


def written(messages: list[KeplerEphemeris | GlonassEphemeris | Ionosphere]) -> Lines:
    file = io.StringIO()
    write_navigation(file, messages)
    return Lines(file.getvalue().splitlines())


def observed(epochs: list[GnssEpoch]) -> list[GnssEpoch]:
    file = io.StringIO()
    write_observations(file, epochs)
    lines = Lines(file.getvalue().splitlines())
    read = list(read_observations(lines, {}, "gnss"))
    assert lines.damaged == 0
    return read


real = st.floats(-1e6, 1e6)
second = st.integers(0, 86_399)


@st.composite
def kepler(draw: st.DrawFn) -> KeplerEphemeris:
    satellite = draw(st.sampled_from(["G01", "G32", "E05", "C02", "C19", "J03"]))
    sources = {"G": ["LNAV"], "J": ["LNAV"], "E": ["INAV", "FNAV"], "C": ["D2" if satellite == "C02" else "D1"]}
    toe_ns = START_NS + draw(second) * SECOND_NS
    values = {name: draw(real) for name in ("af0", "af1", "af2", "i0", "omega0", "omega", "m0", "delta_n", "idot")}
    values |= {name: draw(real) for name in ("omega_dot", "cuc", "cus", "crc", "crs", "cic", "cis")}
    issue = draw(st.integers(0, 1023))
    return KeplerEphemeris(
        t_ns=toe_ns + draw(st.integers(-7200, 7200)) * SECOND_NS,
        satellite=satellite,
        source=draw(st.sampled_from(sources[satellite[0]])),
        toe_ns=toe_ns,
        toc_ns=toe_ns - draw(st.integers(-3600, 3600)) * SECOND_NS,
        iode=issue,
        iodc=issue if satellite[0] == "E" else draw(st.integers(0, 1023)),
        sqrt_a=draw(st.floats(1, 7000)),
        e=draw(st.floats(0, 0.9)),
        group_delay=(draw(real), 0.0 if satellite[0] in "GJ" else draw(real)),
        accuracy=draw(st.floats(0, 6000)),
        health=draw(st.integers(0, 511)),
        **values,
    )


@st.composite
def glonass(draw: st.DrawFn) -> GlonassEphemeris:
    toe_ns = START_NS + draw(second) * SECOND_NS
    x, v, a = (tuple(1e3 * draw(real) for _ in range(3)) for _ in range(3))
    return GlonassEphemeris(
        t_ns=toe_ns - draw(st.integers(0, 1800)) * SECOND_NS,
        satellite=f"R{draw(st.integers(1, 27)):02d}",
        toe_ns=toe_ns,
        position=(x[0], x[1], x[2]),
        velocity=(v[0], v[1], v[2]),
        acceleration=(a[0], a[1], a[2]),
        tau=draw(real),
        gamma=draw(real),
        channel=draw(st.integers(-7, 6)),
        age_days=draw(st.integers(0, 31)),
        health=draw(st.integers(0, 7)),
    )


@given(kepler() | glonass())
def test_an_ephemeris_survives_writing_to_thirteen_digits(ephemeris: KeplerEphemeris | GlonassEphemeris) -> None:
    (read,) = read_navigation(written([ephemeris]))
    assert type(read) is type(ephemeris)
    for field in dataclasses.fields(ephemeris):
        value, back = getattr(ephemeris, field.name), getattr(read, field.name)
        # Kilometres become metres again, and times of the week microseconds.
        close = pytest.approx(value, rel=1e-12, abs=1e-99) if field.type != "str" else value
        assert back == (pytest.approx(value, abs=1000) if field.name.endswith("_ns") else close)


def test_the_ionosphere_survives_writing() -> None:
    model = Ionosphere(0, "G", ALPHA, BETA)
    (read,) = read_navigation(written([model]))
    assert read == model


@st.composite
def epochs(draw: st.DrawFn) -> list[GnssEpoch]:
    names = st.sampled_from([("G01", "1C"), ("G01", "2L"), ("G17", "5Q"), ("E02", "1C"), ("R05", "1C"), ("C11", "2I")])
    return [
        _epoch(
            draw, START_NS + i * SECOND_NS + draw(st.integers(0, 9_999_999)) * 100, draw(st.lists(names, unique=True))
        )
        for i in range(draw(st.integers(1, 3)))
    ]


def _epoch(draw: st.DrawFn, t_ns: int, rows: list[tuple[str, str]]) -> GnssEpoch:
    n = len(rows)
    value = st.floats(0.01, 9e7) | st.just(float("nan"))
    column = st.lists(value, min_size=n, max_size=n).map(lambda values: np.array(values, float))
    phase = draw(column)
    half = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)), bool) & np.isfinite(phase)
    unknown = np.full(n, np.nan)
    return GnssEpoch(
        t_ns=t_ns,
        receiver="gnss",
        satellites=tuple(row[0] for row in rows),
        signals=tuple(row[1] for row in rows),
        pseudorange=draw(column),
        carrier_phase=phase,
        doppler=-draw(column),
        cn0=draw(column),
        lock_s=unknown,
        half_cycle=half,
        sigma_pseudorange=unknown,
        sigma_carrier_phase=unknown,
        sigma_doppler=unknown,
        channel=np.array([-3 if row[0] == "R05" else 0 for row in rows], np.int32),
        leap_s=18,
    )


@settings(max_examples=60)
@given(epochs())
def test_epochs_survive_writing_to_a_millimetre(written_epochs: list[GnssEpoch]) -> None:
    for epoch, read in zip(written_epochs, observed(written_epochs), strict=True):
        assert read.t_ns == epoch.t_ns
        assert read.leap_s == 18
        ours, theirs = (
            {key: i for i, key in enumerate(zip(e.satellites, e.signals, strict=True))} for e in (epoch, read)
        )
        columns = ("pseudorange", "carrier_phase", "doppler", "cn0")
        for key, i in ours.items():
            before = np.array([getattr(epoch, column)[i] for column in columns])
            if np.isnan(before).all():
                assert key not in theirs
                continue
            j = theirs[key]
            after = np.array([getattr(read, column)[j] for column in columns])
            assert after == pytest.approx(before, abs=0.00051, nan_ok=True)
            assert (read.half_cycle[j], read.channel[j]) == (epoch.half_cycle[i], epoch.channel[i])


def test_a_loss_of_lock_starts_the_time_of_tracking_again() -> None:
    (base,) = observed([_plain(START_NS)])
    lock_s = (100.0, 101.0, 0.3, 1.3)
    track = [
        dataclasses.replace(base, t_ns=START_NS + i * SECOND_NS, lock_s=np.array([value]))
        for i, value in enumerate(lock_s)
    ]
    assert [float(epoch.lock_s[0]) for epoch in observed(track)] == [0.0, 1.0, 0.0, 1.0]


def _plain(t_ns: int) -> GnssEpoch:
    one = np.ones(1)
    values = dict.fromkeys(("pseudorange", "carrier_phase", "doppler", "cn0", "lock_s"), 1000000.0 * one)
    sigmas = dict.fromkeys(("sigma_pseudorange", "sigma_carrier_phase", "sigma_doppler"), one)
    return GnssEpoch(
        t_ns, "gnss", ("G01",), ("1C",), **values, **sigmas, half_cycle=one < 0, channel=one.astype(np.int32)
    )


def test_version_2_is_read() -> None:
    lines = Lines(OLD_OBSERVATIONS.splitlines())
    first, second_epoch = read_observations(lines, {"R01": 1}, "gnss")
    assert lines.damaged == 0
    assert (first.t_ns, second_epoch.t_ns) == (START_NS, START_NS + SECOND_NS)
    assert list(zip(first.satellites, first.signals, first.pseudorange, first.channel, strict=True)) == [
        ("G06", "1C", 21111111.123, 0),
        ("G06", "2W", 21111115.456, 0),
        ("R01", "1C", 19000000.0, 1),
        ("G09", "1C", 22222222.0, 0),
    ]
    assert first.doppler[:2].tolist() == pytest.approx([-1234.5, np.nan], nan_ok=True)
    assert first.cn0[:2].tolist() == [45.0, 40.0]
    assert first.lock_s[0] == 0.0
    assert second_epoch.lock_s[0] == 1.0
    assert not first.half_cycle.any()
    assert second_epoch.half_cycle.tolist() == [True, False]


def test_damaged_lines_are_skipped_and_counted() -> None:
    text = NAVIGATION.splitlines()
    text[5] = "     5.31 garbage"
    text.insert(12, "@@@@")
    lines = Lines(text)
    read = [message.satellite for message in read_navigation(lines) if not isinstance(message, Ionosphere)]
    assert read == ["E07", "C03", "J02", "R01"]
    assert lines.damaged == 2


@given(st.data())
def test_any_damage_to_a_file_is_survived(data: st.DataObject) -> None:
    text = data.draw(st.sampled_from([NAVIGATION, OLD_OBSERVATIONS]))
    cut = data.draw(st.integers(0, len(text)))
    junk = data.draw(st.text(max_size=40))
    broken = (text[:cut] + junk + text[data.draw(st.integers(cut, len(text))) :]).splitlines()
    assert all(isinstance(m, KeplerEphemeris | GlonassEphemeris | Ionosphere) for m in read_navigation(Lines(broken)))
    for epoch in read_observations(Lines(broken), {}, "gnss"):
        assert len(epoch.satellites) == len(epoch.signals) == len(epoch.pseudorange)


def test_leap_seconds_follow_the_bulletins() -> None:
    assert leap_seconds(to_calendar(START_NS)) == 18
    assert [leap_seconds(to_calendar(from_week(week, 0.0))) for week in (0, 1042, 1929)] == [0, 13, 17]


# Files


@pytest.fixture
def files(tmp_path: Path) -> Path:
    (tmp_path / "a.nav").write_text(NAVIGATION)
    (tmp_path / "a.obs").write_text(OLD_OBSERVATIONS)
    (tmp_path / "a.nav.gz").write_bytes(gzip.compress(NAVIGATION.encode()))
    return tmp_path


def test_a_source_gives_the_navigation_first_plain_or_packed(files: Path) -> None:
    for nav in ("a.nav", "a.nav.gz"):
        source = open_source(f"rinex:{files / 'a.obs'},{files / nav}")
        items = list(source)
        assert [type(item).__name__ for item in items] == ["KeplerEphemeris"] * 4 + ["GlonassEphemeris"] + [
            "GnssEpoch"
        ] * 2
        assert items[-2].channel[2] == 1  # told by the navigation file
        assert not source.problems


def test_a_file_that_is_cut_is_read_up_to_the_cut(files: Path) -> None:
    packed = files / "a.nav.gz"
    packed.write_bytes(packed.read_bytes()[:-200])
    source = open_source(f"rinex:{packed}")
    assert len(list(source)) >= 1
    assert any("ends within its compression" in problem.text for problem in source.problems)


@pytest.mark.parametrize(
    ("rest", "told"), [("", "names no file"), ("{}/none.obs", "No such file"), ("{}/x.txt", "no RINEX observation")]
)
def test_a_file_that_is_no_rinex_is_named(rest: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_bytes(b"\x1f\x8b no")
    with pytest.raises(SourceError, match=told):
        open_source("rinex:" + rest.format(tmp_path))


def test_old_and_new_versions_of_one_recording_hold_the_same(real_data: Callable[[str], Path], tmp_path: Path) -> None:
    """RTKLIB's convbin writes both; version 2 knows no BeiDou and no bands of its own for L2C."""
    ubx = real_data("gnss") / "nhm.ubx"
    found = []
    for version in ("2.11", "3.04"):
        names = [str(tmp_path / f"{version}.{kind}") for kind in ("obs", "nav", "gnav")]
        command = [rtklib.program("convbin"), "-r", "ubx", "-od", "-os", "-v", version]
        subprocess.run(
            [*command, "-o", names[0], "-n", names[1], "-g", names[2], str(ubx)], capture_output=True, check=True
        )
        items = list(open_source("rinex:" + ",".join(name for name in names if Path(name).exists())))
        found.append(items)
    old, new = ({e.t_ns: e for e in items if isinstance(e, GnssEpoch)} for items in found)
    assert old.keys() == new.keys()
    for t_ns, epoch in old.items():
        theirs = dict(
            zip(zip(new[t_ns].satellites, new[t_ns].signals, strict=True), new[t_ns].pseudorange, strict=True)
        )
        rows = [i for i, name in enumerate(epoch.satellites) if name[0] in "GR" and epoch.signals[i] == "1C"]
        assert rows
        for i in rows:
            assert epoch.pseudorange[i] == pytest.approx(theirs[epoch.satellites[i], "1C"], abs=1e-6, nan_ok=True)
    glonass_old, glonass_new = ({e.satellite: e for e in items if isinstance(e, GlonassEphemeris)} for items in found)
    assert glonass_old.keys() == glonass_new.keys()
    for satellite, ephemeris in glonass_old.items():
        assert ephemeris.position == pytest.approx(glonass_new[satellite].position, abs=1e-5)
        assert ephemeris.toe_ns == glonass_new[satellite].toe_ns


def test_rtklib_reads_what_we_write(real_data: Callable[[str], Path], tmp_path: Path) -> None:
    folder = real_data("gnss") / "matrtklib_static"
    items = list(open_source(f"rinex:{folder / 'rover.obs'},{folder / 'base.nav'}"))
    few = [item for item in items if isinstance(item, GnssEpoch)][:20]
    with (tmp_path / "x.obs").open("w") as file:
        write_observations(file, few)
    with (tmp_path / "x.nav").open("w") as file:
        write_navigation(file, [item for item in items if not isinstance(item, GnssEpoch)])
    ours = rtklib.single_point(tmp_path, tmp_path / "x.obs", tmp_path / "x.nav", "GRJC", 10.0)
    theirs = rtklib.single_point(tmp_path, folder / "rover.obs", folder / "base.nav", "GRJC", 10.0)[:20]
    assert [solution.t_ns for solution in ours] == [solution.t_ns for solution in theirs]
    for mine, other in zip(ours, theirs, strict=True):
        assert mine.position == pytest.approx(other.position, abs=1e-3)
        assert mine.satellites == other.satellites
