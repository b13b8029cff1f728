"""The clocks of devices, which run as they like, and the way of their messages to the host, which takes time.

All true times are s of GNSS time since the flight's start.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated

import numpy as np

from common.arrays import F64
from common.config import Range

_CLOCK, _TRANSPORT = 80, 81
_STEP_S = 1.0
_SPARE_S = 5.0
_ROUNDS = 4
"""Of inverting a clock: each gains four digits."""


class Device(IntEnum):
    """Everything that has a clock of its own."""

    HOST = 0
    IMU = 1
    CAMERA = 2
    GNSS = 3
    BASE = 4
    VEHICLE = 5


@dataclass(frozen=True)
class ClockOptions:
    """How far clocks are off, and how messages travel.

    A device was switched on up to `offset_s` before the flight; its clock runs wrong by up to `drift_ppm`, which
    wanders by `wander_ppb` in a second. A message takes `delay_s` at least, up to `jitter_s` more, and the share
    `outliers` of them another `outlier_s`.
    """

    offset_s: Annotated[float, Range(0, 1e9)] = 300.0
    drift_ppm: Annotated[float, Range(0, 200)] = 20.0
    wander_ppb: Annotated[float, Range(0, 100)] = 1.0
    delay_s: Annotated[float, Range(0, 1)] = 0.002
    jitter_s: Annotated[float, Range(0, 1)] = 0.004
    outliers: Annotated[float, Range(0, 1)] = 0.002
    outlier_s: Annotated[float, Range(0, 2)] = 0.1

    @classmethod
    def perfect(cls) -> ClockOptions:
        """All clocks right, and no time on the way."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class DeviceClock:
    """What a device's clock shows when: `offset_s` at true time 0, and a rate that is wrong by `errors` (K,).

    The errors of the rate, one a second from 5 s before the flight on, are linear in between.
    """

    def __init__(self, offset_s: float, errors: F64):
        self._errors = errors
        gained = np.concatenate([[0.0], np.cumsum((errors[1:] + errors[:-1]) / 2 * _STEP_S)])
        self._gained = gained - np.interp(_SPARE_S, np.arange(len(gained)) * _STEP_S, gained)
        self._offset_s = offset_s

    @classmethod
    def draw(cls, options: ClockOptions, seed: int, device: Device, duration_s: float) -> DeviceClock:
        """The clock of a device in a flight."""
        rng = np.random.default_rng([seed, _CLOCK, device])
        offset_s, drift = rng.uniform(0, options.offset_s), options.drift_ppm * 1e-6 * rng.uniform(-1, 1)
        steps = options.wander_ppb * 1e-9 * rng.standard_normal(int(duration_s + 2 * _SPARE_S) + 2)
        return cls(float(offset_s), drift + np.cumsum(steps))

    def device_s(self, t_s: F64) -> F64:
        """What the clock shows (N,) s at true times (N,) s."""
        x = (t_s + _SPARE_S) / _STEP_S
        k = np.clip(np.floor(x).astype(np.int64), 0, len(self._errors) - 2)
        within = (x - k) * _STEP_S
        rate, change = self._errors[k], (self._errors[k + 1] - self._errors[k]) / _STEP_S
        return np.asarray(self._offset_s + t_s + self._gained[k] + within * rate + within**2 / 2 * change)

    def true_s(self, device_s: F64) -> F64:
        """The true times (N,) s at which the clock shows (N,) s."""
        t_s = device_s - self._offset_s
        for _ in range(_ROUNDS):
            t_s = t_s + (device_s - self.device_s(t_s))
        return np.asarray(t_s)

    def rate(self, t_s: F64) -> F64:
        """By how much the clock runs too fast (N,) at true times (N,) s, 1e-6 being a ppm."""
        return np.interp(t_s, np.arange(len(self._errors)) * _STEP_S - _SPARE_S, self._errors)


class TransportDelay:
    """When the messages of a device arrive at the host: late, and in their order."""

    def __init__(self, options: ClockOptions, seed: int, device: Device):
        self._options = options
        self._rng = np.random.default_rng([seed, _TRANSPORT, device])
        self._latest_s = -np.inf

    def arrival_s(self, t_s: float) -> float:
        """The true time s at which a message arrives that left its device at the true time s; ask in order."""
        options, (jitter, outlier) = self._options, self._rng.random(2)
        delay_s = options.delay_s + options.jitter_s * jitter + options.outlier_s * (outlier < options.outliers)
        self._latest_s = max(self._latest_s, t_s + delay_s)
        return self._latest_s
