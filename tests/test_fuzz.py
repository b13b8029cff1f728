"""Damaged bytes make no reader raise, stall or grow."""

from __future__ import annotations

import pytest
from fuzz_readers import READERS, Reader
from fuzzing import fuzz, mutated

by_reader = pytest.mark.parametrize("reader", READERS.values(), ids=READERS)


@by_reader
def test_damaged_bytes_neither_raise_nor_stall_nor_grow(reader: Reader) -> None:
    assert fuzz(reader, seconds=0.7).cases > 0


@pytest.mark.slow
@by_reader
def test_damaged_bytes_do_no_harm_for_longer(reader: Reader) -> None:
    assert fuzz(reader, seconds=20.0, seed=1).cases > 0


@by_reader
def test_whole_bytes_are_read(reader: Reader) -> None:
    seeds = reader.seeds()
    assert seeds
    for seed in seeds:  # a reader checks what it finds by itself
        reader.read(seed)


def test_a_reader_that_raises_is_named_with_the_case() -> None:
    def read(data: bytes) -> None:
        if data.startswith(b"ab") and len(data) > 3:
            raise KeyError("broken")

    with pytest.raises(AssertionError, match=r"fragile: case \d+ of seed 3: KeyError"):
        fuzz(Reader("fragile", read, lambda: [b"abcd" * 10]), seconds=5.0, seed=3)


def test_a_reader_that_stalls_is_stopped() -> None:
    def read(data: bytes) -> None:
        while True:
            pass

    with pytest.raises(AssertionError, match=r"endless: case 0 of seed 0: StalledError"):
        fuzz(Reader("endless", read, lambda: [b"abcd"]), seconds=5.0, cpu_s=0.05)


def test_a_reader_that_takes_all_memory_is_found() -> None:
    def read(data: bytes) -> None:
        bytearray(64 << 20)

    with pytest.raises(AssertionError, match=r"greedy: case 0 of seed 0 held 67"):
        fuzz(Reader("greedy", read, lambda: [b"abcd"]), seconds=5.0)


def test_a_case_can_be_had_again() -> None:
    reader = next(iter(READERS.values()))
    assert [mutated(reader, 5, case) for case in range(9)] == [mutated(reader, 5, case) for case in range(9)]
