"""What is calibrated of a simulated aircraft before it flies: all that an estimator may be told."""

from __future__ import annotations

from itertools import takewhile

import numpy as np

from air.sensors.calibration import Calibration
from air.sources.known import Known
from air.sources.simulated.aircraft import CAMERA, Aircraft
from air.sources.simulated.clocks import Device
from common.measurements import CameraFrame, ImuSample, Measurement, ReceiverSolution

BENCH_S = 4.0
"""How long a device is watched to find the least time from sampling to arrival."""


def known_of(aircraft: Aircraft) -> Known:
    """What is known of an aircraft. The delays are found by watching each device for some seconds."""
    delays_s = {name: _least_delay(aircraft, name) for name in aircraft.drivers() if name != "base"}
    cameras = {}
    if "camera" not in aircraft.options.off:
        camera = aircraft.camera()
        t_s, frame = next(camera.frames())
        delays_s[CAMERA] = _rounded(aircraft, [t_s - (_sampled_s(aircraft, frame) or t_s)])
        mounting = aircraft.nominal_extrinsics.T_body_cam
        cameras[CAMERA] = Calibration(aircraft.nominal_lens, mounting, line_time_s=camera.line_time_s)
    return Known(cameras, aircraft.nominal_extrinsics.p_body_antenna, aircraft.p_base_ecef, delays_s)


def _least_delay(aircraft: Aircraft, device: str) -> float:
    """From sampling to arrival, s; what the driver stamps by arrival is only late by its way."""
    driver = aircraft.drivers()[device]
    delays_s = []
    for t_s, data in takewhile(lambda sent: sent[0] < BENCH_S, aircraft.sent(device)):
        sampled = [_sampled_s(aircraft, measurement) for measurement in driver.feed(data, round(t_s * 1e9))]
        delays_s += [driver.sent_ns * 1e-9 - sampled_s for sampled_s in sampled if sampled_s is not None]
    return _rounded(aircraft, delays_s)


def _rounded(aircraft: Aircraft, delays_s: list[float]) -> float:
    return round(min(delays_s, default=0.0) + aircraft.options.clock.delay_s, 6)


def _sampled_s(aircraft: Aircraft, measurement: Measurement) -> float | None:
    if isinstance(measurement, ImuSample | CameraFrame):
        clock = aircraft.clocks[Device.IMU if isinstance(measurement, ImuSample) else Device.CAMERA]
        return float(clock.true_s(np.array(measurement.t_ns * 1e-9)))
    if isinstance(measurement, ReceiverSolution):
        return (measurement.t_ns - aircraft.start_ns) * 1e-9
    return None
