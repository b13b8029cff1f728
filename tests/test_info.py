"""What `luojia-air info` tells of a source."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from air.__main__ import main
from air.info import stream_of, summarize, table
from air.sources.source import Problem
from common.measurements import GnssEpoch, ImuSample, Ionosphere, KeplerEphemeris, VehicleState
from common.measurements import RawBytes as Raw

MS = 1_000_000


class Listed:
    """A source of given items."""

    url, truth = "test:", None

    def __init__(self, items, problems=()):
        self.items, self.problems = items, problems

    def __iter__(self) -> Iterator:
        return iter(self.items)


def imu(t_ns: int) -> ImuSample:
    return ImuSample(t_ns, np.zeros(3), np.zeros(3))


def test_count_rate_and_ends_of_a_steady_stream() -> None:
    summary = summarize(Listed([imu(7 * MS + 5 * MS * i) for i in range(201)]))
    (stream,) = summary.streams
    assert (stream.name, stream.count, stream.first_ns, stream.last_ns) == ("imu", 201, 7 * MS, 1007 * MS)
    assert stream.rate_hz == pytest.approx(200.0)
    assert (stream.gaps, stream.longest_gap_s, stream.backward) == (0, None, 0)
    assert summary.duration_s == pytest.approx(1.0)


def test_gaps_are_intervals_of_more_than_one_and_a_half_medians() -> None:
    intervals = [10] * 20 + [14] * 3 + [16, 40] + [10] * 5
    times = np.cumsum([0, *intervals])
    (stream,) = summarize(Listed([imu(int(t) * MS) for t in times])).streams
    assert (stream.gaps, stream.longest_gap_s) == (2, pytest.approx(0.040))


@given(st.lists(st.integers(1, 10**10), min_size=1, max_size=60))
def test_gaps_agree_with_the_exact_median_within_a_per_cent(intervals: list[int]) -> None:
    times = np.cumsum([0, *intervals])
    (stream,) = summarize(Listed([imu(int(t)) for t in times])).streams
    low, high = (np.percentile(intervals, 50, method=m) for m in ("lower", "higher"))
    most = sum(interval > 1.5 * low * 0.98 for interval in intervals)
    least = sum(interval > 1.5 * high * 1.02 for interval in intervals)
    assert least <= stream.gaps <= most


def test_stamps_that_go_back_are_counted() -> None:
    (stream,) = summarize(Listed([imu(t * MS) for t in (0, 10, 5, 15, 25)])).streams
    assert (stream.backward, stream.first_ns, stream.last_ns) == (1, 0, 25 * MS)


def test_streams_are_told_apart_by_kind_and_device() -> None:
    kepler = KeplerEphemeris(0, "E11", "INAV", 0, 0, 1, 1, *[0.0] * 18, (0.0, 0.0), 1.0, 0)
    items = [Raw(0, "gnss", b""), Raw(0, "imu", b""), Ionosphere(0, "G", (0.0,) * 4, (0.0,) * 4), kepler]
    names = [stream.name for stream in summarize(Listed([*items, VehicleState(0, 3)])).streams]
    assert names == ["bytes gnss", "bytes imu", "ephemeris E INAV", "ionosphere G", "vehicle 3"]


def test_what_comes_when_it_pleases_has_no_gaps_and_does_not_stretch_the_duration() -> None:
    old = Ionosphere(-(10**15), "G", (0.0,) * 4, (0.0,) * 4)
    summary = summarize(Listed([old, imu(0), imu(10 * MS)]))
    assert summary.duration_s == pytest.approx(0.01)
    assert summary.streams[1].gaps is None
    assert table(summary)[2][5] == "–"


def test_an_empty_source_has_no_streams_and_no_duration() -> None:
    summary = summarize(Listed([], (Problem("x", "is empty"),)))
    assert (summary.streams, summary.duration_s) == ((), 0.0)
    assert summary.problems == (Problem("x", "is empty"),)


def test_memory_does_not_grow_with_the_length_of_a_recording() -> None:
    def items(n: int) -> Iterator[ImuSample]:
        rng = np.random.default_rng(1)
        sample = imu(0)
        for _ in range(n):
            sample = ImuSample(sample.t_ns + int(rng.integers(1, 10**9)), sample.accel, sample.gyro)
            yield sample

    tracemalloc.start()
    summarize(Listed([]), items(20_000))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000  # 20 000 stamps alone, as Python's integers in a list, take 0.8 MB


def test_an_epoch_is_named_after_its_receiver() -> None:
    nothing = np.zeros(0)
    epoch = GnssEpoch(0, "rover", (), (), *[nothing] * 5, np.zeros(0, bool), *[nothing] * 3, np.zeros(0, np.int32))
    assert stream_of(epoch) == ("gnss rover", True)


def test_the_command_prints_a_table_or_json(
    real_data: Callable[[str], Path], capfd: pytest.CaptureFixture[str]
) -> None:
    url = f"euroc:{real_data('euroc_v101_micro')}"
    assert main(["info", url]) == 0
    out = capfd.readouterr().out
    assert "camera cam0" in out
    assert "29120" in out
    assert main(["info", url, "--json"]) == 0
    summary = json.loads(capfd.readouterr().out)
    assert [(s["name"], s["count"]) for s in summary["streams"]] == [("camera cam0", 95), ("imu", 29120)]
    assert summary["streams"][1]["rate_hz"] == pytest.approx(200.0, abs=0.01)


def test_what_a_driver_dropped_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "f.xbus").write_bytes(b"no frame at all")
    url = f"xbus:{tmp_path / 'f.xbus'}"
    assert main(["info", url, "--json"]) == 0
    counts = json.loads(capfd.readouterr().out)["counts"]
    assert (counts["received_bytes"], counts["dropped_bytes"], counts["frames"]) == (15, 15, {})
    assert main(["info", url]) == 0
    assert "15 bytes, 15 dropped in 1 bursts" in capfd.readouterr().out


def test_the_command_refuses_an_unknown_source_in_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "nonsense:x"]) == 1
    assert capfd.readouterr().err.count("\n") == 1
