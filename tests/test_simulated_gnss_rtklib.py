"""RTKLIB as the judge of the simulated GNSS: its bytes, its positions, its carrier phases."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rtklib
from gnss_scene import (
    BASE_ECEF,
    broadcast,
    circling,
    circling_low,
    correlation_time,
    exported,
    rover,
    sky,
)

from air.gnss.gnss_time import SECOND_NS
from air.gnss.rinex_export import export_rinex
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.survey import START_NS
from air.sources.source import open_source
from common.errors import ExportError
from common.measurements import (
    GlonassEphemeris,
    GnssEpoch,
    KeplerEphemeris,
)

PERFECT = GnssOptions.perfect()
DEFAULT = GnssOptions()


def test_rtklib_reads_the_bytes_and_is_right_to_centimetres(tmp_path: Path) -> None:
    """Its own decoder of UBX and of all four navigation messages, not ours."""
    (tmp_path / "x.ubx").write_bytes(b"".join(data for _, data in rover(replace(PERFECT, rate_hz=0.5), 65.0).packets()))
    command = (
        rtklib.program("convbin"),
        "-r",
        "ubx",
        "-v",
        "3.04",
        "-od",
        "-os",
        "-o",
        "x.obs",
        "-n",
        "x.nav",
        "x.ubx",
    )
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=True)
    found = rtklib.single_point(tmp_path, tmp_path / "x.obs", tmp_path / "x.nav", "GREC", 10.0)
    truth, _ = circling((np.array([s.t_ns for s in found]) - START_NS) / SECOND_NS)
    assert len(found) > 30
    assert min(s.satellites for s in found) > 35
    assert np.linalg.norm([s.position for s in found] - truth, axis=1).max() < 0.1


def test_without_errors_rtklib_is_right_to_centimetres(tmp_path: Path) -> None:
    options = replace(PERFECT, rate_hz=0.2)
    flight = exported(tmp_path, options, None, 300.0)
    found = rtklib.single_point(tmp_path, flight.rover, flight.nav, "GREC", 10.0)
    errors = flight.errors((s.t_ns for s in found), (s.position for s in found))
    assert len(found) == len(flight.observed)
    # New issues are rounded anew, GLONASS's by decimetres; RTKLIB weighs them low.
    assert np.abs(errors).max() < 0.1


def test_with_errors_rtklib_finds_a_receiver_of_the_metre_class(tmp_path: Path) -> None:
    options = replace(DEFAULT, rate_hz=0.25, missing=0.0)
    errors = []
    for seed in (1, 2):
        flight = exported(tmp_path, options, None, 900.0, seed)
        found = rtklib.single_point(tmp_path, flight.rover, flight.nav, "GREC", 10.0)
        errors.append(flight.errors((s.t_ns for s in found), (s.position for s in found)))
        assert len(found) > 0.98 * len(flight.observed)
    rms = np.sqrt(np.mean(np.square(np.concatenate(errors)), axis=0))
    # A quarter of an hour holds some fifteen independent values of each axis: the deviation is known to a fifth.
    assert 1.0 < np.hypot(rms[0], rms[1]) < 2.2
    assert 1.2 < rms[2] < 4.5
    times = [correlation_time(e[:, axis], 4.0) for e in errors for axis in range(3)]
    assert 20.0 < np.median(times) < 250.0


def test_without_errors_rtklibs_fixed_positions_are_right_to_a_millimetre(tmp_path: Path) -> None:
    """Files round phases to a thousandth of a cycle, 0.2 mm."""
    options = replace(PERFECT, rate_hz=1.0)
    flight = exported(tmp_path, options, options, 60.0, antenna=circling_low)
    found = rtklib.kinematic(tmp_path, flight.rover, flight.base, flight.nav, BASE_ECEF)
    assert len(found) == len(flight.observed)
    assert all(s.fixed for s in found)
    assert np.abs(flight.errors((s.t_ns for s in found), (s.position for s in found))).max() < 1e-3


def test_rtklib_fixes_carrier_phases_and_agrees_with_truth_within_3_cm(tmp_path: Path) -> None:
    options = replace(DEFAULT, rate_hz=1.0, missing=0.0)
    flight = exported(tmp_path, options, GnssOptions.base(), 300.0)
    found = [s for s in rtklib.kinematic(tmp_path, flight.rover, flight.base, flight.nav, BASE_ECEF) if s.fixed]
    assert len(found) > 0.5 * len(flight.observed)
    errors = flight.errors((s.t_ns for s in found), (s.position for s in found))
    assert np.percentile(np.linalg.norm(errors, axis=1), 99) < 0.03


def test_exported_files_hold_what_was_measured(tmp_path: Path) -> None:
    flight = exported(tmp_path, replace(DEFAULT, rate_hz=1.0), None, 30.0)
    items = list(open_source(f"rinex:{flight.rover},{flight.nav}"))
    epochs = [m for m in items if isinstance(m, GnssEpoch)]
    for read, told in zip(epochs, (o.epoch for o in flight.observed), strict=True):
        order = sorted(range(len(told.satellites)), key=lambda i: (told.satellites[i], told.signals[i]))
        names = [(told.satellites[i], told.signals[i]) for i in order]
        index = [list(zip(read.satellites, read.signals, strict=True)).index(name) for name in names]
        assert abs(read.t_ns - told.t_ns) <= 100
        for field, digit in (("pseudorange", 1e-3), ("carrier_phase", 1e-3), ("doppler", 1e-3)):
            np.testing.assert_allclose(
                getattr(read, field)[index], getattr(told, field)[order], rtol=0, atol=0.51 * digit
            )
    assert len([m for m in items if isinstance(m, KeplerEphemeris | GlonassEphemeris)]) > 100


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="file"):
        export_rinex(broadcast(sky(DEFAULT), 0.0), tmp_path / "file")
