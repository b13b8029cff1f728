"""The command `evaluate`: a cloud against a reference, or a trajectory against the truth."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from common.errors import EvaluationError
from ground.evaluation.clouds import compare_clouds, read_cloud
from ground.evaluation.table import Comparison, as_json, render
from ground.evaluation.trajectories import compare_trajectories, read_trajectories


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments that `run` reads."""
    ours = parser.add_mutually_exclusive_group(required=True)
    ours.add_argument("--cloud", type=Path, metavar="A", help="our point cloud (LAZ, LAS or PLY)")
    ours.add_argument("--trajectory", type=Path, metavar="A", help="our trajectory (TUM)")
    against = parser.add_mutually_exclusive_group(required=True)
    against.add_argument("--reference", type=Path, metavar="B", help="reference cloud for --cloud")
    against.add_argument("--truth", type=Path, metavar="B", help="true trajectory for --trajectory")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(args: argparse.Namespace) -> int:
    """Compare, write the table or JSON to standard output and return 0. Raises EvaluationError."""
    comparison = compare(args)
    sys.stdout.write((as_json(comparison) if args.json else render(comparison)) + "\n")
    return 0


def compare(args: argparse.Namespace) -> Comparison:
    """The comparison that the arguments ask for. Raises EvaluationError when they do not fit together."""
    if args.cloud and args.reference:
        return compare_clouds(read_cloud(args.cloud), read_cloud(args.reference))
    if args.trajectory and args.truth:
        return compare_trajectories(*read_trajectories(args.trajectory, args.truth))
    raise EvaluationError(
        "a cloud needs --reference and a trajectory needs --truth: --cloud A --reference B, or --trajectory A --truth B"
    )
