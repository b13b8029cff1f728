"""What is in every real recording with a device's protocol or a log's format: `luojia-air info` of each, as a table.

A gap is an interval of more than 1.5 times the median of its stream. Where the recordings are not installed, there is
nothing to tell.
"""

import time

from figures import RECORDINGS

from air.info import summarize, table
from air.sources.source import open_source

GNSS = "gnss/16dBatt_no_interference_coldstart"
SOURCES = (
    ("ubx", "gnss/nhm.ubx"),
    ("ubx", f"{GNSS}.ubx"),
    ("rinex", f"{GNSS}.obs.gz", f"{GNSS}.nav.gz"),
    ("rinex", "gnss/matrtklib_static/rover.obs", "gnss/matrtklib_static/base.nav"),
    ("xbus", "xsens/20260503_204234_xsensmti_with_gnss_recording.bin"),
    ("mavlink", "cuav/testimgs/flight.tlog"),
    ("cuav", "cuav/testimgs"),
    ("euroc", "euroc_v101_micro"),
    ("gopro", "karma/karma.mp4"),
    ("ulog", "telemetry/sample.ulg"),
    ("comma2k19", "comma2k19/segment"),
    ("photos", "brighton_beach/images"),
    ("photos", "caliterra/images"),
)
HEADING = ("source", "stream", "count", "rate, Hz", "gaps", "longest, s", "dropped bytes", "time, s", "× real time")


def rows_of(scheme, *parts):
    """The rows of one source: its streams, with what belongs to the whole source in the first."""
    begun = time.perf_counter()
    summary = summarize(open_source(f"{scheme}:{','.join(str(RECORDINGS / part) for part in parts)}"))
    took = time.perf_counter() - begun
    _, *streams = table(summary)
    counts = summary.counts
    dropped = "–" if counts is None else f"{counts.dropped_bytes} of {counts.received_bytes}"
    whole = (dropped, f"{took:.1f}", f"{summary.duration_s / took:.0f}")
    for i, (name, count, rate, _, _, gaps, longest, _) in enumerate(streams):
        source = "" if i else f"`{scheme}:{','.join(parts)}`"
        yield source, name, count, rate, gaps, longest, *(whole if i == 0 else ("", "", ""))


def main():
    """Print the table."""
    print(f"| {' | '.join(HEADING)} |\n|{' --- |' * len(HEADING)}")
    for scheme, *parts in SOURCES:
        if not all((RECORDINGS / part).exists() for part in parts):
            print(f"| `{scheme}:{','.join(parts)}` | not installed in ../shared/data |{' |' * (len(HEADING) - 2)}")
            continue
        for row in rows_of(scheme, *parts):
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
