"""The command `evaluate`."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from evaluation_ground import ground

from common.errors import EvaluationError
from common.export.ply import write_points_ply
from common.export.trajectory import write_tum
from common.messages import Datum
from common.se3 import SE3
from ground.evaluation.command import add_arguments, run


def evaluate(*words: str | Path) -> int:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return run(parser.parse_args([str(word) for word in words]))


def test_cloud_is_compared_with_its_reference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, seed in (("a", 1), ("b", 2)):
        points = ground(10_000, seed)
        write_points_ply(tmp_path / f"{name}.ply", points, np.zeros(points.shape, np.uint8), Datum("f", 48.0, 9.0, 0.0))
    assert evaluate("--cloud", tmp_path / "a.ply", "--reference", tmp_path / "b.ply") == 0
    assert "reference → ours" in capsys.readouterr().out
    assert evaluate("--cloud", tmp_path / "a.ply", "--reference", tmp_path / "b.ply", "--json") == 0
    assert json.loads(capsys.readouterr().out)["points"] == 10_000


def test_trajectory_is_compared_with_the_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = [SE3(np.eye(3), p) for p in ground(20)]
    write_tum(tmp_path / "t.tum", np.arange(20) * 10**9, poses)
    assert evaluate("--trajectory", tmp_path / "t.tum", "--truth", tmp_path / "t.tum", "--json") == 0
    fields = json.loads(capsys.readouterr().out)
    assert [row["error"]["rmse"] < 1e-9 for row in fields["rows"]] == [True] * 3


def test_arguments_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="--reference"):
        evaluate("--cloud", tmp_path / "a.ply", "--truth", tmp_path / "t.tum")
    with pytest.raises(SystemExit):
        evaluate("--cloud", tmp_path / "a.ply")
