"""The thread of a camera: opened, read, watched, and opened again when it was lost."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from air.devices.port import RETRY_S, Arrival, Take
from air.devices.settings import CameraConfig
from air.devices.status import DeviceStatus, Watch
from air.sensors.calibration import read_calibration
from air.sensors.camera import Camera, Shot, StampPoint
from air.sensors.driver import TimeScale
from common.errors import DeviceError

log = logging.getLogger(__name__)

NAME = "camera"
FOREIGN_NS = 10_000_000_000
"""A stamp so far from now is of another clock than the host's monotonic one."""


class Capture(Protocol):
    """An open camera."""

    @property
    def scale(self) -> TimeScale:
        """DEVICE: stamps of the camera's own clock; ARRIVAL: of the host's monotonic clock."""
        ...

    def read(self) -> Shot | None:
        """The next frame, None for a damaged one; OSError when the camera is gone."""
        ...

    def close(self) -> None:
        """Let go of the camera."""
        ...


def open_capture(config: CameraConfig) -> Capture:
    """The camera that the configuration names. Raises DeviceError: what is wrong and what to do."""
    if config.device.startswith("realsense"):
        from air.devices.camera_realsense import RealsenseCapture

        return RealsenseCapture(config)
    from air.devices.camera_v4l2 import V4l2Capture

    return V4l2Capture(config)


class CameraReader:
    """A thread that reads a camera. `take` is called on that thread. Raises what `read_calibration` raises."""

    def __init__(
        self, config: CameraConfig, take: Take, open_it: Callable[[CameraConfig], Capture] = open_capture
    ) -> None:
        self._config, self._take, self._open_it = config, take, open_it
        known = read_calibration(Path(config.calibration).expanduser()) if config.calibration else None
        self.calibrations = {NAME: known} if known else {}
        realsense = config.device.startswith("realsense")
        self._camera = Camera(
            NAME,
            TimeScale.DEVICE if realsense else TimeScale.ARRIVAL,
            StampPoint.MIDDLE if realsense else config.stamp,
            known.line_time_s if known else 0.0,
            known.time_offset_s if known else 0.0,
        )
        self._watch = Watch(NAME, config.device)
        self._frames = self._damaged = self._bytes = 0
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=NAME, daemon=True)

    def start(self) -> None:
        """Begin to read, as soon as the camera is there."""
        self._thread.start()

    def close(self) -> None:
        """Stop and let go of the camera."""
        self._stopped.set()
        self._thread.join(1.0)

    def status(self) -> DeviceStatus:
        """How the camera is doing now."""
        counts = {"received_bytes": self._bytes, "frames": self._frames, "refused": self._damaged}
        return self._watch.status(time.monotonic(), counts)

    def _run(self) -> None:
        failed = 0
        while not self._stopped.is_set():
            try:
                capture = self._open_it(self._config)
            except DeviceError as error:
                self._watch.closed(str(error).removeprefix(f"{self._config.device}: "))
            else:
                failed = 0
                self._use(capture)
            if failed == 0:
                log.warning("%s: %s", NAME, self.status().fault or "stopped")
            self._stopped.wait(RETRY_S[min(failed, len(RETRY_S) - 1)])
            failed += 1

    def _use(self, capture: Capture) -> None:
        self._watch.opened(time.monotonic())
        log.info("%s: %s is open", NAME, self._config.device)
        try:
            while not self._stopped.is_set():
                self._read(capture)
        except OSError as error:
            self._watch.closed(f"was lost: {' '.join(str(error).split())}; waiting for it to come back")
        except Exception:  # a fault of ours: the other devices go on, and this one begins anew
            log.exception("%s: reading failed", NAME)
            self._watch.closed("reading failed by a fault in the program; the log tells more")
        finally:
            capture.close()

    def _read(self, capture: Capture) -> None:
        shot, now_ns = capture.read(), time.monotonic_ns()
        if shot is None:
            self._damaged += 1
            self._watch.received(now_ns * 1e-9, 0, 0, 0, [])
            return
        if self._camera.scale is TimeScale.ARRIVAL and abs(now_ns - shot.stamp_ns) > FOREIGN_NS:
            self._watch.note("its stamps are of another clock than CLOCK_MONOTONIC; arrival times are used")
            shot = replace(shot, stamp_ns=now_ns)
        frame = self._camera.frame(shot)
        self._frames += 1
        self._bytes += len(frame.data)
        self._watch.received(now_ns * 1e-9, len(frame.data), 1, 0, ["CameraFrame"])
        # The kernel stamps in the host's time: the frame then arrived, so to speak, at its stamp.
        arrival_ns = frame.t_ns if self._camera.scale is TimeScale.ARRIVAL else now_ns
        self._take(Arrival(NAME, self._camera.scale, arrival_ns, arrival_ns, [frame]))
