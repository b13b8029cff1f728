"""A camera's calibration, and the noise of the IMU, as EuRoC and Kalibr write them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import yaml

from air.sensors.calibration import Calibration
from common.se3 import SE3

IMU_RATE_HZ = 200
NOISE = {
    "gyroscope_noise_density": float(np.radians(0.01)),
    "gyroscope_random_walk": float(np.radians(10.0) / 3600 * np.sqrt(2 / 300)),
    "accelerometer_noise_density": 60e-6 * 9.80665,
    "accelerometer_random_walk": 15e-6 * 9.80665 * np.sqrt(2 / 300).item(),
}
"""Of the MTi-300's data sheet: rad/s/√Hz, rad/s²/√Hz, m/s²/√Hz, m/s³/√Hz; in-run biases wander within 300 s."""


def euroc_imu() -> str:
    """`imu0/sensor.yaml`: the IMU is the body."""
    sensor = {"sensor_type": "imu", "comment": "noise of an Xsens MTi-300 by its data sheet"}
    return _yaml(sensor | {"T_BS": _matrix(SE3.identity()), "rate_hz": IMU_RATE_HZ} | NOISE)


def euroc_camera(calibration: Calibration) -> str:
    """`cam0/sensor.yaml` of a camera; T_BS is left out where it is unknown."""
    camera, T_body_cam = calibration.camera, calibration.T_body_cam
    mounting = {} if T_body_cam is None else {"T_BS": _matrix(T_body_cam)}
    return _yaml(
        {
            "sensor_type": "camera",
            "comment": f"line time {calibration.line_time_s!r} s, IMU ahead by {calibration.time_offset_s!r} s",
            **mounting,
            "resolution": [camera.width, camera.height],
            "camera_model": "pinhole",
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "distortion_model": "radial-tangential",
            "distortion_coefficients": camera.distortion.tolist(),
        }
    )


def kalibr_imu() -> str:
    """Kalibr's `imu.yaml`."""
    return _yaml({"rostopic": "/imu0", "update_rate": float(IMU_RATE_HZ), **NOISE})


def kalibr_cameras(calibrations: Mapping[str, Calibration]) -> str:
    """Kalibr's camera chain of cameras by name (cam0, …)."""
    return _yaml({name: _kalibr_camera(name, calibration) for name, calibration in calibrations.items()})


def _kalibr_camera(name: str, calibration: Calibration) -> dict[str, object]:
    camera, T_body_cam = calibration.camera, calibration.T_body_cam
    mounting = {} if T_body_cam is None else {"T_cam_imu": T_body_cam.inverse().matrix.tolist()}
    return {
        **mounting,
        "camera_model": "pinhole",
        "distortion_coeffs": camera.distortion.tolist(),
        "distortion_model": "radtan",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "line_delay": calibration.line_time_s,
        "resolution": [camera.width, camera.height],
        "rostopic": f"/{name}/image_raw",
        "timeshift_cam_imu": calibration.time_offset_s,
    }


def _matrix(T: SE3) -> dict[str, object]:
    return {"cols": 4, "rows": 4, "data": T.matrix.ravel().tolist()}


def _yaml(table: dict[str, object]) -> str:
    return yaml.safe_dump(table, sort_keys=False, default_flow_style=None, width=1000)
