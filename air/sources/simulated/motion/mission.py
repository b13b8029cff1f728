"""What the aircraft is told to do: the reference of a flight, and in which phase it is when."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal

import numpy as np

from common.arrays import F64
from common.config import Range
from common.errors import ConfigError

ACCELERATION = 1.5
"""At most, horizontally, m/s²; turns are cut so far that it suffices."""
LANDING_SPEED = 1.0
IDLE_S = 3.0
"""How long the rotors turn before taking off and after landing."""
_SMOOTHING_S = (1.0, 0.5)
_BEFORE_S = 100.0
_SHORTEST_S = 30.0
"""A flight with less time than this for its lines does not come home within it."""
_FLARE = 4.0
"""Up to this height above the ground, m, the wind takes hold of the aircraft little by little."""


@dataclass(frozen=True)
class FlightOptions:
    """What is flown, and through which air. Lengths m, speeds m/s, angles degrees.

    Survey lines of `length` m along `azimuth_deg` (from north, clockwise), `spacing` apart, fill a field `width` wide
    around home, at `height` above it; when all are flown, they are flown across, and so on until it is time to return.
    `waypoints`, as `east,north,height;…` from home, replace them. `start` in the air is on the first line at full
    speed. `wind` blows at 6 m above the ground from `wind_from_deg`; `turbulence` scales what belongs to it; a gust of
    up to `gusts` comes about every half minute; `shake_deg` is how far the body trembles.
    """

    mission: Literal["survey", "hover", "stand"] = "survey"
    start: Literal["ground", "air"] = "ground"
    height: Annotated[float, Range(2, 500)] = 40.0
    speed: Annotated[float, Range(0.1, 20)] = 3.0
    climb: Annotated[float, Range(0.1, 10)] = 2.0
    length: Annotated[float, Range(1, 5000)] = 80.0
    width: Annotated[float, Range(0, 5000)] = 60.0
    spacing: Annotated[float, Range(1, 500)] = 12.0
    azimuth_deg: Annotated[float, Range(-360, 360)] = 0.0
    heading_deg: Annotated[float, Range(-360, 360)] = 60.0
    waypoints: str = ""
    stand_s: Annotated[float, Range(0, 600)] = 8.0
    hover_s: Annotated[float, Range(0, 600)] = 5.0
    wind: Annotated[float, Range(0, 20)] = 4.0
    wind_from_deg: Annotated[float, Range(-360, 360)] = 250.0
    turbulence: Annotated[float, Range(0, 5)] = 1.0
    gusts: Annotated[float, Range(0, 15)] = 2.0
    shake_deg: Annotated[float, Range(0, 3)] = 0.15


class Phase(StrEnum):
    """What the aircraft is about."""

    STAND = "stand"
    TAKE_OFF = "take-off"
    SURVEY = "survey"
    HOVER = "hover"
    RETURN = "return"
    LAND = "land"


@dataclass(frozen=True, eq=False)
class Reference:
    """Where the aircraft should be at N instants, `step_s` apart.

    `p` (N, 3) m in world, from home; `heading` (N,) rad from east, counter-clockwise; `airborne` and `rotors` (N,) from
    0 to 1: how far the air moves it, and whether the rotors turn.
    """

    p: F64
    heading: F64
    airborne: F64
    rotors: F64


@dataclass(frozen=True, eq=False)
class Mission:
    """A polyline in time: (M,) times s, (M, 3) m from home; per leg (M − 1,) the heading rad and the phase."""

    t_s: F64
    p: F64
    heading: F64
    phases: tuple[Phase, ...]
    smoothing_s: tuple[float, ...]

    def phase(self, t_s: float) -> Phase:
        """The phase at a time, s since the flight's start."""
        leg = int(np.searchsorted(self.t_s, t_s, side="right")) - 1
        return self.phases[min(max(leg, 0), len(self.phases) - 1)]

    def reference(self, first_s: float, step_s: float, count: int) -> Reference:
        """The reference at `count` times from `first_s` on, s.

        Moving averages over the polyline bound the acceleration and the jerk, as the autopilot does.
        """
        windows = [2 * round(window / step_s / 2) + 1 for window in self.smoothing_s]
        reach = sum(window // 2 for window in windows)
        t = first_s + (np.arange(count + 2 * reach) - reach) * step_s
        leg = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, len(self.phases) - 1)
        turning = np.array([phase is not Phase.STAND for phase in self.phases], float)[leg]
        idle = np.ones(2 * round(IDLE_S / step_s) + 1)
        rotors = np.minimum(np.convolve(turning, idle, "same"), 1.0)
        rows = [*(np.interp(t, self.t_s, axis) for axis in self.p.T), self.heading[leg], rotors]
        for window in windows:
            rows = [np.convolve(row, np.full(window, 1 / window), "valid") for row in rows]
        east, north, up, heading, rotors = rows
        airborne = _smooth_step(up / _FLARE)
        return Reference(np.stack([east, north, up], axis=1), heading, airborne, rotors)


def _smooth_step(x: F64) -> F64:
    """0 up to 0, 1 from 1 on, twice continuously differentiable."""
    s = np.clip(x, 0, 1)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


def plan(options: FlightOptions, duration_s: float) -> Mission:
    """The mission of a flight of so many seconds: all of it where the time suffices, else its beginning.

    Raises ConfigError for waypoints that are none.
    """
    route = _Route(options, duration_s)
    if options.mission == "stand":
        route.wait(duration_s + _BEFORE_S, Phase.STAND)
        return route.mission()
    if options.start == "ground":
        route.wait(options.stand_s, Phase.STAND)
        route.go(np.array([0.0, 0.0, options.height]), options.climb, Phase.TAKE_OFF)
        route.wait(options.hover_s, Phase.HOVER)
    if options.mission == "hover":
        route.hover()
    else:
        route.survey(_waypoints(options))
    return route.mission()


