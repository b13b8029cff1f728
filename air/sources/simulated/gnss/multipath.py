"""Errors of a simulated receiver's channels that stay for a while: multipath of code and carrier, fading."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, count, islice

import numpy as np

from air.sources.simulated.gnss.gnss_options import GnssOptions
from common.arrays import F64

FADING_DB = 1.0
_LOW = np.radians(20.0)


@dataclass(frozen=True, eq=False)
class Multipath:
    """Of S satellites' two signals each (S, 2): `code` and `carrier` in units of their size, `fading` dB."""

    code: F64
    carrier: F64
    fading: F64


def multipath(options: GnssOptions, satellites: int, seed: int, part: int, begin: int = 0) -> Iterator[Multipath]:
    """The state at each second from `begin` ≤ 0 on: Gauss–Markov processes of unit deviation, all independent."""
    first = np.random.default_rng([seed, part]).standard_normal((3, satellites, 2))
    # Such a process is the same both ways: what was before second 0 does not change what comes after it.
    before = islice(_states(first, options.multipath_s, [seed, part, 0]), 1, 1 - begin)
    for state in chain(reversed(list(before)), _states(first, options.multipath_s, [seed, part])):
        yield Multipath(state[0], state[1], FADING_DB * state[2])


def _states(state: F64, correlated_s: float, key: list[int]) -> Iterator[F64]:
    keep = np.exp(-1.0 / correlated_s)
    for second in count(1):
        yield state
        news = np.random.default_rng([*key, second]).standard_normal(state.shape)
        state = keep * state + np.sqrt(1 - keep**2) * news


def multipath_growth(elevation: F64) -> F64:
    """How much larger multipath is than its size at an elevation (rad): 0.5 at the zenith, 2 near the horizon."""
    return np.asarray(0.5 + 1.5 * np.exp(-np.maximum(elevation, 0.0) / _LOW))
