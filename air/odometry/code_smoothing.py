"""Codes smoothed by their own carriers, for a receiver that need not hurry: a base station.

A carrier tells without noise or echoes by how much the code changes, so that the mean of code less carrier, of as long
as the carrier is unbroken, makes a code of which little is left to be wrong. The ionosphere moves the two apart, which
the carriers of two bands show and one alone does not. Sources: Hatch, The synergism of GPS code and carrier
measurements (1982); Hwang, McGraw, Bader, Enhanced differential GPS carrier-smoothed code processing using
dual-frequency measurements (1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.odometry.gnss_corrections import Signals
from common.arrays import F64, I64

LONGEST_S, LONGEST_ALONE_S = 600.0, 100.0
"""For how long codes are averaged: where both bands are there, and where the ionosphere may move a carrier away."""


@dataclass(frozen=True)
class _Mean:
    """The mean of code less carrier m over `epochs` of an arc, with the arc of the other band, −1 without, and when it
    began, GPST s."""

    arcs: tuple[int, int]
    since_s: float
    epochs: int
    value: float


class CodeSmoother:
    """Smooths the codes of one receiver epoch by epoch."""

    def __init__(self) -> None:
        self._means: dict[tuple[str, bool], _Mean] = {}

    def step(self, t_s: float, signals: Signals, arcs: I64) -> tuple[F64, F64]:
        """The codes (M,) m of an epoch at GPST `t_s`, smoothed, and over how many s (M,).

        `arcs` (M,) number the unbroken carriers, −1 where there is none: such codes stay as they are.
        """
        code, over_s = signals.code.copy(), np.zeros(len(arcs))
        keys = signals.keys
        rows = {key: i for i, key in enumerate(keys) if arcs[i] >= 0}
        means = {}
        for key, i in rows.items():
            j = rows.get((key[0], not key[1]), -1)
            carrier = signals.carrier[i] + (divergence(signals, i, j) if j >= 0 else 0.0)
            # Carriers keep to one model of the ionosphere, codes take the newest.
            measured = signals.code[i] + signals.renewed[i]
            pair = int(arcs[i]), int(arcs[j]) if j >= 0 else -1
            mean = _next(self._means.get(key), pair, t_s, float(measured - carrier))
            means[key] = mean
            code[i] = carrier + mean.value - signals.renewed[i]
            over_s[i] = min(t_s - mean.since_s, _longest(pair))
        self._means = means
        return code, over_s


def _next(before: _Mean | None, arcs: tuple[int, int], t_s: float, value: float) -> _Mean:
    if before is None or before.arcs != arcs:
        return _Mean(arcs, t_s, 1, value)
    epochs = before.epochs + 1
    share = 1.0 / epochs
    passed_s = t_s - before.since_s
    if passed_s > _longest(arcs):
        share *= passed_s / _longest(arcs)
    return _Mean(arcs, before.since_s, epochs, before.value + share * (value - before.value))


def _longest(arcs: tuple[int, int]) -> float:
    return LONGEST_S if arcs[1] >= 0 else LONGEST_ALONE_S


def divergence(signals: Signals, i: int, j: int) -> float:
    """By how much the ionosphere has moved code `i` away from its carrier, m, as both carriers show, but a constant."""
    between = signals.carrier[i] - signals.carrier[j]
    return float(2.0 * signals.bend[i] / (signals.bend[j] - signals.bend[i]) * between)
