"""The simulator: CPU time for each rendered photo of a survey, and for the world before the first.

python tests/benchmarks/bench_simulator.py [--photos 10]
"""

import argparse
import statistics
import time

from figures import Figure, print_table

from air.sources.simulated.survey import Survey, SurveyOptions


def cpu_s(work):
    """CPU time of all threads that some work takes, s."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def main():
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=int, default=10)
    photos = parser.parse_args().photos
    compile_all = Survey("", SurveyOptions(photos=2))
    compile_all.photo(0)
    columns = {}
    for seed in (1, 2, 3):
        survey = Survey("", SurveyOptions(seed=seed, photos=60))
        world = cpu_s(lambda survey=survey: survey.truth)
        each = [cpu_s(lambda survey=survey, i=i: survey.photo(i)) for i in range(0, 60, max(1, 60 // photos))]
        columns[f"seed {seed}"] = (statistics.median(each), max(each), world)
    figures = (
        Figure("CPU time a photo of 1280×960, median", "s", 2),
        Figure("CPU time a photo, longest", "s", 2),
        Figure("CPU time for the world of 60 photos", "s", 2),
    )
    print_table(figures, columns)


if __name__ == "__main__":
    main()
