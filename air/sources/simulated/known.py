"""What is calibrated of a simulated aircraft before it flies: all that an estimator may be told."""

from __future__ import annotations

from itertools import takewhile

import numpy as np

from air.sources.known import Known
from air.sources.simulated.aircraft import Aircraft
from air.sources.simulated.clocks import Device
from common.measurements import ImuSample, Measurement, ReceiverSolution

BENCH_S = 4.0
"""How long a device is watched to find the least time from sampling to arrival."""


def known_of(aircraft: Aircraft) -> Known:
    """What is known of an aircraft. The delays are found by watching each device for some seconds."""
    delays_s = {name: _least_delay(aircraft, name) for name in aircraft.drivers() if name != "base"}
    return Known({}, aircraft.nominal_extrinsics.p_body_antenna, aircraft.p_base_ecef, delays_s)


def _least_delay(aircraft: Aircraft, device: str) -> float:
    """From sampling to arrival, s; what the driver stamps by arrival is only late by its way."""
    driver = aircraft.drivers()[device]
    delays = []
    for t_s, data in takewhile(lambda sent: sent[0] < BENCH_S, aircraft.sent(device)):
        for measurement in driver.feed(data, 0):
            if (sampled_s := _sampled_s(aircraft, measurement)) is not None:
                delays.append(t_s - sampled_s)
    return round(float(min(delays, default=0.0)) + aircraft.options.clock.delay_s, 6)


def _sampled_s(aircraft: Aircraft, measurement: Measurement) -> float | None:
    if isinstance(measurement, ImuSample):
        return float(aircraft.clocks[Device.IMU].true_s(np.array(measurement.t_ns * 1e-9)))
    if isinstance(measurement, ReceiverSolution):
        return (measurement.t_ns - aircraft.start_ns) * 1e-9
    return None
