"""What spoils the ranges of a receiver for longer than an epoch, as variables of the window.

Of each satellite: multipath and the slow errors (orbit, satellite clock, air) of its code, the drift that its Doppler
sees, the ambiguity of its carrier; and the delay of each system against GPS. One vector holds them all for some
seconds, and Gauss–Markov processes lead from one vector to the next. Averaging epochs as if their multipath were
independent makes an estimator confident and wrong. Source: Brown and Hwang, Introduction to Random Signals, chapter 9.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import gtsam
import numpy as np

from air.gnss.gnss_time import SECOND_NS
from air.odometry.gnss_preprocessing import CleanEpoch
from air.odometry.gnss_settings import GnssNoise
from air.odometry.quadratic import Quadratic
from common.arrays import F64

FORGET_S, FORGET_ARC_S = 60.0, 3.0
"""A satellite that was not seen for so long begins anew; a carrier does in any case."""
REFERENCE_SYSTEMS = ("G", "G-base")
SIGMA_SYSTEM, SIGMA_AMBIGUITY = 300.0, 1000.0
"""What is known beforehand of a delay between systems, and of an ambiguity after code was taken off, m."""


class Kind(StrEnum):
    """What a bias is of."""

    MULTIPATH = "multipath"
    SLOW = "slow"
    DRIFT = "drift"
    AMBIGUITY = "ambiguity"
    SYSTEM = "system"


@dataclass(frozen=True)
class Process:
    """How a bias wanders: from a mean with `sigma` back to it within `time_s`, or on by `walk` per √s."""

    mean: float
    sigma: float
    time_s: float = np.inf
    walk: float = 0.0

    def over(self, dt_s: float) -> tuple[float, float]:
        """What is left after some seconds, as a factor, and the sigma of what came in."""
        keep = float(np.exp(-dt_s / self.time_s))
        return keep, float(np.sqrt(self.sigma**2 * (1 - keep**2) + self.walk**2 * dt_s))


Bias = tuple[Kind, str]
"""A bias: what it is of, and the name of the satellite, carrier arc or system."""


@dataclass(frozen=True, eq=False)
class BiasNode:
    """The biases (D,) of one vector of the window, m or m/s, each with its process and when (GPST) it was last seen."""

    index: int
    t_ns: int
    biases: dict[Bias, int]
    processes: tuple[Process, ...]
    seen_ns: tuple[int, ...]

    @property
    def key(self) -> int:
        """The key of the vector in the window."""
        return int(gtsam.symbol("n", self.index))

    def __len__(self) -> int:
        return len(self.processes)


def needed(epochs: Iterable[CleanEpoch], noise: GnssNoise) -> dict[Bias, tuple[Process, int]]:
    """The biases in some epochs, how they wander, and when they were last seen.

    The mean of an ambiguity that no code came along with is NaN.
    """
    found: dict[Bias, tuple[Process, int]] = {}
    for epoch in epochs:
        t_ns = epoch.t_ns
        for i, satellite in enumerate(epoch.satellites):
            if np.isfinite(epoch.code[i]):
                multipath = Process(0.0, float(epoch.sigma_multipath[i]), noise.multipath_s)
                found[Kind.MULTIPATH, satellite] = multipath, t_ns
                found[Kind.SLOW, satellite] = Process(0.0, float(epoch.sigma_slow[i]), float(epoch.slow_s[i])), t_ns
            if epoch.arcs[i]:
                key = Kind.AMBIGUITY, epoch.arcs[i]
                mean = found[key][0].mean if key in found else np.nan
                mean = float(epoch.offset[i]) if np.isnan(mean) else mean
                found[key] = Process(mean, SIGMA_AMBIGUITY, walk=noise.ambiguity_walk), t_ns
            if epoch.arcs[i] or np.isfinite(epoch.rate[i]):
                found[Kind.DRIFT, epoch.arcs[i] or satellite] = (
                    Process(0.0, float(epoch.sigma_drift[i]), noise.drift_s),
                    t_ns,
                )
            if epoch.systems[i] not in REFERENCE_SYSTEMS:
                found[Kind.SYSTEM, epoch.systems[i]] = Process(0.0, SIGMA_SYSTEM, walk=noise.system_walk), t_ns
    return found


def first_node(index: int, t_ns: int, wanted: dict[Bias, tuple[Process, int]]) -> tuple[BiasNode, Quadratic]:
    """A node with nothing before it, and what is known of it, at the values that are expected."""
    node = _node(index, t_ns, {bias: one for bias, one in wanted.items() if np.isfinite(one[0].mean)})
    u = np.array([process.mean for process in node.processes])
    sigma = np.array([process.sigma for process in node.processes])
    return node, Quadratic({node.key: u}, np.diag(sigma**-2.0), np.zeros(len(node)))


def next_node(
    before: BiasNode, u_before: F64, t_ns: int, wanted: dict[Bias, tuple[Process, int]]
) -> tuple[BiasNode, Quadratic]:
    """The node after another, and what joins both, at the values that are expected.

    `u_before` (C,) are the biases of the node before. Those not seen any more for a while are left behind.
    """
    kept = {
        bias: (before.processes[i], before.seen_ns[i])
        for bias, i in before.biases.items()
        if t_ns - before.seen_ns[i] <= (FORGET_ARC_S if "/" in bias[1] else FORGET_S) * SECOND_NS
    }
    new = {bias: one for bias, one in wanted.items() if bias in kept or np.isfinite(one[0].mean)}
    node = _node(before.index + 1, t_ns, kept | new)
    dt_s = (t_ns - before.t_ns) / SECOND_NS
    A = np.zeros((len(node), len(before)))
    mean, sigma = np.zeros((2, len(node)))
    for bias, column in node.biases.items():
        process = node.processes[column]
        if bias in before.biases:
            keep, sigma[column] = process.over(dt_s)
            A[column, before.biases[bias]] = keep
            drift = before.biases.get((Kind.DRIFT, bias[1]))
            if bias[0] is Kind.AMBIGUITY and drift is not None:
                A[column, drift] = dt_s
        else:
            mean[column], sigma[column] = process.mean, process.sigma
    u = A @ u_before + mean
    W = np.maximum(sigma, 1e-5) ** -2.0
    WA = W[:, None] * A
    G = np.block([[A.T @ WA, -WA.T], [-WA, np.diag(W)]])
    return node, Quadratic({before.key: u_before, node.key: u}, G, np.zeros(len(G)))


def _node(index: int, t_ns: int, wanted: dict[Bias, tuple[Process, int]]) -> BiasNode:
    names = sorted(wanted)
    return BiasNode(
        index=index,
        t_ns=t_ns,
        biases={bias: i for i, bias in enumerate(names)},
        processes=tuple(wanted[bias][0] for bias in names),
        seen_ns=tuple(wanted[bias][1] for bias in names),
    )
