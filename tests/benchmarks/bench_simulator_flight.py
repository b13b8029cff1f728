"""The assembled simulator: CPU time for each second of flight, device by device and as a whole, and its memory.

python tests/benchmarks/bench_simulator_flight.py [--seconds 60]
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

from figures import Figure, print_table

from air.config import AirConfig
from air.simulate import record_flight
from air.sources.source import open_source

WARM_S = 5.0
CAMERA_S = 20.0


def cpu_s(work):
    """CPU time of all threads that some work takes, s."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def through(items):
    """Run through an iterable."""
    for _ in items:
        pass


def devices(flight, seconds):
    """CPU time for a second of each device by itself, with its driver where it has one, ms."""
    aircraft = flight.aircraft

    def driven(name):
        driver = aircraft.drivers()[name]
        for _, data in aircraft.sent(name):
            driver.feed(data, 0)

    spent = {name: cpu_s(lambda name=name: driven(name)) for name in ("imu", "gnss", "base", "mavlink")}
    return [1e3 * s / seconds for s in spent.values()]


def recorded(flight):
    """Write the flight with its truth as a recording, and forget it."""
    with tempfile.TemporaryDirectory() as folder, (Path(folder) / "flight.mcap").open("wb") as file:
        record_flight(flight, file, AirConfig())


def main():
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds = parser.parse_args().seconds
    through(open_source(f"sim:plain?duration={WARM_S}"))
    columns, rendered = {}, []
    for seed in (1, 2):
        flight = open_source(f"sim:plain?seed={seed}&duration={seconds}")
        source, recording = cpu_s(lambda f=flight: through(f)), cpu_s(lambda f=flight: recorded(f))
        truth = cpu_s(lambda f=flight: through(f.truth.rows()))
        columns[f"seed {seed}"] = (
            *devices(flight, seconds),
            *(1e3 * spent / seconds for spent in (source, truth, recording)),
            seconds / source,
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        )
    for rate in (10, 30):
        flight = open_source(f"sim:playground?duration={CAMERA_S}&flight.start=air&camera.rate_hz={rate}")
        _ = flight.known  # renders once, for which all is compiled
        source = cpu_s(lambda f=flight: through(f))
        rendered += (1e3 * source / CAMERA_S, CAMERA_S / source)
    print("### Without a camera\n")
    print_table(
        (
            Figure("CPU time for a second of IMU, driver included", "ms", 1),
            Figure("of GNSS on board", "ms", 1),
            Figure("of the base station", "ms", 1),
            Figure("of the drone's telemetry", "ms", 1),
            Figure("of all, merged, stamped and decoded", "ms", 1),
            Figure("of the truth", "ms", 1),
            Figure("of the recording with truth", "ms", 1),
            Figure("real-time factor of the source", "×", 1, least=10.0),
            Figure("memory, at most", "MB", 0),
        ),
        columns,
    )
    print("### Over the playground, 1280×720 with all effects\n")
    print_table(
        (
            Figure("CPU time for a second of flight at 10 Hz", "ms", 0),
            Figure("real-time factor at 10 Hz", "×", 2, least=1.0),
            Figure("CPU time for a second of flight at 30 Hz", "ms", 0),
            Figure("real-time factor at 30 Hz", "×", 2),
        ),
        {"seed 1": rendered},
    )


if __name__ == "__main__":
    main()
