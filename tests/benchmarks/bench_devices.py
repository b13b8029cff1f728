"""Live devices on virtual serial ports into the real `luojia-air run`: what it costs, and how soon it comes back.

python tests/benchmarks/bench_devices.py [--rounds 10]
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from figures import Figure, print_table, recording

sys.path.append(str(Path(__file__).resolve().parents[1]))

from bus_network import client_of, collect
from device_aircraft import Aircraft
from device_ports import wait_for

from common.keys import all_of
from common.measurements import RawBytes
from common.streams import HEALTH, RAW_BYTES
from common.wire import decode

AWAY_S = 3.0
"""Pulled out for so long, attempts to open have become as rare as they get."""
FIGURES = (
    Figure("CPU of `luojia-air run`", "%", 1),
    Figure("bytes of the IMU that reached the bus, but for those on their way", "%", 1, least=0.99),
    Figure("read again after it was put in, median", "s", 2),
    Figure("read again after it was put in, worst", "s", 2, most=2.0),
)


def cpu_s(pid):
    """CPU time of a process so far, s."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def figures(folder, rounds):
    """The figures of one run."""
    aircraft = Aircraft(folder, recording("gnss"), recording("xsens"))
    try:
        program = aircraft.run()
        wait_for(lambda: "imu" in program.said(), 30.0)
        bus = client_of(aircraft.endpoint)
        raw, _ = collect(bus, all_of(RAW_BYTES))
        health, _ = collect(bus, all_of(HEALTH))

        def heard():
            return sum(len(m.data) for _, p in list(raw) if (m := decode(RawBytes, p)).device == "imu")

        wait_for(lambda: len(health) > 4 and heard() > 0, 20.0)
        begun_s, begun_cpu_s, sent, got = time.monotonic(), cpu_s(program.process.pid), aircraft.imu.sent, heard()
        time.sleep(10.0)
        share = (cpu_s(program.process.pid) - begun_cpu_s) / (time.monotonic() - begun_s)
        whole = (heard() - got) / (aircraft.imu.sent - sent)
        back_s = []
        for i in range(rounds):
            aircraft.imu.unplug()
            time.sleep(AWAY_S + 0.13 * i)  # at another moment between two attempts each time
            count = heard()
            aircraft.imu.plug()
            back_s.append(wait_for(lambda count=count: heard() > count, 10.0))
        bus.close()
    finally:
        aircraft.close()
    return [share, whole, float(np.median(back_s)), max(back_s)]


def main():
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=10)
    rounds = parser.parse_args().rounds
    print(f"IMU at 100 Hz and GNSS at 1 Hz, as recorded; the IMU pulled out and put in again {rounds} times.\n")
    with tempfile.TemporaryDirectory() as folder:
        print_table(FIGURES, {"luojia-air run": figures(Path(folder), rounds)})


if __name__ == "__main__":
    main()
