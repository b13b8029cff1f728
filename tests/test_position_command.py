"""`luojia-air position` writes a row for every epoch, and says what became of them."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import pytest

from air.__main__ import main
from common.geo import geodetic_to_ecef


def test_every_epoch_gets_a_row_that_tells_where_or_why_not(
    real_data: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = real_data("gnss") / "matrtklib_static"
    out = tmp_path / "positions.csv"
    source = f"rinex:{folder / 'rover.obs'},{folder / 'base.nav'}"
    assert main(["position", source, "--out", str(out), "--quiet", "--systems", "GE", "--mask", "15"]) == 0
    said = capsys.readouterr().out
    assert "301 of 301 epochs gave a position" in said
    rows = list(csv.DictReader(out.open()))
    assert len(rows) == 301
    truth = geodetic_to_ecef(*map(float, (folder / "rover_position.txt").read_text().split()))
    for row in rows:
        place = geodetic_to_ecef(*(float(row[name]) for name in ("latitude_deg", "longitude_deg", "height_m")))
        assert abs(place - truth).max() < 5.0
        assert row["refused"] == ""
        assert int(row["satellites"]) >= 8
        assert "R01 system not used" in row["rejected"]
        assert abs(float(row["v_up_mps"])) < 0.1
    assert rows[0]["gpst"] == "2024-06-24T08:20:00.000000"


def test_refused_epochs_say_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    obs = tmp_path / "a.obs"
    obs.write_text(
        f"{'     3.04           OBSERVATION DATA    M':60}RINEX VERSION / TYPE\n"
        f"{'G    1 C1C':60}SYS / # / OBS TYPES\n{'':60}END OF HEADER\n"
        "> 2024 06 24 08 20  0.0000000  0  1\nG06  21111111.123\n"
    )
    out = tmp_path / "positions.csv"
    assert main(["position", f"rinex:{obs}", "--out", str(out)]) == 0
    (row,) = csv.DictReader(out.open())
    assert (row["latitude_deg"], row["rejected"]) == ("", "G06 no ephemeris")
    assert row["refused"].startswith("too few ranges")
    said = capsys.readouterr().out.splitlines()
    assert said == ["0 of 1 epochs gave a position", "1 refused: too few ranges"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--systems", "X"], "systems is 'X'"),
        (["--mask", "95"], "elevation_mask_deg"),
        (["--out", "{}"], "cannot be written"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    options: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    obs = tmp_path / "a.obs"
    obs.write_text(f"{'     3.04           OBSERVATION DATA    M':60}RINEX VERSION / TYPE\n")
    filled = [option.format(tmp_path) for option in options]
    assert main(["position", f"rinex:{obs}", "--out", str(tmp_path / "o.csv"), *filled]) == 1
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
