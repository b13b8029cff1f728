"""What is calibrated of a simulated aircraft before it flies: all that an estimator may be told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import numpy as np

from air.sensors.calibration import Calibration, to_toml
from air.sources.simulated.aircraft import Aircraft
from air.sources.simulated.clocks import Device
from common.arrays import F64
from common.measurements import ImuSample, Measurement, ReceiverSolution

BENCH_S = 4.0
"""How long a device is watched to find the least time from sampling to arrival."""


@dataclass(frozen=True, eq=False)
class Known:
    """Nominal values: they are off by what `extrinsics.…` and the like say.

    `cameras` by name; `p_body_antenna` (3,) m; `delays_s` from sampling to arrival at least, by device;
    `p_base_ecef` (3,) m of the base station's antenna, which is surveyed.
    """

    cameras: Mapping[str, Calibration]
    p_body_antenna: F64
    delays_s: Mapping[str, float]
    p_base_ecef: F64

    def write(self, folder: Path) -> list[Path]:
        """The files written into a folder, which is created: `aircraft.toml`, and `NAME.toml` of each camera."""
        folder.mkdir(parents=True, exist_ok=True)
        lines = ["# From the IMU to the phase centre of the GNSS antenna, forward, left, up, m."]
        lines += [f"p_body_antenna = {self.p_body_antenna.tolist()}"]
        lines += ["# The base station's antenna, ECEF, m.", f"p_base_ecef = {self.p_base_ecef.tolist()}"]
        lines += ["", "# Least time from sampling to arrival at the computer.", "[delay_s]"]
        lines += [f"{device} = {delay_s!r}" for device, delay_s in self.delays_s.items()]
        texts = {"aircraft": "\n".join(lines) + "\n"} | {n: to_toml(camera) for n, camera in self.cameras.items()}
        for name, text in texts.items():
            (folder / f"{name}.toml").write_text(text, encoding="utf-8")
        return [folder / f"{name}.toml" for name in texts]


def known_of(aircraft: Aircraft) -> Known:
    """What is known of an aircraft. The delays are found by watching each device for some seconds."""
    delays_s = {name: _least_delay(aircraft, name) for name in aircraft.drivers() if name != "base"}
    return Known({}, aircraft.nominal_extrinsics.p_body_antenna, delays_s, aircraft.p_base_ecef)


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
