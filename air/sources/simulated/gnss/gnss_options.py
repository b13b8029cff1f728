"""What the simulated GNSS does, and every error with its size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from common.config import Range
from common.errors import SourceError

Size = Annotated[float, Range(0.0, 1000.0)]
Switch = Annotated[int, Range(0, 1)]
Intervals = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class GnssOptions:
    """One sigma of each error, in m unless said otherwise; 0 turns an error off.

    `nav` is a RINEX navigation file whose satellites fly instead of the nominal ones. Epochs come at `rate_hz` but
    for the fraction `missing`, at random; nothing below `mask_deg` is tracked. `cold` switches the receiver on at the
    start; else it has been on for two minutes.

    Satellites: `orbit` (each axis) and `satellite_clock` against what they broadcast, of GPS; `sky` tells by how much
    other systems are better or worse. Air: `ionosphere` and `troposphere` scale the delays of Klobuchar's model, as it
    is broadcast, and of Saastamoinen's. Neither tells, of a satellite at the zenith, `troposphere_residual`, nor of the
    ionosphere `ionosphere_residual`, which all share, `ionosphere_gradient` in m over 1000 km to the north and as much
    to the east, and `ionosphere_ripples` of each satellite's own. All stay for tens of minutes and more.
    Receiver: `clock` scales the random walk of its oscillator, `clock_drift_ppm` is its largest mean drift;
    `inter_system` is a constant delay of each system; `code`, `phase` and `doppler` (m/s) are white noise at 45 dBHz;
    `multipath` and `carrier_multipath` are correlated over `multipath_s` seconds, and change from half their size at
    the zenith to twice at the horizon; `slips` of each carrier in an hour at 45 dBHz, more when weak; `half_cycle`
    leaves new carriers unresolved for some seconds.

    Where the defaults come from. Recordings (`tests/benchmarks/bench_multipath.py`): multipath of a walking F9P in weak
    signals is 0.3 to 0.8 m, of an M8 on a car 0.2 to 0.3 m, for 2 to 9 s and more; of a static F9T 0.5 m in strong
    signals and 1 m in weak ones, for a minute; of geodetic antennas 0.2 m high up and 0.3 m below 30°. Receivers
    smooth the code: 0.05 to 0.25 m is new each second. At two antennas of known places (`bench_slow_errors.py`) the
    broadcast ionosphere misses 1.2 m at the zenith and 2.2 m over 1000 km to the north, all else of GPS and Galileo
    is 0.4 m, and carriers drift by 0.2 to 0.7 mm/s. Published: Klobuchar's model takes off half of the ionosphere
    (IS-GPS-200, 20.3.3.5.2.5); orbits and clocks, see `sky`; troposphere 0.12 m (RTCA DO-229, A.4.2.4).

    `outage` and `jamming` are seconds of the flight, such as 60-180 or 60-90,300-330: nothing is received, or C/N0
    falls by `jamming_db`. `fault` satellites, from `fault_start` s on, are late by `fault_bias` and by `fault_ramp`
    m/s, without saying so. `baud` is the speed of the serial line.
    """

    nav: str = ""
    systems: str = "GREC"
    rate_hz: Annotated[float, Range(0.1, 20.0)] = 10.0
    missing: Annotated[float, Range(0.0, 0.95)] = 0.25
    mask_deg: Annotated[float, Range(0.0, 60.0)] = 7.0
    cold: Switch = 0
    orbit: Size = 0.35
    satellite_clock: Size = 0.5
    ionosphere: Size = 1.0
    ionosphere_residual: Size = 1.2
    ionosphere_gradient: Size = 0.9
    ionosphere_ripples: Size = 0.05
    troposphere: Size = 1.0
    troposphere_residual: Size = 0.1
    clock: Size = 1.0
    clock_drift_ppm: Annotated[float, Range(0.0, 10.0)] = 0.5
    inter_system: Size = 1.0
    code: Size = 0.1
    phase: Size = 0.0015
    doppler: Size = 0.03
    multipath: Size = 0.6
    carrier_multipath: Size = 0.002
    multipath_s: Annotated[float, Range(1.0, 3600.0)] = 30.0
    slips: Size = 1.0
    half_cycle: Switch = 1
    outage: str = ""
    jamming: str = ""
    jamming_db: Annotated[float, Range(0.0, 60.0)] = 20.0
    fault: Annotated[int, Range(0, 50)] = 0
    fault_bias: Annotated[float, Range(-1e6, 1e6)] = 50.0
    fault_ramp: Annotated[float, Range(-100.0, 100.0)] = 0.0
    fault_start: Annotated[float, Range(0.0, 1e6)] = 30.0
    baud: Annotated[int, Range(9600, 10_000_000)] = 921_600

    @classmethod
    def perfect(cls) -> GnssOptions:
        """A receiver without errors; of the air only what the broadcast models tell exactly."""
        return cls(missing=0.0, half_cycle=0, **dict.fromkeys(_ERRORS, 0.0))  # type: ignore[arg-type]

    @classmethod
    def base(cls) -> GnssOptions:
        """A base station in the open, with a good antenna. Satellites and air are those of the flight."""
        return cls(rate_hz=1.0, missing=0.0, multipath=0.3, multipath_s=60.0, slips=0.2)


_ERRORS = (
    *("orbit", "satellite_clock", "ionosphere_residual", "ionosphere_gradient", "ionosphere_ripples"),
    *(
        "troposphere_residual",
        "clock",
        "clock_drift_ppm",
        "inter_system",
        "code",
        "phase",
        "doppler",
        "multipath",
        "carrier_multipath",
        "slips",
    ),
)
"""What is 0 of a perfect receiver."""


def intervals(text: str, key: str) -> Intervals:
    """Times (start, end) in s, such as of 60-180 or 60-90,300-330. Raises SourceError naming the option."""
    found = []
    for part in filter(None, text.split(",")):
        try:
            start, end = (float(number) for number in part.split("-"))
        except ValueError:
            start, end = 0.0, -1.0
        if not 0.0 <= start < end < float("inf"):
            raise SourceError(
                f"option {key!r} is {text!r}, must be seconds of the flight such as 60-180 or 60-90,300-330"
            )
        found.append((start, end))
    return tuple(found)
