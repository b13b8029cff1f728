"""What a simulated base station sends, and the same as its receiver knows it."""

from __future__ import annotations

from functools import cache

from gnss_scene import BASE_ECEF, BASE_WORLD, DATUM, sky

from air.sources.simulated.gnss.antenna import fixed_antenna
from air.sources.simulated.gnss.base import SimulatedBase
from air.sources.simulated.gnss.gnss import BASE_STATION, SimulatedReceiver
from air.sources.simulated.gnss.gnss_options import GnssOptions
from common.measurements import GnssEpoch


def standing(seconds: float) -> SimulatedReceiver:
    options = GnssOptions.base()
    antenna = fixed_antenna(BASE_WORLD, DATUM)
    return SimulatedReceiver("base", antenna, sky(options), options, 1, seconds, BASE_STATION)


@cache
def measured(seconds: float) -> list[GnssEpoch]:
    """The epochs of the receiver."""
    return [observed.epoch for observed in standing(seconds).observations()]


@cache
def sent(seconds: float) -> list[tuple[float, bytes]]:
    """RTCM frames with the times s at which they are sent."""
    return list(SimulatedBase(standing(seconds), BASE_ECEF).packets())
