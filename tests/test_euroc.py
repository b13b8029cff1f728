"""Folders in EuRoC's format as a source."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from air.sources.source import open_source
from common.errors import SourceError
from common.measurements import CameraFrame, Encoding, ImuSample

T0 = 1_403_715_273_262_142_976


def png(width: int, height: int) -> bytes:
    out = io.BytesIO()
    Image.fromarray(np.zeros((height, width), np.uint8)).save(out, "PNG")
    return out.getvalue()


def write_folder(root: Path) -> None:
    """Two cameras at 20 Hz and an IMU at 200 Hz, for a quarter of a second."""
    (root / "imu0").mkdir(parents=True)
    rows = [f"{T0 + 5_000_000 * i},0.1,0.2,0.3,{i}.0,2.0,9.81" for i in range(50)]
    (root / "imu0" / "data.csv").write_text("#timestamp [ns],w,w,w,a,a,a\r\n" + "\r\n".join(rows) + "\r\n")
    for name in ("cam0", "cam1"):
        (root / name / "data").mkdir(parents=True)
        stamps = [T0 + 50_000_000 * i for i in range(5)]
        (root / name / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\n" for t in stamps))
        for t in stamps:
            (root / name / "data" / f"{t}.png").write_bytes(png(6, 4))


def test_frames_and_samples_come_in_time_order_as_they_are(tmp_path: Path) -> None:
    write_folder(tmp_path / "mav0")
    for folder in (tmp_path, tmp_path / "mav0"):
        items = list(open_source(f"euroc:{folder}"))
        stamps = [item.t_ns for item in items]
        assert stamps == sorted(stamps)
        assert len(items) == 50 + 5 + 5
    frames = [item for item in items if isinstance(item, CameraFrame) and item.camera == "cam1"]
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert (frames[1].t_ns, frames[1].width, frames[1].height) == (T0 + 50_000_000, 6, 4)
    assert (frames[1].encoding, frames[1].data) == (Encoding.PNG, png(6, 4))
    sample = [item for item in items if isinstance(item, ImuSample)][3]
    np.testing.assert_array_equal([sample.gyro, sample.accel], [[0.1, 0.2, 0.3], [3.0, 2.0, 9.81]])


def test_the_real_recording_is_read_whole(real_data: Callable[[str], Path]) -> None:
    source = open_source(f"euroc:{real_data('euroc_v101_micro')}")
    items = list(source)
    frames = [item for item in items if isinstance(item, CameraFrame)]
    assert (len(frames), len(items) - len(frames)) == (95, 29_120)
    assert (frames[0].width, frames[0].height) == (752, 480)
    assert source.problems == ()
    # sensor.yaml as published: fu, and cam0's x axis is the body's y.
    calibration = source.calibrations["cam0"]
    assert calibration.camera.fx == 458.654
    np.testing.assert_allclose(calibration.T_body_cam.R[:, 0], [0.0149, 0.9996, -0.0258], atol=1e-4)


def test_what_is_damaged_or_missing_is_counted_and_left_out(tmp_path: Path) -> None:
    write_folder(tmp_path)
    (tmp_path / "cam0" / "data" / f"{T0}.png").unlink()
    (tmp_path / "cam0" / "data" / f"{T0 + 50_000_000}.png").write_bytes(b"no image")
    table = tmp_path / "imu0" / "data.csv"
    rows = table.read_text().splitlines()
    rows[1] = rows[1].replace("9.81", "nan")
    rows[2] = rows[2].replace("0.1", "zero")
    rows[3] = rows[3][:30]
    table.write_text("\n".join(rows))
    (tmp_path / "cam1" / "data.csv").write_bytes(b"\xff\x00" * 50_000)
    source = open_source(f"euroc:{tmp_path}")
    items = list(source)
    assert len([item for item in items if isinstance(item, ImuSample)]) == 47
    assert [item.index for item in items if isinstance(item, CameraFrame)] == [2, 3, 4]
    texts = [f"{problem.name}: {problem.text}" for problem in source.problems]
    assert any("does not hold six numbers" in text and "2 times" in text for text in texts)
    assert any("is not whole" in text and text.startswith("imu0") for text in texts)
    assert any("no readable PNG" in text for text in texts)
    assert len(texts) < 10


def test_an_unusable_calibration_is_a_problem_and_not_the_end(tmp_path: Path) -> None:
    write_folder(tmp_path)
    (tmp_path / "cam0" / "sensor.yaml").write_text("camera_model: omni\n")
    source = open_source(f"euroc:{tmp_path}")
    assert len(list(source)) == 60
    assert "cam0" in {problem.name for problem in source.problems}


@pytest.mark.parametrize(("where", "named"), [("", "neither imu0"), ("/none", "does not exist"), ("/f", "is a file")])
def test_what_is_no_such_folder_is_refused_in_one_line(tmp_path: Path, where: str, named: str) -> None:
    (tmp_path / "f").write_text("")
    with pytest.raises(SourceError, match=named):
        open_source(f"euroc:{tmp_path}{where}")
    with pytest.raises(SourceError, match="unknown option"):
        open_source(f"euroc:{tmp_path}?speed=1")
