"""Settings of GNSS in the odometry, with defaults that work for an F9P on a multirotor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from common.config import Range

Sigma = Annotated[float, Range(0.0, 1000.0)]
Seconds = Annotated[float, Range(0.0, 1e5)]


@dataclass(frozen=True)
class GnssSelection:
    """Which measurements are used.

    Satellites above `elevation_mask_deg`, with `min_cn0` dBHz, seen for `min_seen_s`; carrier phase only when
    `carrier`, after `min_lock_s` of lock. The receiver's own sigmas must be below `max_sigma_code` m and
    `max_sigma_rate` m/s. A pseudorange that moves by `max_jump` m against the Doppler is left out. A carrier slipped
    when it departs from its Doppler by `max_slip` m, or one band from the other by `max_split` m.
    """

    elevation_mask_deg: Annotated[float, Range(0.0, 60.0)] = 10.0
    min_cn0: Annotated[float, Range(0.0, 60.0)] = 28.0
    carrier: bool = True
    min_seen_s: Seconds = 1.0
    min_lock_s: Seconds = 1.0
    max_sigma_code: Sigma = 50.0
    max_sigma_rate: Sigma = 5.0
    max_jump: Sigma = 12.0
    max_slip: Sigma = 0.12
    max_split: Sigma = 0.05


@dataclass(frozen=True)
class GnssNoise:
    """One sigma of each error, m unless said otherwise, at 45 dBHz and in the zenith, where that matters.

    `code`, `carrier`, `rate` (m/s) are white; `code` and `carrier` are larger than their noise, as the loops of
    receivers and, of carriers, millimetres of multipath make it alike over many epochs. Of each satellite: `multipath`
    of the code, correlated over `multipath_s`, as its elevation lets it grow; `orbit` with the satellite's clock, of
    GPS, and `ionosphere` and `troposphere` beyond the models, all together over `slow_s`. How fast these change,
    Doppler and carrier see: by `orbit_drift` m/s, and by `drift` m/s where the ionosphere is in it, over `drift_s`; a
    carrier's ambiguity wanders by `ambiguity_walk` m/√s besides, and the delay between two systems by `system_walk`
    m/√s. Differences to a base station keep the share `differential` of what is slow, and have the base's own
    multipath of the code, `base`, correlated over `base_s`, of which its carriers leave little with time. Residuals
    beyond `robust` sigmas lose weight.
    """

    code: Sigma = 0.4
    carrier: Sigma = 0.02
    rate: Sigma = 0.04
    multipath: Sigma = 0.6
    multipath_s: Seconds = 30.0
    orbit: Sigma = 0.6
    ionosphere: Sigma = 1.2
    troposphere: Sigma = 0.12
    slow_s: Seconds = 2700.0
    drift: Sigma = 0.0008
    orbit_drift: Sigma = 0.0004
    drift_s: Seconds = 2500.0
    ambiguity_walk: Sigma = 0.001
    system_walk: Sigma = 0.01
    differential: Annotated[float, Range(0.0, 1.0)] = 0.02
    base: Sigma = 0.3
    base_s: Annotated[float, Range(1.0, 1e5)] = 60.0
    robust: Annotated[float, Range(1.0, 100.0)] = 4.0


@dataclass(frozen=True)
class GnssSettings:
    """Settings of GNSS in the odometry.

    `p_body_antenna` (x, y, z) m is the lever arm. Biases of satellites stay the same for `node_s`. Epochs older than
    `max_age_s` without a position of their own are not used.

    Pseudoranges place the world once, and again when the position's sigma has grown by the factor `reanchor`. In
    between, Doppler and carrier alone move the aircraft: what pseudoranges still learn about where the world lies would
    make poses creep by metres, and the map with them. Differences to a base station learn all the time.
    """

    p_body_antenna: tuple[float, ...] = (0.0, 0.0, 0.0)
    node_s: Seconds = 4.0
    max_age_s: Seconds = 60.0
    reanchor: Annotated[float, Range(1.0, 1000.0)] = 1.5
    selection: GnssSelection = field(default_factory=GnssSelection)
    noise: GnssNoise = field(default_factory=GnssNoise)
