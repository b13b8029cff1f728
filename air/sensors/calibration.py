"""A camera's calibration: intrinsics, distortion, where it sits on the body, and how its clock is off.

Read from our TOML, a Kalibr camchain, a EuRoC/ASL `sensor.yaml`, or what OpenCV writes (YAML, or JSON with K and D).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml

from common.camera import CameraModel
from common.config import Range, load
from common.errors import SourceError
from common.se3 import SE3

MAX_BYTES = 1_000_000
"""A calibration is a page of text; a larger file is something else."""
RADTAN = ("radtan", "radial-tangential", "plumb_bob", "none")
"""Names of the distortion k1, k2, p1, p2; the only one that `CameraModel` knows."""
ROTATION_TOLERANCE = 1e-3
"""Files print few digits: how far a rotation may be from orthonormal before it is no rotation."""


@dataclass(frozen=True)
class Calibration:
    """Intrinsics of a camera, and its place and clock relative to the IMU.

    `T_body_cam` is None when unknown; time of the IMU = time of the frame + `time_offset_s`; `line_time_s` is the
    time from one row to the next (0: global shutter).
    """

    camera: CameraModel
    T_body_cam: SE3 | None = None
    time_offset_s: float = 0.0
    line_time_s: float = 0.0


def read_calibration(path: Path, camera: str | None = None) -> Calibration:
    """The calibration in a file. `camera` names one of a camchain's (cam0, …), the first one without it.

    Raises SourceError, or ConfigError for our TOML, naming the file, the key and what is allowed.
    """
    if path.suffix == ".toml":
        return _from_toml(path)
    table = _Table(path, _parse(path))
    if "intrinsics" in table.items and "resolution" in table.items:
        return _from_euroc(table)
    if "K" in table.items or "camera_matrix" in table.items:
        return _from_opencv(table)
    chain = [name for name in table.items if str(name).startswith("cam") and isinstance(table.items[name], dict)]
    if not chain:
        raise table.error("", "holds neither intrinsics, cam0 nor K; allowed: our TOML, Kalibr, EuRoC, OpenCV")
    name = camera or chain[0]
    if name not in chain:
        raise table.error(name, f"is missing; there are {', '.join(chain)}")
    return _from_kalibr(_Table(path, table.items[name], name + "."))


# Our own TOML


@dataclass(frozen=True)
class _Mounting:
    wxyz: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    t: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _File:
    width: Annotated[int, Range(1, 100_000)]
    height: Annotated[int, Range(1, 100_000)]
    fx: Annotated[float, Range(1.0, 1e6)]
    fy: Annotated[float, Range(1.0, 1e6)]
    cx: Annotated[float, Range(-1e6, 1e6)]
    cy: Annotated[float, Range(-1e6, 1e6)]
    k1: Annotated[float, Range(-100.0, 100.0)] = 0.0
    k2: Annotated[float, Range(-100.0, 100.0)] = 0.0
    p1: Annotated[float, Range(-100.0, 100.0)] = 0.0
    p2: Annotated[float, Range(-100.0, 100.0)] = 0.0
    time_offset_s: Annotated[float, Range(-10.0, 10.0)] = 0.0
    line_time_s: Annotated[float, Range(0.0, 0.01)] = 0.0
    T_body_cam: _Mounting | None = field(default=None)


def _from_toml(path: Path) -> Calibration:
    file = load(path, _File)
    camera = CameraModel(
        file.width, file.height, file.fx, file.fy, file.cx, file.cy, file.k1, file.k2, file.p1, file.p2
    )
    mounting = None
    if file.T_body_cam is not None:
        wxyz, t = np.array(file.T_body_cam.wxyz), np.array(file.T_body_cam.t)
        if wxyz.shape != (4,) or not 0.99 <= np.linalg.norm(wxyz) <= 1.01:
            raise SourceError(f"{path}: T_body_cam.wxyz is {wxyz.tolist()}; allowed: a unit quaternion, w first")
        if t.shape != (3,):
            raise SourceError(f"{path}: T_body_cam.t is {t.tolist()}; allowed: three numbers, m")
        mounting = SE3.from_quaternion(wxyz, t)
    return Calibration(camera, mounting, file.time_offset_s, file.line_time_s)


def to_toml(calibration: Calibration, sigma: dict[str, float] | None = None) -> str:
    """Our TOML of a calibration; `sigma` gives one standard deviation by key, written beside it as a comment."""
    known, camera, sigma = calibration, calibration.camera, sigma or {}
    values: dict[str, float] = {name: getattr(camera, name) for name in CameraModel.__dataclass_fields__}
    values |= {"time_offset_s": known.time_offset_s, "line_time_s": known.line_time_s}
    lines = [f"{key} = {value!r}{_plus_minus(sigma.get(key))}" for key, value in values.items()]
    if known.T_body_cam is not None:
        wxyz, t = known.T_body_cam.wxyz.tolist(), known.T_body_cam.t.tolist()
        lines += ["", "[T_body_cam]", f"wxyz = {wxyz}{_plus_minus(sigma.get('rotation_rad'))}", f"t = {t}"]
    return "\n".join(lines) + "\n"


def _plus_minus(sigma: float | None) -> str:
    return "" if sigma is None else f"  # ± {sigma:.2g}"


# Other programs' files


class _Table:
    """A parsed file, or a part of it, that says where it is wrong."""

    def __init__(self, path: Path, items: dict[str, Any], at: str = "") -> None:
        self.path, self.items, self.at = path, items, at

    def error(self, key: str, text: str) -> SourceError:
        return SourceError(" ".join(f"{self.path}: {self.at}{key} {text}".split()))

    def numbers(self, key: str, *shape: int) -> Any:
        """Finite numbers under a key as an array of a shape, -1 where it is free."""
        if key not in self.items:
            raise self.error(key, "is missing")
        value = self.items[key]
        try:
            array = np.array(value, float).reshape(shape)
        except (TypeError, ValueError):
            raise self.error(key, f"is {str(value)[:60]!r}; allowed: {'×'.join(map(str, shape))} numbers") from None
        if not np.isfinite(array).all():
            raise self.error(key, "holds a number that is not finite")
        return array

    def transform(self, key: str) -> SE3:
        """A rigid transform written as 16 numbers, row by row."""
        T = self.numbers(key, 4, 4)
        U, _, Vt = np.linalg.svd(T[:3, :3])
        R = U @ Vt
        if np.abs(R - T[:3, :3]).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
            raise self.error(key, "is no rigid transform: its upper left 3×3 is no rotation")
        return SE3(R, T[:3, 3])

    def camera(self, size: Any, fx: float, fy: float, cx: float, cy: float, distortion: Any) -> CameraModel:
        """A camera model of checked numbers."""
        width, height = (int(n) for n in size)
        if min(width, height) < 1 or min(fx, fy) < 1.0:
            raise self.error("", f"gives a camera of {width}×{height} px, focal lengths {fx}, {fy} px; all must be ≥ 1")
        if np.any(distortion[4:]):
            raise self.error("", f"has the distortion {distortion.tolist()}; allowed: k1, k2, p1, p2, the rest 0")
        k1, k2, p1, p2 = (float(k) for k in np.resize(distortion[:4], 4) * (len(distortion) > 0))
        return CameraModel(width, height, float(fx), float(fy), float(cx), float(cy), k1, k2, p1, p2)

    def refuse_other_models(self) -> None:
        """Raises SourceError for anything else than a pinhole with radial-tangential distortion."""
        for key, allowed in (("camera_model", ("pinhole",)), ("distortion_model", RADTAN)):
            if (name := self.items.get(key, allowed[0])) not in allowed:
                raise self.error(key, f"is {name!r}; allowed: {', '.join(allowed)}")


def _from_euroc(table: _Table) -> Calibration:
    """T_BS is the camera in the frame of the IMU: https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets."""
    table.refuse_other_models()
    fx, fy, cx, cy = table.numbers("intrinsics", 4)
    distortion = (
        table.numbers("distortion_coefficients", -1) if "distortion_coefficients" in table.items else np.zeros(4)
    )
    camera = table.camera(table.numbers("resolution", 2), fx, fy, cx, cy, distortion)
    if not isinstance(mounting := table.items.get("T_BS"), dict):
        return Calibration(camera)
    return Calibration(camera, _Table(table.path, mounting, "T_BS.").transform("data"))


def _from_kalibr(table: _Table) -> Calibration:
    """T_cam_imu maps the IMU's frame to the camera's; IMU time = camera time + timeshift_cam_imu (Kalibr's wiki)."""
    table.refuse_other_models()
    fx, fy, cx, cy = table.numbers("intrinsics", 4)
    distortion = table.numbers("distortion_coeffs", -1) if "distortion_coeffs" in table.items else np.zeros(4)
    camera = table.camera(table.numbers("resolution", 2), fx, fy, cx, cy, distortion)
    mounting = table.transform("T_cam_imu").inverse() if "T_cam_imu" in table.items else None
    shift = float(table.numbers("timeshift_cam_imu", 1)[0]) if "timeshift_cam_imu" in table.items else 0.0
    return Calibration(camera, mounting, shift)


def _from_opencv(table: _Table) -> Calibration:
    """What OpenCV's calibration sample and ROS's camera_calibration write, or JSON with K, D and the resolution."""
    table.refuse_other_models()
    names = {
        "K": ("K", "camera_matrix"),
        "D": ("D", "distortion_coefficients"),
        "width": ("xresolution", "image_width", "width"),
        "height": ("yresolution", "image_height", "height"),
    }
    found = {}
    for key, allowed in names.items():
        for name in allowed:
            if name in table.items:
                value = table.items[name]
                found[key] = value["data"] if isinstance(value, dict) and "data" in value else value
                break
        else:
            raise table.error(" or ".join(allowed), "is missing")
    flat = _Table(table.path, found, table.at)
    K = flat.numbers("K", 3, 3)
    size = (flat.numbers("width", 1)[0], flat.numbers("height", 1)[0])
    return Calibration(flat.camera(size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], flat.numbers("D", -1)))


class _Loader(yaml.SafeLoader):
    """Plain YAML, in which a matrix of OpenCV is its map of rows, columns and data."""


def _matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _parse(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1).decode("utf-8")
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError:
        raise SourceError(f"{path}: is no text; allowed: TOML, YAML or JSON") from None
    if len(text) > MAX_BYTES:
        raise SourceError(f"{path}: is larger than {MAX_BYTES} bytes: no calibration")
    try:
        # OpenCV's head `%YAML:1.0` is no YAML.
        body = "\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))
        items = json.loads(text) if path.suffix == ".json" else yaml.load(body, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError, TypeError, AttributeError) as error:
        where = getattr(error, "problem_mark", None)
        line = f" (line {where.line + 1})" if where is not None else ""
        raise SourceError(f"{path}: is no {path.suffix.lstrip('.').upper() or 'YAML'}{line}") from error
    if not isinstance(items, dict):
        raise SourceError(f"{path}: holds no table of keys; allowed: our TOML, Kalibr, EuRoC, OpenCV")
    return items