class _Route:
    """A polyline that grows leg by leg."""

    def __init__(self, options: FlightOptions, duration_s: float):
        self._options = options
        self._duration_s = duration_s
        self._heading = np.pi / 2 - np.radians(options.heading_deg)
        self._t = [-_BEFORE_S, 0.0]
        height = options.height if options.start == "air" and options.mission != "stand" else 0.0
        self._p = [np.array([0.0, 0.0, height])] * 2
        self._headings = [self._heading]
        self._phases = [Phase.STAND if height == 0.0 else Phase.HOVER]

    def wait(self, seconds: float, phase: Phase) -> None:
        """Stay where it is."""
        self._add(seconds, self._p[-1], phase)

    def go(self, p: F64, speed: float, phase: Phase) -> None:
        """Fly straight to a place, m from home, at a speed; its nose ahead unless it goes up or down."""
        way = p - self._p[-1]
        if np.hypot(way[0], way[1]) > 0.5:
            turn = np.arctan2(way[1], way[0]) - self._heading
            self._heading += (turn + np.pi) % (2 * np.pi) - np.pi
        self._add(float(np.linalg.norm(way)) / speed, p, phase)

    def hover(self) -> None:
        """Hover until it is time to land; in a flight too short for that, all the time."""
        spare_s = self._duration_s - self._t[-1] - self._return_s(self._p[-1])
        self.wait(spare_s if spare_s > 0 else self._duration_s + _BEFORE_S, Phase.HOVER)
        self._land()

    def survey(self, waypoints: Iterator[F64]) -> None:
        """Fly from waypoint to waypoint as long as there is time, then home."""
        options = self._options
        if options.start == "air":
            self._p[-1] = next(waypoints)
        flown, in_time = 0, self._t[-1] + self._return_s(self._p[-1]) + _SHORTEST_S < self._duration_s
        for p in waypoints:
            arrival_s = self._t[-1] + float(np.linalg.norm(p - self._p[-1])) / options.speed
            if self._t[-1] > self._duration_s or (in_time and arrival_s + self._return_s(p) > self._duration_s):
                break
            self.go(p, options.speed, Phase.SURVEY)
            flown += 1
        if flown and options.start == "air":
            self._begin_flying()
        self.wait(options.hover_s, Phase.HOVER)
        self.go(np.array([0.0, 0.0, self._p[-1][2]]), options.speed, Phase.RETURN)
        self._land()

    def _begin_flying(self) -> None:
        """Let the first leg begin long before the flight, so that it starts at full speed."""
        back = (self._p[2] - self._p[1]) / (self._t[2] - self._t[1])
        self._p[0] = self._p[1] - _BEFORE_S * back
        self._headings[0], self._phases[0] = self._headings[1], self._phases[1]

    def mission(self) -> Mission:
        """The polyline, with a last leg that stays where it is."""
        self.wait(self._duration_s + _BEFORE_S, Phase.STAND)
        turn_s = float(np.sqrt(2)) * self._options.speed / ACCELERATION
        smoothing_s = (max(turn_s, 1.0), *_SMOOTHING_S)
        return Mission(np.array(self._t), np.array(self._p), np.array(self._headings), tuple(self._phases), smoothing_s)

    def _land(self) -> None:
        self.go(np.array([*self._p[-1][:2], 0.0]), LANDING_SPEED, Phase.LAND)

    def _return_s(self, p: F64) -> float:
        """How long hovering, returning and landing take from a place."""
        way = float(np.hypot(p[0], p[1]))
        return self._options.hover_s + way / self._options.speed + float(p[2]) / LANDING_SPEED + 2 * IDLE_S

    def _add(self, seconds: float, p: F64, phase: Phase) -> None:
        if seconds > 0:
            self._t.append(self._t[-1] + seconds)
            self._p.append(p)
            self._headings.append(self._heading)
            self._phases.append(phase)


def _waypoints(options: FlightOptions) -> Iterator[F64]:
    """Waypoints (3,) m from home, without an end."""
    if options.waypoints:
        listed = _listed(options.waypoints)
        while True:
            yield from listed
    azimuth = np.radians(options.azimuth_deg)
    while True:
        for along, across, turn in (
            (options.length, options.width, azimuth),
            (options.width, options.length, azimuth + np.pi / 2),
        ):
            yield from _lines(max(along, 1.0), across, options.spacing, turn, options.height)


def _lines(along: float, across: float, spacing: float, azimuth: float, height: float) -> Iterator[F64]:
    """Ends of parallel lines, flown to and fro."""
    ahead = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    right = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    count = max(1, round(across / spacing) + 1)
    for i in range(count):
        centre = right * (i - (count - 1) / 2) * spacing + np.array([0.0, 0.0, height])
        forth = 1 if i % 2 == 0 else -1
        yield centre - forth * along / 2 * ahead
        yield centre + forth * along / 2 * ahead


def _listed(text: str) -> list[F64]:
    points = []
    for item in text.split(";"):
        try:
            east, north, height = (float(value) for value in item.split(","))
        except ValueError:
            raise ConfigError(
                f"waypoints has {item!r}; allowed: east,north,height in m from home, split by ;"
            ) from None
        points.append(np.array([east, north, height]))
    if not np.isfinite(points).all() or min(p[2] for p in points) < 1 or len({tuple(p) for p in points}) < 2:
        raise ConfigError(f"waypoints is {text!r}; allowed: at least two different places, finite, 1 m high or more")
    return points
