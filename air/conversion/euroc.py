"""Writes a flight as a folder in the format of EuRoC and ETH's Autonomous Systems Lab.

Source: Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 2016, section 4. Frames are stored as PNG, which
loses nothing of a raw frame. What the format does not know is left out: magnetic field, exposure, gain, frame numbers.
"""

from __future__ import annotations

import re
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np

from air.conversion.calibrations import euroc_camera, euroc_imu
from air.sensors.calibration import Calibration
from air.sensors.h264 import image_of
from air.sources.simulated.flight_truth import Row
from air.sources.source import Problem
from common.measurements import CameraFrame, Encoding, ImuSample

IMU_HEAD = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
CAMERA_HEAD = "#timestamp [ns],filename"
TRUTH_HEAD = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],"
    "b_w_RS_S_z [rad s^-1],b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]"
)
_TRUTH = ("p_world", "q_world_body", "v_world", "gyro_bias", "accel_bias")
_FAST_PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)


class EurocWriter:
    """A folder `mav0` that grows; cameras become cam0, cam1, … in the order in which they appear."""

    def __init__(self, folder: Path) -> None:
        self._root = folder / "mav0"
        self._open = ExitStack()
        self._tables: dict[str, TextIO] = {}
        self._cameras: dict[str, str] = {}
        self._unreadable: Counter[str] = Counter()

    def __enter__(self) -> EurocWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    @property
    def cameras(self) -> dict[str, str]:
        """The names of the cameras' folders by those of the cameras."""
        return self._cameras

    @property
    def problems(self) -> list[Problem]:
        """Frames that could not be written."""
        return [Problem(camera, f"{n} frames cannot be decoded; left out") for camera, n in self._unreadable.items()]

    def add_sample(self, sample: ImuSample) -> None:
        """Append a sample of the IMU. Raises OSError."""
        if "imu0" not in self._tables:
            self._begin("imu0", IMU_HEAD)
            (self._root / "imu0" / "sensor.yaml").write_text(euroc_imu(), encoding="utf-8")
        self._line("imu0", sample.t_ns, *map(repr, [*sample.gyro.tolist(), *sample.accel.tolist()]))

    def add_frame(self, frame: CameraFrame, calibration: Calibration | None) -> None:
        """Append a frame, with what is known of its camera at the first one. Raises OSError."""
        name = self._cameras.get(frame.camera) or self._new_camera(frame.camera, calibration)
        png, file = _png(frame), f"{frame.t_ns}.png"
        if png is None:
            self._unreadable[frame.camera] += 1
            return
        (self._root / name / "data" / file).write_bytes(png)
        self._line(name, frame.t_ns, file)

    def add_truth(self, row: Row) -> None:
        """Append a state of the truth. Raises OSError."""
        name = "state_groundtruth_estimate0"
        if name not in self._tables:
            self._begin(name, TRUTH_HEAD)
        columns = [f"{part}_{axis}" for part in _TRUTH for axis in ("wxyz" if part[0] == "q" else "xyz")]
        self._line(name, row.t_ns, *(repr(row.values[column]) for column in columns))

    def _new_camera(self, camera: str, calibration: Calibration | None) -> str:
        taken = set(self._cameras.values())
        free = next(name for name in (f"cam{i}" for i in range(len(taken) + 1)) if name not in taken)
        name = camera if re.fullmatch(r"cam\d+", camera) and camera not in taken else free
        self._begin(name, CAMERA_HEAD)
        (self._root / name / "data").mkdir(exist_ok=True)
        if calibration is not None:
            (self._root / name / "sensor.yaml").write_text(euroc_camera(calibration), encoding="utf-8")
        return self._cameras.setdefault(camera, name)

    def _begin(self, name: str, head: str) -> None:
        (self._root / name).mkdir(parents=True, exist_ok=True)
        path = self._root / name / "data.csv"
        self._tables[name] = self._open.enter_context(path.open("w", encoding="ascii", newline="\n"))
        self._tables[name].write(head + "\n")

    def _line(self, name: str, t_ns: int, *fields: str) -> None:
        self._tables[name].write(f"{t_ns},{','.join(fields)}\n")


def _png(frame: CameraFrame) -> bytes | None:
    """The pixels of a frame as PNG, or None when they cannot be had."""
    if frame.encoding is Encoding.PNG:
        return frame.data
    if frame.encoding in (Encoding.MONO8, Encoding.BGR8):
        image = image_of(frame)
    else:
        image = cv2.imdecode(np.frombuffer(frame.data, np.uint8), cv2.IMREAD_UNCHANGED)
    return None if image is None else bytes(cv2.imencode(".png", image, _FAST_PNG)[1])
