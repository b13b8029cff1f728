"""GNSS time (GPST) as the rest of the system counts it, and as satellites broadcast it: weeks and seconds of a week.

`t_ns` counts the GPST calendar from 1970-01-01, like `common.clock`: Unix time without its leap seconds.
"""

from __future__ import annotations

SECOND_NS = 1_000_000_000
DAY_NS = 86_400 * SECOND_NS
WEEK_NS = 7 * DAY_NS
GPS_EPOCH_NS = 315_964_800 * SECOND_NS
"""1980-01-06, where GPST began."""
BDT_MINUS_GPST_NS = -14 * SECOND_NS
BEIDOU_EPOCH_NS = 1_136_073_600 * SECOND_NS - BDT_MINUS_GPST_NS
"""2006-01-01 00:00 BDT, in GPST."""


def from_week(week: int, tow_s: float) -> int:
    """GPST, ns, of a GPS week (not rolled over) and seconds of that week."""
    return GPS_EPOCH_NS + week * WEEK_NS + round(tow_s * 1e9)


def to_week(t_ns: int) -> tuple[int, float]:
    """GPS week (not rolled over) and seconds of that week of a time in GPST, ns."""
    week, rest_ns = divmod(t_ns - GPS_EPOCH_NS, WEEK_NS)
    return week, rest_ns * 1e-9


def nearest(t_ns: int, period_ns: int, near_ns: int) -> int:
    """The one of `t_ns` plus any number of periods that lies nearest to `near_ns`."""
    return t_ns + round((near_ns - t_ns) / period_ns) * period_ns
