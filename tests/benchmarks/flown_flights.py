"""Simulated video flights: rendered and tracked once, then kept as what an estimator is fed, and the truth."""

import pickle
import re
import time
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from air.odometry.estimator import Estimator
from air.odometry.odometry import Odometry
from air.odometry.settings import OdometrySettings
from air.odometry.tracker import TrackedFrame
from air.sensors.calibration import Calibration
from air.sources.simulated.motion.trajectory import Trajectory
from air.sources.source import open_source
from common.measurements import CameraFrame, ClockState, ImuSample, RawBytes
from common.messages import Datum

CAMERA = "down"
HALF_SAMPLE_NS = 2_500_000
"""Of the IMU, whose stamps move by nanoseconds when the receiver's time does."""


@dataclass(frozen=True, eq=False)
class FlownFlight:
    """A flight at `url`, which begins at `start_ns`; its world is ENU at `datum`.

    `messages` are all that an estimator is fed, in order of arrival, with tracked frames for the video; `tracker_s`
    says by a frame's time what decoding and tracking it took, CPU s. `p_body_antenna` (3,) and `p_base` (3,) m, ECEF,
    are what is known; `trajectory` is not.
    """

    url: str
    start_ns: int
    datum: Datum
    calibration: Calibration
    p_body_antenna: np.ndarray
    p_base: np.ndarray
    trajectory: Trajectory
    messages: list
    tracker_s: dict

    def seconds(self, t_ns):
        """Seconds of the flight at a time."""
        return (t_ns - self.start_ns) * 1e-9


def flown(url, folder):
    """The flight of a URL, from `folder` where it has been kept."""
    kept = folder / f"{re.sub(r'[^a-z0-9.]+', '-', url.removeprefix('sim:'))}.pkl"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps(_fly(url)))
    return pickle.loads(kept.read_bytes())


def sensed_anew(flight, options):
    """The flight with IMU and GNSS simulated anew with more options in its URL, beside the frames that it has.

    A frame comes after the same sample of the IMU as before.
    """
    source = open_source(f"{flight.url}&camera=off{options}")
    after_ns, frames, messages = 0, [], []
    for message in flight.messages:
        if isinstance(message, ImuSample):
            after_ns = message.t_ns + HALF_SAMPLE_NS
        elif isinstance(message, TrackedFrame):
            frames.append((after_ns, message))
    frames.reverse()
    for message in _fed(source):
        while isinstance(message, ImuSample) and frames and frames[-1][0] < message.t_ns:
            messages.append(frames.pop()[1])
        messages.append(message)
    return replace(flight, messages=messages)


class _Listening(Estimator):
    """An estimator that keeps the frames that it is fed, until they are taken, and when each came, CPU s."""

    kept = ()

    def add_frame(self, frame):
        self.kept = (*self.kept, (frame, time.process_time()))
        return super().add_frame(frame)

    def take(self):
        """The frames since it was asked last."""
        kept, self.kept = self.kept, ()
        return kept


def _fly(url):
    """Render and track a flight; the odometry runs along, because the tracker wants to know the gyroscope's bias."""
    source = open_source(url)
    aircraft, settings = source.aircraft, OdometrySettings()
    lever = aircraft.nominal_extrinsics.p_body_antenna
    settings = replace(settings, gnss=replace(settings.gnss, p_body_antenna=tuple(lever.tolist())))
    calibration = source.known.cameras[CAMERA]
    odometry, messages, tracker_s = Odometry(calibration, "flight", settings), [], {}
    odometry.estimator = _Listening(calibration.camera.fx, calibration.T_body_cam, settings, "flight")
    for message in tqdm(_fed(source), url, unit=" items", leave=False, disable=None):
        if not isinstance(message, CameraFrame):
            messages.append(message)
        begun = time.process_time()
        odometry.feed(message)
        for frame, tracked in odometry.estimator.take():
            messages.append(frame)
            tracker_s[frame.t_ns] = tracked - begun
    return FlownFlight(
        url,
        aircraft.start_ns,
        aircraft.datum,
        calibration,
        lever,
        aircraft.p_base_ecef,
        aircraft.trajectory,
        messages,
        tracker_s,
    )


def _fed(source):
    """What an estimator makes use of."""
    return (message for message in source if not isinstance(message, RawBytes | ClockState))
