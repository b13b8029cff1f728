"""The simulated base station as it reaches those who listen: what its receiver measures, in RTCM 3."""

from __future__ import annotations

import math
from collections.abc import Iterator

from air.gnss.msm_writer import MsmWriter
from air.sources.simulated.gnss.gnss import PROCESSING_S, SimulatedReceiver
from common import rtcm
from common.arrays import F64

STATION = 1
PLACE_EVERY_S = 10.0


class SimulatedBase:
    """MSM7 of every epoch of a receiver, and message 1006 as it begins and every ten seconds."""

    def __init__(self, receiver: SimulatedReceiver, p_ecef: F64):
        """`p_ecef` (3,) m is where its antenna stands."""
        self._receiver, self._p_ecef = receiver, p_ecef

    def packets(self) -> Iterator[tuple[float, bytes]]:
        """RTCM frames, each with the true time in s at which its last byte left."""
        writer, placed_s, line_free_s = MsmWriter(STATION), -math.inf, 0.0
        for observed in self._receiver.observations():
            payloads = writer.messages(observed.epoch)
            if observed.t_s - placed_s >= PLACE_EVERY_S:
                placed_s = observed.t_s
                payloads.insert(0, rtcm.pack_place(STATION, self._p_ecef))
            for frame in map(rtcm.frame, payloads):
                ready_s = max(line_free_s, observed.t_s + PROCESSING_S)
                line_free_s = ready_s + 10 * len(frame) / self._receiver.options.baud
                yield line_free_s, frame
