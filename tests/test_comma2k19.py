"""Segments of comma2k19 are read as measurements of our own kinds, and their positions follow the reference."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from gnss_samples import NAVIGATION

from air.gnss.gnss_time import from_week, to_week
from air.gnss.positioning import PointPosition
from air.gnss.settings import PositioningSettings
from air.positions import find_positions
from air.sources.source import open_source
from common.errors import SourceError
from common.measurements import GnssEpoch, ImuSample, KeplerEphemeris


@pytest.fixture
def segment(tmp_path: Path) -> Path:
    """Two epochs of a GPS and a GLONASS satellite, and three samples of the IMU."""
    rows = [
        [5, 2320, 116_400.0, np.nan, 2.1e7, 8.0, 190.3, 0.1, 44.0, 1.1e8],
        [66, 2320, 116_400.0, -4.0, 2.0e7, 9.0, -50.0, 0.2, 40.0, np.nan],
        [5, 2320, 116_400.1, np.nan, 2.1e7, 8.0, 190.3, 0.1, 44.0, 1.1e8],
        [250, 2320, 116_400.1, np.nan, 2.1e7, 8.0, 0.0, 0.1, 44.0, 1.1e8],
    ]
    arrays = {
        "GNSS/raw_gnss_ublox/value": rows,
        "IMU/accelerometer/t": [100.0, 100.01, 100.02],
        "IMU/accelerometer/value": [[1.0, 2.0, -9.8]] * 3,
        "IMU/gyro_uncalibrated/t": [100.0, 100.02],
        "IMU/gyro_uncalibrated/value": [[0.1, 0.2, 0.3], [0.3, 0.2, 0.3]],
        "global_pose/frame_times": [99.0, 101.0],
        "global_pose/frame_gps_times": [[2320, 116_399.0], [2320, 116_401.0]],
    }
    for name, values in arrays.items():
        path = tmp_path / "segment" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            np.save(file, np.array(values))
    return tmp_path / "segment"


def test_arrays_become_epochs_and_samples_in_our_units_and_frame(segment: Path) -> None:
    items = list(open_source(f"comma2k19:{segment}"))
    first, second = (item for item in items if isinstance(item, GnssEpoch))
    assert (first.t_ns, first.satellites, first.channel.tolist()) == (
        from_week(2320, 116_400.0),
        ("G05", "R02"),
        [0, -4],
    )
    assert first.doppler[0] == pytest.approx(-190.3 / 0.190293673, rel=1e-8)  # goes away: the pseudorange grows
    assert first.sigma_doppler[0] == pytest.approx(0.1 / 0.190293673, rel=1e-8)
    assert second.satellites == ("G05",)
    samples = [item for item in items if isinstance(item, ImuSample)]
    assert [sample.t_ns for sample in samples] == [from_week(2320, 116_400.0 + t) for t in (0.0, 0.01, 0.02)]
    assert samples[0].accel.tolist() == [1.0, -2.0, 9.8]  # forward, left, up
    assert samples[1].gyro == pytest.approx([0.2, -0.2, -0.3])


def test_navigation_files_may_be_named(segment: Path, tmp_path: Path) -> None:
    (tmp_path / "day.nav").write_text(NAVIGATION)
    items = list(open_source(f"comma2k19:{segment},{tmp_path / 'day.nav'}"))
    assert sum(isinstance(item, KeplerEphemeris) for item in items) == 4


@pytest.mark.parametrize(
    ("broken", "told"),
    [
        ("GNSS/raw_gnss_ublox/value", "no array"),
        ("IMU/accelerometer/t", "no array"),
        ("global_pose/frame_times", "no array"),
    ],
)
def test_what_cannot_be_read_is_named(segment: Path, broken: str, told: str) -> None:
    (segment / broken).write_bytes(b"\x93NUMPY nonsense")
    with pytest.raises(SourceError, match=told):
        open_source(f"comma2k19:{segment}")


def test_a_folder_without_raw_gnss_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="holds no folder GNSS"):
        open_source(f"comma2k19:{tmp_path}")


def test_positions_follow_the_reference_of_a_real_segment(real_data: Callable[[str], Path]) -> None:
    """One band, no ionosphere heard, no group delays known: some metres; Doppler velocity much better."""
    folder = real_data("comma2k19") / "segment"
    outcomes = [o for _, o in find_positions(open_source(f"comma2k19:{folder}"), PositioningSettings())]
    found = [outcome for outcome in outcomes if isinstance(outcome, PointPosition)]
    assert len(found) == len(outcomes) == 600
    seconds, positions, velocities = (
        np.load(folder / "global_pose" / name) for name in ("frame_gps_times", "frame_positions", "frame_velocities")
    )
    t = np.array([to_week(fix.t_ns)[1] - fix.clocks["G"] for fix in found])

    def reference(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, seconds[:, 1], column) for column in values.T], axis=1)

    off = np.linalg.norm(np.array([fix.position for fix in found]) - reference(positions), axis=1)
    assert np.sqrt(np.mean(off**2)) < 5.0
    slip = np.linalg.norm(np.array([fix.velocity for fix in found]) - reference(velocities), axis=1)
    assert np.nanmedian(slip) < 0.5
    assert np.isnan(slip).sum() < 10
