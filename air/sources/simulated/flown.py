"""A simulated flight as a source, opened as `sim:playground?seed=1&duration=300&…`: bytes through the real drivers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

from air.sensors.driver import Driver, TimeScale
from air.sources.known import Known
from air.sources.live import HOST_TELLS_S, time_only
from air.sources.simulated.aircraft import Aircraft, Arrival
from air.sources.simulated.flight_truth import FlightTruth
from air.sources.simulated.known import known_of
from air.sources.simulated.options import parse_options
from air.sources.simulated.sites.ground import SITES, open_ground
from air.sources.source import Problem
from air.timing import Timebase
from common.errors import ConfigError, SourceError
from common.measurements import CameraFrame, Measurement, RawBytes

GNSS, BASE = "gnss", "base"


@dataclass(frozen=True, eq=False)
class Heard:
    """What one arrival at the host, at the true time `t_s`, tells.

    `device` sent `size` bytes, which completed so many `frames`; `dropped` bytes were none. `found` are the
    measurements in them, `measurements` all that follows: those of known time, the raw bytes, and the clocks' states.
    """

    t_s: float
    device: str
    size: int
    frames: int
    dropped: int
    found: Sequence[Measurement]
    measurements: Sequence[Measurement]


class SimulatedFlight:
    """The measurements of a simulated flight, as the host on board knows them: late, and in its own estimate of time.

    Everything is generated while it is read, the same at every iteration. `RawBytes` carry the time of arrival by the
    computer's own clock until the receiver's time is known; the rest is held back until then. The base station's
    measurements come as those of the device `base`, in its own receiver's time.
    """

    def __init__(self, url: str, aircraft: Aircraft):
        self._url = url
        self.aircraft = aircraft
        self._drivers: dict[str, Driver] = {}

    @property
    def url(self) -> str:
        """The URL that opened the flight."""
        return self._url

    @cached_property
    def truth(self) -> FlightTruth:
        """All that an estimator must not know."""
        return FlightTruth(self.aircraft)

    @cached_property
    def known(self) -> Known:
        """What was calibrated before the flight: where the sensors sit, nearly, and how late they are."""
        return known_of(self.aircraft)

    @property
    def problems(self) -> Sequence[Problem]:
        """What the drivers dropped and missed so far in the latest iteration."""
        found = []
        for name, driver in self._drivers.items():
            counts = driver.counts
            if counts.dropped_bytes or counts.refused:
                found.append(Problem(name, f"{counts.dropped_bytes} bytes dropped, {counts.refused} frames refused"))
            if counts.missing:
                found.append(Problem(name, f"frames that the device numbered and that never came: {counts.missing}"))
        return found

    def __iter__(self) -> Iterator[Measurement]:
        for heard in self.heard():
            yield from heard.measurements

    def heard(self) -> Iterator[Heard]:
        """The flight, arrival by arrival."""
        self._drivers = self.aircraft.drivers()
        host = _Host(self._drivers, Timebase(self.known.delays_s), self.aircraft)
        return map(host.take, self.aircraft.arrivals())


class _Host:
    """The computer on board: what its drivers make of the bytes, stamped as well as it knows the time."""

    def __init__(self, drivers: dict[str, Driver], timebase: Timebase, aircraft: Aircraft):
        self._drivers, self._timebase = drivers, timebase
        self._aircraft = aircraft
        self._switched_on_ns = aircraft.start_ns - aircraft.host_ns(0.0)
        self._told_ns = 0

    def take(self, arrival: Arrival) -> Heard:
        """What an arrival tells."""
        host_ns, device, data = self._aircraft.host_ns(arrival.t_s), arrival.device, arrival.data
        self._tell_time_of_day(host_ns)
        if isinstance(data, CameraFrame):
            told = self._stamped([data], device, TimeScale.DEVICE, host_ns, host_ns)
            return Heard(arrival.t_s, device, len(data.data), 1, 0, [data], told)
        raw = RawBytes(self._time_of_day_ns(host_ns), device, data)
        driver = self._drivers[device]
        counts = driver.counts
        frames, dropped = counts.frames.total(), counts.dropped_bytes
        found = driver.feed(data, host_ns)
        told = [raw, *self._stamped(found, device, driver.scale, host_ns, driver.sent_ns)]
        frames, dropped = counts.frames.total() - frames, counts.dropped_bytes - dropped
        return Heard(arrival.t_s, device, len(data), frames, dropped, found, told)

    def _stamped(
        self, found: Sequence[Measurement], device: str, scale: TimeScale, host_ns: int, sent_ns: int
    ) -> list[Measurement]:
        """Those of known time, and once a second the states of the clocks."""
        if device == BASE:  # far away: it tells nothing about the clocks on board
            return list(found)
        stamped = [self._timebase.restamp(measurement, device, scale, sent_ns) for measurement in found]
        return [*(known for known in stamped if known is not None), *self._timebase.states(host_ns)]

    def _tell_time_of_day(self, host_ns: int) -> None:
        """Let the computer's clock stand in for a receiver that is not there."""
        if GNSS not in self._drivers and host_ns - self._told_ns > HOST_TELLS_S * 1e9:
            self._told_ns = host_ns
            self._timebase.restamp(time_only(self._switched_on_ns + host_ns), "host", TimeScale.GNSS, host_ns)

    def _time_of_day_ns(self, host_ns: int) -> int:
        """GNSS time; as long as it is unknown, that of the computer's clock, which was set at the start."""
        known_ns = self._timebase.gnss_ns(host_ns)
        return self._switched_on_ns + host_ns if known_ns is None else known_ns


def open_flight(url: str, rest: str) -> SimulatedFlight:
    """The flight of a URL `sim:SITE?key=value&…`. Raises SourceError for an unknown site or option."""
    name, _, query = rest.partition("?")
    if name not in SITES:
        raise SourceError(f"source {url!r}: there is no site {name!r}; there are survey, {', '.join(SITES)}")
    options = parse_options(url, name, query)
    try:
        return SimulatedFlight(url, Aircraft(options, *open_ground(options, name)))
    except (ConfigError, SourceError) as error:
        raise SourceError(f"source {url!r}: {error}") from error
