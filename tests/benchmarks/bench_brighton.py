"""Brighton Beach: 18 real photos through `process`, the cloud against the reference of another program.

python tests/benchmarks/bench_brighton.py
"""

import tempfile
from pathlib import Path

from figures import Figure, print_table, process, recording

from ground.evaluation.clouds import compare_clouds, read_cloud

FIGURES = (
    Figure("cloud to cloud, median", most=0.10),
    Figure("cloud to cloud, mean", most=0.20),
    Figure("cloud to cloud, standard deviation"),
    Figure("cloud to cloud, 90 %"),
    Figure("reference to cloud, median"),
    Figure("reference to cloud, mean"),
    Figure("completeness", "%", 1, least=0.85),
    Figure("turned by", "°", 2),
    Figure("scaled by", "", 4),
)


def figures_of(row):
    """The figures of one alignment."""
    ours, reference = row.to_reference, row.from_reference
    distances = (ours.median, ours.mean, ours.std, ours.p90, reference.median, reference.mean)
    return (*distances, row.completeness, row.rotation_deg, row.scale)


def main():
    """Runs the benchmark."""
    folder = recording("brighton_beach")
    with tempfile.TemporaryDirectory() as out:
        report = process(f"photos:{folder / 'images'}", Path(out))
        comparison = compare_clouds(read_cloud(Path(out) / "map.laz"), read_cloud(folder / "model.laz"))
    photos = report["photos"]
    print(
        f"{photos['placed']} of {photos['read']} photos placed, reprojection {report['reprojection_rms_px']:.2f} px, "
        f"focal length {report['cameras'][0]['fx']:.0f} px, {report['wall_s']:.0f} s\n"
    )
    _, rigid, similarity = comparison.rows
    print_table(FIGURES, {"rigid": figures_of(rigid), "similarity": figures_of(similarity)})


if __name__ == "__main__":
    main()
