"""Errors of a simulated receiver's channels that stay for a while: multipath of code and carrier, fading."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

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


def multipath(options: GnssOptions, satellites: int, seed: int, part: int) -> Iterator[Multipath]:
    """The state at each second from 0 on: Gauss–Markov processes of unit deviation, independent of each other."""
    keep = np.exp(-1.0 / options.multipath_s)
    state = np.random.default_rng([seed, part]).standard_normal((3, satellites, 2))
    second = 0
    while True:
        yield Multipath(state[0], state[1], FADING_DB * state[2])
        second += 1
        news = np.random.default_rng([seed, part, second]).standard_normal(state.shape)
        state = keep * state + np.sqrt(1 - keep**2) * news


def multipath_growth(elevation: F64) -> F64:
    """How much larger multipath is than its size at an elevation (rad): 0.5 at the zenith, 2 near the horizon."""
    return np.asarray(0.5 + 1.5 * np.exp(-np.maximum(elevation, 0.0) / _LOW))
