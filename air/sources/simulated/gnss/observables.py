"""What a simulated receiver would measure of every signal in the sky, whether it tracks it or not.

Source: Misra and Enge, Global Positioning System, chapter 5 (observables and their errors); the ionosphere delays code
and advances carrier by f⁻².
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from air.gnss.signals import LIGHT
from air.sources.simulated.gnss.antenna import Antenna
from air.sources.simulated.gnss.gnss_options import GnssOptions, Intervals, intervals
from air.sources.simulated.gnss.multipath import Multipath, multipath, multipath_growth
from air.sources.simulated.gnss.receiver_clock import ReceiverClock
from air.sources.simulated.gnss.sky import Air, Sky, l1_squared_over
from common.arrays import F64, Bool
from common.geo import T_ecef_enu

Blocked = Callable[[F64, F64], Bool]
"""Whether buildings or ground hide the directions (S, 3), in ENU, from a place (3,) m, in world."""

NOISE_CN0 = 45.0
"""White noise has its nominal size at this C/N0, dBHz."""
_GLONASS_CODE = 1.5
_ZENITH_CN0, _HORIZON_CN0, _SECOND_CN0 = 49.0, 33.0, -3.0
_RAMP_S = 10.0
"""Jamming grows and fades over so long."""
CLOCK, MULTIPATH, NOISE, CHANNELS, MISSING, TRACKING = range(6)
"""Random streams of a receiver, counted from its first part number."""


_Conditions = tuple[Air, Multipath, Bool]


@dataclass(frozen=True, eq=False)
class Observables:
    """N epochs of one second and S satellites with two signals each.

    `t_s` (N,) true times; `clock` and `drift` (N,) of the receiver's uncorrected clock, s and s/s. Of the signals
    (N, S, 2): `code` and `carrier` m, against the uncorrected clock, and the carrier's `rate` m/s; `cn0` dBHz;
    `receivable`; `sigma`, by how much white noise is larger than at 45 dBHz; `multipath` m, in the code. Of the
    satellites (S,) at the second's begin: `azimuth` and `elevation` rad.
    """

    t_s: F64
    clock: F64
    drift: F64
    code: F64
    carrier: F64
    rate: F64
    cn0: F64
    receivable: Bool
    sigma: F64
    multipath: F64
    azimuth: F64
    elevation: F64


class Observer:
    """A receiver with its antenna, clock and noise, under a sky. `part` is the first of its random streams."""

    def __init__(self, sky: Sky, antenna: Antenna, blocked: Blocked | None, options: GnssOptions, seed: int, part: int):
        """Raises SourceError for impossible times in the options."""
        self._sky, self._antenna, self._blocked, self._options = sky, antenna, blocked, options
        self._T_world_ecef = T_ecef_enu(sky.datum).inverse()
        self._key = seed, part
        self._clock = ReceiverClock(options.clock, options.clock_drift_ppm, seed, part + CLOCK)
        rng = np.random.default_rng([seed, part + CHANNELS])
        self._channel_cn0 = 1.5 * rng.standard_normal((len(sky.satellites), 1))
        delays = dict(zip("GREC", options.inter_system * rng.standard_normal(4), strict=True))
        self._inter_system = np.array([delays[name[0]] for name in sky.satellites])
        self._outage: Intervals = intervals(options.outage, "outage")
        self._jamming: Intervals = intervals(options.jamming, "jamming")

    def seconds(self, duration_s: float, begin: int = 0) -> Iterator[tuple[int, Observables]]:
        """The observables of each second of the flight from `begin` ≤ 0 on, with its number."""
        states = multipath(self._options, len(self._sky.satellites), self._key[0], self._key[1] + MULTIPATH, begin)
        conditions = map(self._conditions, range(begin, int(duration_s) + 2), states)
        for second, (here, then) in enumerate(pairwise(conditions), begin):
            t_s = self._clock.time_of(self._ticks(second))
            present = self._present(second, len(t_s)) & (t_s <= duration_s)
            noise = self._rng(NOISE, second).standard_normal((3, len(t_s), len(self._sky.satellites), 2))
            yield second, self._observe(second, t_s[present], noise[:, present], here, then)

    def _ticks(self, second: int) -> F64:
        """Epochs (N,) in a second, s of the uncorrected clock."""
        rate = self._options.rate_hz
        return np.asarray(np.arange(np.ceil(second * rate), np.ceil((second + 1) * rate)) / rate)

    def _present(self, second: int, epochs: int) -> Bool:
        """Which of a second's epochs are not missing."""
        return np.asarray(self._rng(MISSING, second).random(epochs) >= self._options.missing)

    def _conditions(self, second: int, state: Multipath) -> _Conditions:
        """What holds at the begin of a second: the air, multipath, and which satellites are in sight."""
        position, _ = self._antenna(np.array([float(second)]))
        air = self._sky.air(float(second), position[0])
        seen = air.elevation >= np.radians(self._options.mask_deg)
        if self._blocked is not None and seen.any():
            seen[seen] = ~self._blocked(self._T_world_ecef.apply(position[0]), air.direction[seen])
        return air, state, seen

    def _observe(self, second: int, t_s: F64, noise: F64, here: _Conditions, then: _Conditions) -> Observables:
        (air, echo, seen), (air_then, echo_then, _) = here, then
        options, sky = self._options, self._sky
        geometry = sky.geometry(t_s, *self._antenna(t_s))
        clock, drift = self._clock.at(t_s)
        x = (t_s - second)[:, None]

        def between(before: F64, after: F64) -> F64:
            return before + (x if before.ndim == 1 else x[..., None]) * (after - before)

        bent = l1_squared_over(sky.frequency)
        ionosphere = between(air.ionosphere, air_then.ionosphere)[..., None] * bent
        troposphere = between(air.troposphere, air_then.troposphere)[..., None]
        ionosphere_rate = (air_then.ionosphere - air.ionosphere)[:, None] * bent
        air_rate = (air_then.troposphere - air.troposphere)[:, None] - ionosphere_rate
        distance = geometry.distance - geometry.clock + LIGHT * clock[:, None] + self._inter_system

        cn0 = self._cn0(air.elevation, t_s) + between(echo.fading, echo_then.fading)
        sigma = 10 ** ((NOISE_CN0 - cn0) / 20)
        growth = multipath_growth(air.elevation)[:, None]
        code_echo = options.multipath * growth * between(echo.code, echo_then.code)
        carrier_echo = options.carrier_multipath * growth * between(echo.carrier, echo_then.carrier)
        code_noise = sigma * options.code * np.where(sky.is_glonass, _GLONASS_CODE, 1.0)[:, None]
        rate = geometry.rate - geometry.clock_rate + LIGHT * drift[:, None]
        on = ~np.array([any(start <= t <= end for start, end in self._outage) for t in t_s.tolist()], bool)
        return Observables(
            t_s=t_s,
            clock=clock,
            drift=drift,
            code=distance[..., None] + ionosphere + troposphere + sky.group_delay + code_echo + code_noise * noise[0],
            carrier=distance[..., None] - ionosphere + troposphere + carrier_echo + options.phase * sigma * noise[1],
            # By the receiver's own seconds, as it counts cycles.
            rate=(rate[..., None] + air_rate) / (1 + drift[:, None, None]) + options.doppler * sigma * noise[2],
            cn0=cn0,
            receivable=on[:, None, None] & (seen[:, None] & sky.exists),
            sigma=sigma,
            multipath=code_echo,
            azimuth=air.azimuth,
            elevation=air.elevation,
        )

    def _cn0(self, elevation: F64, t_s: F64) -> F64:
        """C/N0 (N, S, 2) dBHz of the signals, without fading."""
        climb = np.sin(np.maximum(elevation, 0.0))[:, None] ** 0.7
        clear = _HORIZON_CN0 + (_ZENITH_CN0 - _HORIZON_CN0) * climb + self._channel_cn0 + np.array([0.0, _SECOND_CN0])
        jammed = np.zeros(len(t_s))
        for start, end in self._jamming:
            jammed = np.maximum(jammed, np.clip(np.minimum(t_s - start, end - t_s) / _RAMP_S, 0.0, 1.0))
        return np.asarray(clear - self._options.jamming_db * jammed[:, None, None])

    def _rng(self, stream: int, second: int) -> np.random.Generator:
        before_start = [1] if second < 0 else []
        return np.random.default_rng([self._key[0], self._key[1] + stream, abs(second), *before_start])
