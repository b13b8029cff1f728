"""Which signals a simulated receiver tracks: acquisition, loss, cycle slips, half cycles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from air.sources.simulated.gnss.gnss_options import GnssOptions
from common.arrays import F64, Bool

ACQUIRE_CN0, CODE_CN0, CARRIER_CN0 = 28.0, 22.0, 26.0
"""dBHz from which a signal is found, below which its code is lost, and below which its carrier is."""
WARM_S = 120
"""For so long a warm receiver has been on."""
_SLIPS_DOUBLE_DB = 3.0


@dataclass(frozen=True, eq=False)
class Tracked:
    """The two signals of S satellites at an epoch, (S, 2): `code` and `carrier`, whether they are tracked;
    `code_since` and `carrier_since` s of the flight; `half_cycle` where the carrier is not resolved yet; the
    carrier's `ambiguity` in cycles."""

    code: Bool
    carrier: Bool
    code_since: F64
    carrier_since: F64
    half_cycle: Bool
    ambiguity: F64


class Tracking:
    """Follows S satellites' two signals each, epoch by epoch."""

    def __init__(self, options: GnssOptions, satellites: int, rng: np.random.Generator):
        shape = satellites, 2
        self._options = options
        self._ambiguity = np.floor(rng.uniform(-1e6, 1e6, shape))
        self._half = rng.random(shape) < 0.5
        self._delay = rng.uniform(20.0, 35.0, shape) if options.cold else np.zeros(shape)
        self._resolve = rng.uniform(1.0, 5.0, shape)
        self._lock_delay = rng.uniform(0.3, 1.5, shape)
        self._code = np.zeros(shape, bool)
        self._carrier = np.zeros(shape, bool)
        self._code_since = np.full(shape, np.nan)
        self._carrier_since = np.full(shape, np.nan)
        self._seen_since = np.full(shape, np.nan)
        self._last_s: float | None = None

    def step(self, t_s: float, receivable: Bool, cn0: F64, chance: F64) -> Tracked:
        """What is tracked at `t_s`: `receivable` and `cn0` dBHz (S, 2); `chance` (2, S, 2) is uniform in 0 to 1."""
        began = self._last_s is None
        dt = 0.0 if self._last_s is None else t_s - self._last_s
        self._last_s = t_s
        seen = receivable & (cn0 >= np.where(self._code, CODE_CN0, ACQUIRE_CN0))
        new = seen & np.isnan(self._seen_since)
        self._seen_since[new] = t_s - (WARM_S if began and not self._options.cold else 0.0)
        self._seen_since[~seen] = np.nan
        self._delay[~seen] = 1.0  # found again sooner than at first
        code = seen & (t_s - self._seen_since >= self._delay)
        code[:, 1] &= code[:, 0]  # the second signal is found with the first one's help
        found_s = np.where(self._code, self._code_since, self._seen_since + self._delay)
        self._code_since = np.where(code, found_s, np.nan)
        carrier = code & (cn0 >= CARRIER_CN0) & (t_s - self._code_since >= self._lock_delay)
        started = carrier & ~self._carrier
        slipped = carrier & self._carrier & (chance[0] < self._slip_rate(cn0) * dt)
        self._carrier_since = np.where(started | slipped, t_s, self._carrier_since)
        if began:
            self._carrier_since = np.where(started, self._code_since + self._lock_delay, self._carrier_since)
        jump = np.floor(200.0 * chance[1]) - 100.0
        self._ambiguity += np.where(started | slipped, np.where(jump >= 0, jump + 1, jump), 0.0)
        self._code, self._carrier = code, carrier
        waiting = carrier & (t_s - self._carrier_since < self._resolve) & bool(self._options.half_cycle)
        return Tracked(
            code=code,
            carrier=carrier,
            code_since=self._code_since,
            carrier_since=self._carrier_since,
            half_cycle=waiting,
            ambiguity=self._ambiguity + np.where(waiting & self._half, 0.5, 0.0),
        )

    def _slip_rate(self, cn0: F64) -> F64:
        """Slips in a second of each carrier."""
        return np.asarray(self._options.slips / 3600.0 * 2.0 ** (np.maximum(45.0 - cn0, 0.0) / _SLIPS_DOUBLE_DB))
