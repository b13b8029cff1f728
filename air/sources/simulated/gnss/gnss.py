"""Simulated u-blox receivers, in flight and as a base station: true motion in, UBX bytes out."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from air.gnss.gnss_time import SECOND_NS
from air.gnss.signals import LIGHT
from air.sensors import ubx
from air.sensors.ubx_messages import NAV_PVT, RXM_RAWX, RXM_SFRBX, pack_sfrbx
from air.sensors.ubx_pvt import pack_pvt
from air.sensors.ubx_rawx import pack_rawx, parse_rawx
from air.sources.simulated.gnss.antenna import Antenna
from air.sources.simulated.gnss.broadcast import Broadcast, Piece
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.gnss.observables import TRACKING, Blocked, Observables, Observer
from air.sources.simulated.gnss.own_solution import OwnSolution
from air.sources.simulated.gnss.sky import Sky
from air.sources.simulated.gnss.tracking import WARM_S, Tracked, Tracking
from common.arrays import F64
from common.measurements import GnssEpoch

ROVER, BASE_STATION = 54, 61
"""First part numbers of the random streams of the two receivers."""
PROCESSING_S, _SOLVING_S = 0.03, 0.01
"""From the epoch to its raw measurements, and from these to the solution."""
_RESET_S = 1e-3
_WARM_HZ = 0.1
_SIGMA_FLOOR = 0.01, 0.004, 0.002
"""The smallest deviations that the receiver can tell: m, cycles, Hz."""


@dataclass(frozen=True, eq=False)
class Observed:
    """An epoch as the receiver tells it, `payload` of RXM-RAWX, and the truth.

    At `t_s` of the flight its clock was ahead by `clock` s and gained `drift` s/s. Of each row of the epoch (N,):
    `azimuth`, `elevation` rad, `multipath` of the code m, `ambiguity` cycles.
    """

    t_s: float
    epoch: GnssEpoch
    payload: bytes
    clock: float
    drift: float
    azimuth: F64
    elevation: F64
    multipath: F64
    ambiguity: F64


class SimulatedReceiver:
    """A receiver under a sky. Whatever is asked of it begins at the flight's start, the same every time."""

    def __init__(
        self,
        device: str,
        antenna: Antenna,
        sky: Sky,
        options: GnssOptions,
        seed: int,
        duration_s: float,
        part: int = ROVER,
        blocked: Blocked | None = None,
    ):
        """Raises SourceError for impossible times in the options."""
        self.device = device
        self.options = options
        self._sky, self._seed, self._part, self._duration_s = sky, seed, part, duration_s
        self._antenna, self._blocked = antenna, blocked
        self._observer = Observer(sky, antenna, blocked, options, seed, part)
        self._names = np.array([[name, name] for name in sky.satellites], object)
        self._signals = np.array(sky.signals, object)

    def observations(self) -> Iterator[Observed]:
        """All epochs with their truth."""
        for _, second in self._seconds():
            yield from (observed for observed, _ in second)

    def packets(self) -> Iterator[tuple[float, bytes]]:
        """UBX frames (RXM-RAWX, RXM-SFRBX, NAV-PVT), each with the true time in s at which its last byte left."""
        waiting: list[tuple[float, int, bytes]] = []
        line_free_s, count = 0.0, 0
        tracked: Tracked | None = None
        own, broadcast = self._switched_on()
        for number, epochs in self._seconds():
            second = list(epochs)
            tracked = second[-1][1] if second else tracked
            pieces = self._pieces(broadcast, number, tracked) if tracked else ()
            for ready_s, frame in self._frames(own, pieces, [observed for observed, _ in second]):
                heapq.heappush(waiting, (ready_s, count, frame))
                count += 1
            # What later seconds bring is ready when they have begun.
            while waiting and (waiting[0][0] <= number + 1 or number >= int(self._duration_s)):
                ready_s, _, frame = heapq.heappop(waiting)
                line_free_s = max(line_free_s, ready_s) + 10 * len(frame) / self.options.baud
                yield line_free_s, frame

    def _frames(
        self, own: OwnSolution, pieces: Iterable[Piece], second: list[Observed]
    ) -> Iterator[tuple[float, bytes]]:
        """Frames of a second, in no order, with the times at which the receiver has them ready."""
        for piece in pieces:
            own.hear(piece.bits, piece.end_ns)
            yield self._since_start(piece.end_ns), ubx.frame(RXM_SFRBX, pack_sfrbx(piece.bits))
        for observed in second:
            ready_s = observed.t_s + PROCESSING_S
            yield ready_s, ubx.frame(RXM_RAWX, observed.payload)
            solution = own.solve(observed.epoch)
            yield ready_s + _SOLVING_S, ubx.frame(NAV_PVT, pack_pvt(solution, self._sky.constellation.leap_s))

    def _switched_on(self) -> tuple[OwnSolution, Broadcast]:
        """What the receiver knows at the start, and what it is going to hear."""
        constellation = self._sky.constellation
        known = [constellation.issue(name, self._sky.start_ns - SECOND_NS) for name in constellation.satellites]
        heard = [] if self.options.cold else [*known, constellation.ionosphere]
        own = OwnSolution(self.device, heard, constellation.leap_s)
        if not self.options.cold:
            for epoch in self._before_start():
                own.solve(epoch)
        return own, Broadcast(constellation)

    def _before_start(self) -> Iterator[GnssEpoch]:
        """Some epochs of a receiver that has been on for a while and moved, if at all, as the flight begins."""
        options = replace(self.options, rate_hz=_WARM_HZ, missing=0.0, slips=0.0)
        place, velocity = self._antenna(np.zeros(1))

        def straight(t_s: F64) -> tuple[F64, F64]:
            return place + t_s[:, None] * velocity, np.repeat(velocity, len(t_s), axis=0)

        observer = Observer(self._sky, straight, self._blocked, options, self._seed, self._part)
        tracking, clock = Tracking(options, len(self._sky.satellites), self._rng(0)), _Milliseconds()
        for _, observables in observer.seconds(-1.0, -WARM_S):
            chances = np.ones((len(observables.t_s), 2, *self._names.shape))
            yield from (observed.epoch for observed, _ in self._epochs(observables, tracking, clock, chances))

    def _pieces(self, broadcast: Broadcast, number: int, tracked: Tracked) -> Iterator[Piece]:
        """Pieces of navigation messages that a second completes, of satellites tracked since they began."""
        begin_ns = self._sky.start_ns + number * SECOND_NS
        for i in np.flatnonzero(tracked.code[:, 0]).tolist():
            for piece in broadcast.pieces(self._sky.satellites[i], begin_ns, begin_ns + SECOND_NS):
                if tracked.code_since[i, 0] <= self._since_start(piece.begin_ns):
                    yield piece

    def _since_start(self, t_ns: int) -> float:
        return (t_ns - self._sky.start_ns) / SECOND_NS

    def _seconds(self) -> Iterator[tuple[int, Iterator[tuple[Observed, Tracked]]]]:
        tracking = Tracking(self.options, len(self._sky.satellites), self._rng(0))
        clock = _Milliseconds()
        for number, observables in self._observer.seconds(self._duration_s):
            chances = self._rng(number + 1).random((len(observables.t_s), 2, *self._names.shape))
            yield number, self._epochs(observables, tracking, clock, chances)

    def _rng(self, number: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, self._part + TRACKING, number])

    def _epochs(
        self, now: Observables, tracking: Tracking, clock: _Milliseconds, chances: F64
    ) -> Iterator[tuple[Observed, Tracked]]:
        for n, t_s in enumerate(now.t_s.tolist()):
            tracked = tracking.step(t_s, now.receivable[n], now.cn0[n], chances[n])
            removed_s, reset = clock.step(float(now.clock[n]))
            yield self._observed(now, n, tracked, removed_s, reset), tracked

    def _observed(self, now: Observables, n: int, tracked: Tracked, removed_s: float, reset: bool) -> Observed:
        sky = self._sky
        rows = np.nonzero(tracked.code)
        t_s = float(now.t_s[n])
        f = sky.frequency[rows]
        wavelength = LIGHT / f
        carrier = tracked.carrier[rows]
        sigma = now.sigma[n][rows]
        floor = _SIGMA_FLOOR
        options = self.options
        epoch = GnssEpoch(
            t_ns=sky.start_ns + round((t_s + float(now.clock[n]) - removed_s) * SECOND_NS),
            receiver=self.device,
            satellites=tuple(self._names[rows]),
            signals=tuple(self._signals[rows]),
            pseudorange=now.code[n][rows] - LIGHT * removed_s,
            carrier_phase=np.where(
                carrier, (now.carrier[n][rows] - LIGHT * removed_s) / wavelength + tracked.ambiguity[rows], np.nan
            ),
            doppler=-now.rate[n][rows] / wavelength,
            cn0=now.cn0[n][rows],
            lock_s=np.where(carrier, t_s - tracked.carrier_since[rows], 0.0),
            half_cycle=tracked.half_cycle[rows] | ~carrier,
            sigma_pseudorange=np.maximum(options.code * sigma, floor[0]),
            sigma_carrier_phase=np.where(carrier, np.maximum(options.phase * sigma / wavelength, floor[1]), np.nan),
            sigma_doppler=np.maximum(options.doppler * sigma / wavelength, floor[2]),
            channel=sky.channel[rows[0]],
            leap_s=sky.constellation.leap_s,
            clock_reset=reset,
        )
        payload = pack_rawx(epoch)
        told = parse_rawx(payload, self.device)  # rounded as the message rounds
        assert told is not None
        return Observed(
            t_s=t_s,
            epoch=told,
            payload=payload,
            clock=float(now.clock[n]) - removed_s,
            drift=float(now.drift[n]),
            azimuth=now.azimuth[rows[0]],
            elevation=now.elevation[rows[0]],
            multipath=now.multipath[n][rows],
            ambiguity=tracked.ambiguity[rows],
        )


class _Milliseconds:
    """Whole milliseconds that the receiver takes off its clock to keep it within half of one."""

    def __init__(self) -> None:
        self._count: int | None = None

    def step(self, bias_s: float) -> tuple[float, bool]:
        """What is taken off a bias, s, and whether that is new."""
        before = self._count
        if before is None or abs(bias_s - before * _RESET_S) > 0.5 * _RESET_S:
            self._count = round(bias_s / _RESET_S)
        return (self._count or 0) * _RESET_S, before is not None and before != self._count
