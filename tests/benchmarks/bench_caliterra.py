"""Caliterra: time and memory of `process` on 75 real photos of 1600×1200, everything written.

python tests/benchmarks/bench_caliterra.py
"""

import tempfile
from pathlib import Path

from figures import Figure, print_table, process, recording

GIB = 2**30


def main():
    """Runs the benchmark."""
    folder = recording("caliterra")
    with tempfile.TemporaryDirectory() as out:
        report = process(f"photos:{folder / 'images'}", Path(out))
    stages = report["stages_s"]
    figures = [Figure("wall time", "s", 1, most=75.0), Figure("peak memory", "GiB", 2, most=4.0)]
    figures.append(Figure("CPU time", "s", 1))
    figures += [Figure(f"{name}, wall time", "s", 1) for name in stages]
    figures += [Figure("photos placed", "", 0, least=report["photos"]["read"]), Figure("area mapped", "m²", 0)]
    values = [report["wall_s"], report["peak_memory_bytes"] / GIB, report["cpu_s"], *stages.values()]
    print_table(figures, {"75 photos": [*values, report["photos"]["placed"], report["area_m2"]]})


if __name__ == "__main__":
    main()
