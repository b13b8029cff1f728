"""The broadcast data that a receiver holds: ephemerides by satellite, and the ionosphere."""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable

from common.measurements import Ephemeris, GlonassEphemeris, Ionosphere, KeplerEphemeris, Measurement

MAX_AGE_S = {"G": 7200.0, "J": 7200.0, "E": 14_400.0, "C": 21_600.0, "R": 1800.0}
"""How far from its reference time an ephemeris is used."""
FRESH_S = {"R": 900.0, "E": 7200.0}
"""How far from its reference time one stays in use where another has come: an hour unless it says so here."""
MAX_ISSUES = 256
"""Issues kept of each satellite: more than a day's; the oldest go first."""


class Ephemerides:
    """Keeps what was broadcast and finds what is valid for a satellite at a time. Memory is bounded."""

    def __init__(self, broadcast: Iterable[Measurement] = ()):
        self._issues: dict[tuple[str, bool], list[Ephemeris]] = {}
        self._ionosphere: dict[str, Ionosphere] = {}
        for message in broadcast:
            self.add(message)

    def __len__(self) -> int:
        return sum(len(issues) for issues in self._issues.values())

    def add(self, message: object) -> None:
        """Keep an ephemeris or an ionosphere; the newer of two with the same reference time. Ignore anything else."""
        if isinstance(message, Ionosphere):
            self._ionosphere[message.system] = message
        elif isinstance(message, KeplerEphemeris | GlonassEphemeris):
            issues = self._issues.setdefault((message.satellite, _is_fnav(message)), [])
            for i, known in enumerate(issues):
                if known.toe_ns == message.toe_ns:
                    if message.t_ns >= known.t_ns:
                        issues[i] = message
                    return
            insort(issues, message, key=lambda issue: issue.toe_ns)
            if len(issues) > MAX_ISSUES:
                issues.pop(0)

    def find(self, satellite: str, t_ns: int) -> Ephemeris | None:
        """The ephemeris with the reference time closest to `t_ns` (GPST), healthy or not; None where all are too old.

        Galileo's hold from their reference time on (OS SDD, age of data); its I/NAV is preferred to F/NAV, which
        belongs to other signals.
        """
        reach_ns = MAX_AGE_S.get(satellite[:1], 0.0) * 1e9
        for fnav in (False, True):
            best, distance_ns = None, reach_ns
            for issue in self._issues.get((satellite, fnav), ()):
                off_ns = abs(t_ns - issue.toe_ns)
                too_early = satellite[0] == "E" and issue.toe_ns >= t_ns
                if off_ns <= distance_ns and not too_early:
                    best, distance_ns = issue, off_ns
            if best is not None:
                return best
        return None

    def ionosphere(self) -> Ionosphere | None:
        """The model as broadcast, of GPS if there is one, else of QZSS or BeiDou."""
        return next((self._ionosphere[system] for system in "GJC" if system in self._ionosphere), None)

    def steady_ionosphere(self) -> Ionosphere | None:
        """The model for carriers."""
        return self.ionosphere()


class HeldEphemerides(Ephemerides):
    """Ephemerides that stay, for a satellite, with the issue that it was found with first, while that is fresh.

    From one issue, and one model of the ionosphere, to the next ranges step by decimetres, and carriers seem to slip.
    """

    def __init__(self, broadcast: Iterable[Measurement] = ()):
        super().__init__(broadcast)
        self._held: dict[str, Ephemeris] = {}
        self._steady: tuple[Ionosphere | None] | None = None

    def find(self, satellite: str, t_ns: int) -> Ephemeris | None:
        """The ephemeris in use; another one once that is old, or the health of the satellite has changed."""
        newest, held = super().find(satellite, t_ns), self._held.get(satellite)
        if newest is None:
            return None
        fresh_ns = FRESH_S.get(satellite[:1], 3600.0) * 1e9
        if held is None or abs(t_ns - held.toe_ns) > fresh_ns or is_healthy(held) != is_healthy(newest):
            held = self._held[satellite] = newest
        return held

    def steady_ionosphere(self) -> Ionosphere | None:
        """The model that was there when one was asked for first."""
        self._steady = self._steady or (self.ionosphere(),)
        return self._steady[0]


def is_healthy(ephemeris: Ephemeris) -> bool:
    """True where the satellite calls itself usable; QZSS's lowest bit concerns L6 alone."""
    mask = ~1 if ephemeris.satellite[:1] == "J" else ~0
    return ephemeris.health & mask == 0


def _is_fnav(message: Ephemeris) -> bool:
    return isinstance(message, KeplerEphemeris) and message.source == "FNAV"
