"""Calibrations of other programs' and our own files."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from air.sensors.calibration import Calibration, read_calibration, to_toml
from common.camera import CameraModel
from common.errors import LuojiaError, SourceError
from common.se3 import SE3, rotation_vector_to_matrix

CAMERA = CameraModel(1280, 720, 640.5, 641.25, 639.0, 359.5, -0.05, 0.06, 0.001, -0.0005)
T_BODY_CAM = SE3(rotation_vector_to_matrix(np.array([0.3, -1.2, 0.7])), np.array([0.1, -0.02, 0.05]))


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def kalibr(distortion: str = "radtan", shift: float = 0.0123) -> str:
    rows = "".join(f"  - {row}\n" for row in T_BODY_CAM.inverse().matrix.tolist())
    one = (
        f"  camera_model: pinhole\n  distortion_coeffs: [-0.05, 0.06, 0.001, -0.0005]\n"
        f"  distortion_model: {distortion}\n  intrinsics: [640.5, 641.25, 639.0, 359.5]\n"
        f"  resolution: [1280, 720]\n  timeshift_cam_imu: {shift}\n"
    )
    return f"cam0:\n  T_cam_imu:\n{rows}{one}cam1:\n{one}"


def test_our_own_file_comes_back_as_it_was(tmp_path: Path) -> None:
    calibration = Calibration(CAMERA, T_BODY_CAM, -0.004, 2.5e-5)
    text = to_toml(calibration, {"fx": 0.31, "rotation_rad": 0.002})
    assert "fx = 640.5  # ± 0.31" in text
    back = read_calibration(written(tmp_path, "cam.toml", text))
    assert (back.camera, back.time_offset_s, back.line_time_s) == (CAMERA, -0.004, 2.5e-5)
    assert back.T_body_cam is not None
    np.testing.assert_allclose(back.T_body_cam.matrix, T_BODY_CAM.matrix, atol=1e-12)


def test_kalibr_gives_the_inverse_of_its_transform_and_its_time_shift(tmp_path: Path) -> None:
    path = written(tmp_path, "camchain.yaml", kalibr())
    first, second = read_calibration(path), read_calibration(path, "cam1")
    assert first.camera == CAMERA
    assert first.time_offset_s == 0.0123
    assert first.T_body_cam is not None
    np.testing.assert_allclose(first.T_body_cam.matrix, T_BODY_CAM.matrix, atol=1e-12)
    assert second.T_body_cam is None
    with pytest.raises(SourceError, match=r"cam7 is missing; there are cam0, cam1"):
        read_calibration(path, "cam7")


def test_euroc_gives_the_camera_in_the_frame_of_its_imu(real_data: Callable[[str], Path]) -> None:
    folder = real_data("euroc_v101_micro")
    got = read_calibration(folder / "mav0" / "cam0" / "sensor.yaml")
    assert got.camera == CameraModel(
        752, 480, 458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05
    )
    assert got.T_body_cam is not None
    np.testing.assert_allclose(got.T_body_cam.t, [-0.0216401454975, -0.064676986768, 0.00981073058949])
    np.testing.assert_allclose(got.T_body_cam.R[0], [0.0148655429818, -0.999880929698, 0.00414029679422], atol=1e-8)


def test_what_opencv_writes_is_read(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    path = tmp_path / "camera.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", CAMERA.width)
    storage.write("image_height", CAMERA.height)
    storage.write("camera_matrix", CAMERA.K)
    storage.write("distortion_coefficients", np.append(CAMERA.distortion, 0.0).reshape(5, 1))
    storage.release()
    assert read_calibration(path).camera == CAMERA


def test_json_with_k_and_d_is_read_and_a_third_radial_term_refused(tmp_path: Path) -> None:
    table = {"xresolution": 1280, "yresolution": 720, "K": CAMERA.K.tolist(), "D": [CAMERA.distortion.tolist()]}
    assert read_calibration(written(tmp_path, "params.json", json.dumps(table))).camera == CAMERA
    table["D"] = [[0.1, 0.0, 0.0, 0.0, -0.6]]
    with pytest.raises(SourceError, match=r"params.json: .*-0.6\]; allowed: k1, k2, p1, p2, the rest 0"):
        read_calibration(written(tmp_path, "params.json", json.dumps(table)))


@pytest.mark.parametrize("model", ["equidistant", "fov", "omni"])
def test_other_distortions_are_refused_by_name(tmp_path: Path, model: str) -> None:
    path = written(tmp_path, "chain.yaml", kalibr(model))
    with pytest.raises(SourceError, match=rf"chain.yaml: cam0.distortion_model is '{model}'; allowed: radtan"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.yaml", "cam0: {resolution: [640, 480]}", "cam0.intrinsics is missing"),
        ("a.yaml", "resolution: [640, 480]\nintrinsics: [1, 2, x, 4]", "intrinsics is .* allowed: 4 numbers"),
        ("a.yaml", "resolution: [640, 480]\nintrinsics: [.nan, 2, 1, 4]", "not finite"),
        ("a.yaml", "resolution: [0, 480]\nintrinsics: [500, 500, 1, 4]", "must be ≥ 1"),
        ("a.yaml", kalibr().replace("[0.0, 0.0, 0.0, 1.0]", "[0.0]"), "cam0.T_cam_imu is .* allowed: 4×4 numbers"),
        ("a.yaml", "[1, 2", "is no YAML"),
        ("a.yaml", "just words", "holds no table"),
        ("a.json", "{", "is no JSON"),
        ("a.toml", "width = 640", "height is missing"),
        (
            "a.toml",
            to_toml(Calibration(CAMERA)) + "[T_body_cam]\nwxyz = [1.0, 1.0, 0.0, 0.0]\n",
            "T_body_cam.wxyz .* unit quaternion",
        ),
    ],
)
def test_an_unusable_file_is_named_with_its_key(tmp_path: Path, name: str, text: str, said: str) -> None:
    with pytest.raises(LuojiaError, match=said) as caught:
        read_calibration(written(tmp_path, name, text))
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)


@given(text=st.text(max_size=300) | st.binary(max_size=300), end=st.sampled_from([".yaml", ".json", ".toml"]))
def test_any_content_gives_a_calibration_or_an_error_of_ours(
    tmp_path_factory: pytest.TempPathFactory, text: str | bytes, end: str
) -> None:
    path = tmp_path_factory.getbasetemp() / f"any{end}"
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "replace"))
    with pytest.raises(LuojiaError):
        read_calibration(path)


@given(data=st.data())
def test_a_damaged_chain_gives_a_calibration_or_an_error_of_ours(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    text = bytearray(kalibr().encode())
    for at in data.draw(st.lists(st.integers(0, len(text) - 1), max_size=4)):
        text[at] = data.draw(st.integers(1, 127))
    path = tmp_path_factory.getbasetemp() / "damaged.yaml"
    path.write_bytes(text)
    with contextlib.suppress(LuojiaError):
        assert isinstance(read_calibration(path), Calibration)
