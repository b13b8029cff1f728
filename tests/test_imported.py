"""What the importers share: options, faults, order, time."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from air.sources.imported import Faults, gpst_of_unix, in_time_order, one_line, reordered, split_options
from air.sources.source import Problem
from common.errors import SourceError
from common.measurements import RawBytes

MS = 1_000_000


def raw(t_ns: int, device: str = "") -> RawBytes:
    return RawBytes(t_ns, device, b"")


@given(st.lists(st.tuples(st.integers(0, 200), st.integers(0, 999)), max_size=60))
def test_items_that_are_late_by_less_than_the_horizon_come_in_order(steps: list[tuple[int, int]]) -> None:
    arrival_ms, items = 10_000, []
    for step, late in steps:
        arrival_ms += step
        items.append(raw((arrival_ms - late) * MS))
    stamps = [item.t_ns for item in reordered(iter(items))]
    assert stamps == sorted(item.t_ns for item in items)


def test_no_more_is_held_than_allowed() -> None:
    taken = 0

    def endless():
        nonlocal taken
        while True:
            taken += 1
            yield raw(0)

    stream = reordered(endless(), most=50)
    for _ in range(10):
        next(stream)
    assert taken <= 50 + 10


def test_merging_takes_one_item_of_each_stream_ahead() -> None:
    merged = in_time_order([raw(1, "a"), raw(5, "a")], [raw(2, "b"), raw(3, "b")])
    assert [item.device for item in merged] == ["a", "b", "b", "a"]


def test_equal_faults_are_counted_and_their_first_place_is_kept() -> None:
    faults = Faults()
    for i in range(3):
        faults.add("cam0", "a frame is torn", f"at {i}")
    faults.add("imu", "is missing")
    assert faults.problems() == (
        Problem("cam0", "a frame is torn (3 times, first at 0)"),
        Problem("imu", "is missing"),
    )


def test_endless_kinds_of_faults_fill_no_memory() -> None:
    faults = Faults()
    for i in range(10_000):
        faults.add("bag", f"fault {i}")
    assert len(faults.problems()) == Faults.MOST + 1
    assert "9900 times" in faults.problems()[-1].text


def test_unix_time_gets_the_leap_seconds_of_its_day() -> None:
    # GPS week 1 began on 1980-01-13; 2017 began with the eighteenth leap second since.
    assert gpst_of_unix(316_569_600 * 10**9) == 316_569_600 * 10**9
    assert gpst_of_unix(1_483_228_799 * 10**9) == 1_483_228_816 * 10**9
    assert gpst_of_unix(1_483_228_800 * 10**9 + 5) == 1_483_228_818 * 10**9 + 5
    assert gpst_of_unix(2**80) == 2**80


def test_options_stand_behind_a_question_mark() -> None:
    assert split_options("x:", "a/b?map=c%20d", ("map",)) == (Path("a/b"), {"map": "c d"})
    with pytest.raises(SourceError, match="unknown option 'size'; allowed are map"):
        split_options("x:", "a?size=1", ("map",))
    with pytest.raises(SourceError, match="twice"):
        split_options("x:", "a?map=1&map=2", ("map",))


def test_what_a_library_says_is_one_line() -> None:
    assert one_line(ValueError("a\n  b")) == "ValueError: a b"
    assert len(one_line(ValueError("x" * 1000))) == 200
