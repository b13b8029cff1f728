"""From the first frames to the first states: at rest once the aircraft stands, in motion once it can be told."""

from __future__ import annotations

import numpy as np

from air.odometry.initial import Initial, KnownSpeed, Refusal
from air.odometry.initial_motion import initial_in_motion
from air.odometry.initial_rest import initial_at_rest
from air.odometry.preintegration import ImuBuffer
from air.odometry.settings import OdometrySettings
from air.odometry.tracker import TrackedFrame
from common.se3 import SE3

BLIND_S = 30.0
"""While a camera shows nothing, samples are kept for so long: GNSS may find the attitude from them."""


class Initialization:
    """Collects frames and tries, after each, to begin at rest, and every few frames to begin in motion."""

    def __init__(self, focal: float, T_body_cam: SE3, buffer: ImuBuffer, settings: OdometrySettings) -> None:
        self._focal, self._T_body_cam, self._buffer, self.settings = focal, T_body_cam, buffer, settings
        self._frames: list[TrackedFrame] = []
        self._speeds: list[KnownSpeed] = []
        self._tried_ns = 0

    def add_speed(self, speed: KnownSpeed) -> None:
        """Note what somebody else, such as a GNSS receiver, says about the speed: in steady flight the IMU cannot."""
        self._speeds = [s for s in self._speeds if speed.t_ns - s.t_ns < 60_000_000_000] + [speed]

    def feed(self, frame: TrackedFrame) -> Initial | Refusal:
        """States of this frame, or of several frames up to it; or why there are none yet."""
        s = self.settings.initialization
        begin_ns = frame.t_ns - round(max(s.span_s, s.still_s + 0.5) * 1e9)
        self._frames = [f for f in self._frames if f.t_ns >= begin_ns] + [frame]
        sighted = any(not f.blind for f in self._frames)
        self._buffer.forget(self._frames[0].t_ns if sighted else frame.t_ns - round(BLIND_S * 1e9))
        at_rest = self._at_rest(frame.t_ns)
        if isinstance(at_rest, Initial) or frame.t_ns - self._tried_ns < round(s.try_every_s * 1e9):
            return at_rest
        self._tried_ns = frame.t_ns
        return self._in_motion(frame.t_ns)

    def _at_rest(self, t_ns: int) -> Initial | Refusal:
        s = self.settings.initialization
        begin_ns = t_ns - round(s.still_s * 1e9)
        frames = [f for f in self._frames if f.t_ns >= begin_ns]
        if self._frames[0].t_ns > begin_ns or not self._buffer.covers(begin_ns, t_ns):
            return Refusal("too little was seen so far")
        samples = self._buffer.samples(begin_ns, t_ns)
        return initial_at_rest(samples, frames, self._focal, s, self.settings.imu)

    def _in_motion(self, t_ns: int) -> Initial | Refusal:
        s = self.settings.initialization
        frames = [f for f in self._frames if len(f.ids) and self._buffer.covers(f.t_ns, t_ns)]
        if len(frames) < s.frames:
            return Refusal("too few frames were seen so far")
        chosen = np.unique(np.round(np.linspace(0, len(frames) - 1, s.frames)).astype(int)).tolist()
        picked = [frames[i] for i in chosen]
        return initial_in_motion(
            picked, self._buffer, self._T_body_cam, self._focal, s, self.settings.imu, self._speeds
        )
