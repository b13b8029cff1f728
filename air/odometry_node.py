"""The node of the odometry: what follows from measurements goes onto the bus, and photos to the mapper."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Protocol

from air.config import AirConfig
from air.jump import Jump
from air.navigation import Navigator
from air.sources.known import Known
from common.clock import Clock, SystemClock
from common.errors import BusError, WireError
from common.keys import message_key
from common.measurements import CameraFrame, Measurement
from common.messages import Datum, EstimatorState, Health, Keyframe, Level, Message, Mode, Photo, Pose
from common.streams import DATUM, ESTIMATOR, HEALTH, POSE, POSE_IMU, Stream
from common.wire import encode

log = logging.getLogger(__name__)

ROLE = "odometry"
BEAT_S = 1.0


class Publisher(Protocol):
    """What the node needs of a bus."""

    def publish(self, key: str, payload: bytes, stream: Stream) -> None:
        """Send bytes under a key with the quality of service of the stream. Raises BusError."""
        ...


class OdometryNode:
    """Measurements in; poses at the rates of their streams, the estimator's state and photos out."""

    def __init__(
        self,
        config: AirConfig,
        known: Known,
        flight: str,
        bus: Publisher,
        map_photo: Callable[[Photo | Jump, Datum], None],
        clock: Clock | None = None,
    ) -> None:
        """`map_photo` takes the photos, in the world of a datum that stays for the flight, and the jumps of that."""
        self._config, self._known, self._flight = config, known, flight
        self._bus, self._map_photo, self._clock = bus, map_photo, clock or SystemClock()
        self._navigator = Navigator(known, flight, config.odometry)
        self._datum: Datum | None = None
        self._posed_ns = self._posed_revision = -1
        self._mode = Mode.INITIALIZING
        self._beaten_s, self._dropped = -BEAT_S, 0
        self._frames, self._slowest_s = 0, 0.0

    def take(self, measurement: Measurement) -> None:
        """Publish what follows from a measurement."""
        self._frames += isinstance(measurement, CameraFrame)
        try:
            told = self._navigator.feed(measurement)
        except Exception:
            log.exception("the odometry failed and begins anew")
            settings, revision = self._config.odometry, self._posed_revision + 1
            self._navigator = Navigator(self._known, self._flight, settings, datum=self._datum, revision=revision)
            return
        for message in told:
            match message:
                case Photo() | Jump():
                    assert self._datum is not None
                    self._map_photo(message, self._datum)
                case Datum():
                    self._datum = message
                    self._publish(DATUM, message)
                case Pose():
                    self._send(message)
                case EstimatorState():
                    self._mode = message.mode
                    self._publish(ESTIMATOR, message)
                case Keyframe():  # those of the map are the mapper's
                    pass

    def note_delay(self, delay_s: float) -> None:
        """Note how long after its arrival a frame was worked off."""
        self._slowest_s = max(self._slowest_s, delay_s)

    def beat(self, dropped: int) -> None:
        """Once a second, say where the world is and how it is doing; `dropped` frames found no room so far."""
        if time.monotonic() - self._beaten_s < BEAT_S:
            return
        self._beaten_s = time.monotonic()
        if self._datum is not None:
            self._publish(DATUM, self._datum)
        behind = dropped > self._dropped
        text = str(self._mode)
        if behind:
            text += f"; {dropped - self._dropped} frames were dropped: this computer does not keep up"
        if fault := self._navigator.odometry.estimator.gnss.base_fault:
            text += f"; {fault}"
        level = Level.DEGRADED if behind or fault or self._mode is Mode.INERTIAL else Level.OK
        counts = {"frames": self._frames, "dropped": dropped, "delay_ms": round(1000 * self._slowest_s)}
        self._dropped, self._slowest_s = dropped, 0.0
        self._publish(HEALTH, Health(self._clock.now_ns(), ROLE, level, text, counts))

    def _send(self, pose: Pose) -> None:
        """On board at the rate of the IMU, by radio as often as its stream says and at once after a jump."""
        self._publish(POSE_IMU, pose)
        if pose.revision == self._posed_revision and pose.t_ns - self._posed_ns < 0.99e9 / POSE.rate_hz:
            return
        self._posed_ns, self._posed_revision = pose.t_ns, pose.revision
        self._publish(POSE, pose)

    def _publish(self, stream: Stream, message: Message) -> None:
        try:
            self._bus.publish(message_key(self._config.vehicle, stream, message), encode(message), stream)
        except (WireError, BusError) as error:
            log.warning("not published: %s", error)
