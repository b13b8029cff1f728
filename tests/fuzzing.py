"""Feeds damaged bytes to every reader of outside bytes: none may raise, stall or grow.

A reader is a function of bytes with some seeds, which are what it usually reads. Whoever adds a reader of outside
bytes adds it to `READERS`. Every case follows from reader, seed and number, so a failure can be had again:

python tests/fuzzing.py ubx --case 1234
"""

from __future__ import annotations

import argparse
import functools
import logging
import random
import resource
import signal
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from fuzz_readers import READERS, Reader

log = logging.getLogger("fuzzing")

LONGEST = 60_000
"""Bytes of a case, at most."""
CPU_S = 2.0
"""What a case may take. The slowest honest one takes some ten milliseconds."""
PEAK_BYTES = 32 << 20
"""What a case may hold at once: some hundred times its bytes, as Python's objects are large."""
GROWTH_BYTES = 64 << 20
"""What the process may grow by, over all cases of a reader."""
MEASURED_FIRST, MEASURED_LATER = 25, 1000
"""Memory is measured in every so-manieth case, of the first thousand and of the rest: measuring slows a reader down
several times, and costs the process a kilobyte for good."""


@dataclass(frozen=True)
class Outcome:
    """What became of the cases of one reader: the longest CPU time, the most memory of one, the growth of all."""

    cases: int
    slowest_s: float
    peak_bytes: int
    growth_bytes: int


class StalledError(Exception):
    """A reader took longer than it may."""


def fuzz(reader: Reader, seconds: float, seed: int = 0, cpu_s: float = CPU_S) -> Outcome:
    """The outcome of as many cases as fit into some seconds, each of which may take `cpu_s`.

    Raises AssertionError, naming the case, at a failure.
    """
    cases, slowest, peak, before = 0, 0.0, 0, _resident_bytes()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        case = mutated(reader, seed, cases)
        measured = cases % (MEASURED_FIRST if cases < 1000 else MEASURED_LATER) == 0
        try:
            took, held = _run(reader, case, measured, cpu_s)
        except Exception as error:
            raise AssertionError(f"{reader.name}: case {cases} of seed {seed}: {error!r}") from error
        assert held <= PEAK_BYTES, f"{reader.name}: case {cases} of seed {seed} held {held} bytes"
        slowest, peak, cases = max(slowest, took), max(peak, held), cases + 1
    growth = _resident_bytes() - before
    assert growth <= GROWTH_BYTES, f"{reader.name}: grew by {growth} bytes in {cases} cases of seed {seed}"
    return Outcome(cases, slowest, peak, growth)


def mutated(reader: Reader, seed: int, case: int) -> bytes:
    """The bytes of a case."""
    rng = random.Random(f"{reader.name}/{seed}/{case}")
    data = rng.choice(_seeds(reader))
    for _ in range(rng.randint(1, 3)):
        data = rng.choice(MUTATIONS)(rng, data, _seeds(reader))[:LONGEST]
    return data


def _noise(rng: random.Random, data: bytes, seeds: list[bytes]) -> bytes:
    return rng.randbytes(rng.randint(0, 2000))


def _flip_bits(rng: random.Random, data: bytes, seeds: list[bytes]) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 3, 30)) if out else 0):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _set_bytes(rng: random.Random, data: bytes, seeds: list[bytes]) -> bytes:
    """Runs of the values that lengths and counts break at."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4) if out else 0):
        at, count = rng.randrange(len(out)), rng.choice((1, 2, 4, 8))
        out[at : at + count] = bytes([rng.choice((0x00, 0x01, 0x7F, 0x80, 0xFE, 0xFF))]) * count
    return bytes(out)


def _truncate(rng: random.Random, data: bytes, seeds: list[bytes]) -> bytes:
    first, last = sorted((rng.randint(0, len(data)), rng.randint(0, len(data))))
    return data[rng.choice((0, first)) : last]


def _concatenate(rng: random.Random, data: bytes, seeds: list[bytes]) -> bytes:
    return data + rng.choice(seeds)


def _splice(rng: random.Random, data: bytes, seeds: list[bytes]) -> bytes:
    """The beginning of one and the end of another."""
    other = rng.choice(seeds)
    return data[: rng.randint(0, len(data))] + other[rng.randint(0, len(other)) :]


def _cut_out(rng: random.Random, data: bytes, seeds: list[bytes]) -> bytes:
    at = rng.randint(0, len(data))
    return data[:at] + data[at + rng.randint(1, 20) :]


def _put_in(rng: random.Random, data: bytes, seeds: list[bytes]) -> bytes:
    at = rng.randint(0, len(data))
    return data[:at] + rng.randbytes(rng.randint(1, 20)) + data[at:]


MUTATIONS: tuple[Callable[[random.Random, bytes, list[bytes]], bytes], ...] = (
    _noise,
    _flip_bits,
    _set_bytes,
    _truncate,
    _concatenate,
    _splice,
    _cut_out,
    _put_in,
)


@functools.cache
def _seeds(reader: Reader) -> list[bytes]:
    return [seed[:LONGEST] for seed in reader.seeds()]


def _run(reader: Reader, data: bytes, measured: bool, cpu_s: float) -> tuple[float, int]:
    """CPU time of a case, s (0 where memory was measured), and the most bytes that it held (0 where it was not)."""
    if measured:
        tracemalloc.start()
        try:
            with _limited(10 * cpu_s):
                reader.read(data)
            return 0.0, tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    begun = time.process_time()
    with _limited(cpu_s):
        reader.read(data)
    return time.process_time() - begun, 0


@contextmanager
def _limited(cpu_s: float) -> Iterator[None]:
    """Raises StalledError in a body that takes more CPU time; other timers of the process are left alone."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise StalledError(f"took more than {cpu_s:g} s")

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, cpu_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def _resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def main() -> None:
    logging.basicConfig(stream=sys.stdout, format="%(message)s", level=logging.INFO)
    logging.getLogger("air").setLevel(logging.CRITICAL)
    parser = argparse.ArgumentParser(description="Feed damaged bytes to readers.")
    parser.add_argument("readers", nargs="*", metavar="READER", help=f"of {', '.join(sorted(READERS))}; default all")
    parser.add_argument("--seconds", type=float, default=600.0, help="for each reader")
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 32), help="default: another one each time")
    parser.add_argument("--case", type=int, help="only this one")
    args = parser.parse_args()
    log.info("| reader | cases | slowest, ms | most memory, kB | growth, MB |\n| --- | --- | --- | --- | --- |")
    for name in args.readers or sorted(READERS):
        reader = READERS[name]
        if args.case is not None:
            reader.read(mutated(reader, args.seed, args.case))
            continue
        out = fuzz(reader, args.seconds, args.seed)
        memory = f"{out.peak_bytes / 1e3:.0f} | {out.growth_bytes / 1e6:.1f}"
        log.info(f"| {name} | {out.cases} | {1e3 * out.slowest_s:.1f} | {memory} |")


if __name__ == "__main__":
    main()
