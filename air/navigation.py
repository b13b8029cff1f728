"""The odometry of a flight and the photos that follow from it: where the aircraft is, and what the map is made from."""

from __future__ import annotations

from dataclasses import replace

from air.jump import Jump
from air.odometry.odometry import Odometry, Output, Stage, unwatched
from air.odometry.settings import OdometrySettings
from air.sensors.calibration import Calibration
from air.sources.known import Known
from air.sources.source import Sensed
from air.sources.stills import StillPicker
from common.geo import T_world_other
from common.measurements import CameraFrame
from common.messages import Datum, EstimatorState, Keyframe, Photo, Pose
from common.se3 import SE3


class Navigator:
    """Feed it measurements in the order in which they came (core: no clock, thread, file).

    Its world is that of the flight's one datum, where GNSS or, before, the first photo found it: poses that are not in
    it yet, or not any more, are kept back. Without an IMU it gives photos at the receiver's positions, and no poses.
    """

    def __init__(
        self,
        known: Known,
        flight: str,
        settings: OdometrySettings,
        stage: Stage = unwatched,
        datum: Datum | None = None,
        revision: int = 0,
    ) -> None:
        """`stage` watches the parts of the work; `datum`, when the flight has one already, stays. The odometry's world
        begins with a `revision`."""
        self._flight = flight
        self._camera, calibration = mounted(known) or ("", None)
        self.odometry = Odometry(calibration, flight, with_lever_arm(settings, known), known.p_base_ecef, stage)
        self.odometry.estimator.revision = revision
        self._picker = StillPicker(known.cameras)
        self._T_flight_odometry = SE3.identity()
        self.datum = datum

    def feed(self, measurement: Sensed) -> list[Output | Photo]:
        """What it tells: the datum once, before any pose and any photo; each photo carries what was known of it."""
        others = isinstance(measurement, CameraFrame) and measurement.camera != self._camera
        in_world = self.odometry.in_world
        out: list[Output | Photo] = []
        for message in [] if others else self.odometry.feed(measurement):
            if isinstance(message, Pose | Keyframe) and not in_world:
                continue
            out += self._settle(message) if isinstance(message, Datum) else [self._moved(message)]
            if isinstance(message, EstimatorState):
                self._picker.calibrate(self._camera, message.T_body_cam, message.time_offset_s)
            if isinstance(message, Datum | Pose | Jump):
                out += self._pick(message)
        return out + self._pick(measurement)

    def _pick(self, message: Sensed | Datum | Pose | Jump) -> list[Output | Photo]:
        photo = self._picker.feed(message)
        if photo is None:
            return []
        first: list[Output | Photo] = []
        if self.datum is None and photo.fix is not None:
            self.datum = Datum(self._flight, photo.fix.latitude_deg, photo.fix.longitude_deg, photo.fix.height)
            first = [self.datum]
        return [*first, photo]

    def _settle(self, datum: Datum) -> list[Output | Photo]:
        """Tie the world of the odometry to that of the flight, which it becomes where there is none yet."""
        if self.datum is not None:
            self._T_flight_odometry = T_world_other(self.datum, datum)
            return []
        self.datum = datum
        return [datum]

    def _moved(self, message: Output) -> Output:
        """The message in the world of the flight."""
        T = self._T_flight_odometry
        if isinstance(message, Keyframe):
            return replace(message, T_world_cam=T @ message.T_world_cam)
        if isinstance(message, Pose):
            v_world = None if message.v_world is None else T.R @ message.v_world
            return replace(message, T_world_body=T @ message.T_world_body, v_world=v_world)
        return message


def mounted(known: Known) -> tuple[str, Calibration] | None:
    """The camera that the odometry follows and its calibration: the first one whose place on the body is known."""
    for name, calibration in known.cameras.items():
        if calibration.T_body_cam is not None:
            return name, calibration
    return None


def with_lever_arm(settings: OdometrySettings, known: Known) -> OdometrySettings:
    """The settings, with the lever arm of the antenna that is known of the aircraft where they give none."""
    if known.p_body_antenna is None or any(settings.gnss.p_body_antenna):
        return settings
    lever_arm = tuple(float(x) for x in known.p_body_antenna)
    return replace(settings, gnss=replace(settings.gnss, p_body_antenna=lever_arm))
