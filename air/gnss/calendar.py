"""Calendar times in GPST and UTC, and the leap seconds between them."""

from __future__ import annotations

from datetime import datetime, timedelta

_EPOCH = datetime(1970, 1, 1)
YEARS = range(1980, 2200)
_LEAPS = (
    *((1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7), (1994, 7)),
    *((1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1)),
)
"""Year and month from whose first day on another leap second counts (IERS Bulletin C)."""


def from_calendar(moment: datetime) -> int:
    """Nanoseconds of GPST of a calendar time in GPST, which has no zone.

    Raises ValueError for years without GPS, or so far away that 64 bits could not hold them.
    """
    if moment.year not in YEARS:
        raise ValueError(f"the year {moment.year} is not within {YEARS.start} to {YEARS.stop - 1}")
    return (moment - _EPOCH) // timedelta(microseconds=1) * 1000


def to_calendar(t_ns: int) -> datetime:
    """Calendar time in GPST, without a zone, cut to microseconds."""
    return _EPOCH + timedelta(microseconds=t_ns // 1000)


def leap_seconds(utc: datetime) -> int:
    """GPST minus UTC in s at a time of UTC, as far as leap seconds are known."""
    return sum((utc.year, utc.month) >= leap for leap in _LEAPS)
