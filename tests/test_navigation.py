"""The odometry of a flight and its photos: where they say they were, in which world, and what goes out live."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from device_ports import wait_for
from gnss_flight import DATUM, START_NS, GnssFlight, flight
from numpy.testing import assert_allclose
from odometry_scene import T_BODY_CAM

from air.config import AirConfig
from air.navigation import Navigator, mounted, with_lever_arm
from air.odometry.gnss_settings import GnssSettings
from air.odometry.odometry import Output
from air.odometry.settings import OdometrySettings
from air.odometry_node import OdometryNode
from air.odometry_process import FRAMES, OdometryProcess
from air.odometry_report import Told
from air.sensors.calibration import Calibration
from air.sources.known import Known
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.source import Sensed
from common.camera import CameraModel
from common.export.trajectory import Trajectory
from common.geo import T_ecef_enu, T_world_other, geodetic_to_enu
from common.keys import parse_key
from common.measurements import CameraFrame, Encoding, FixKind, ImuSample, ReceiverSolution, VehicleState
from common.messages import Datum, Health, Level, Mode, Photo, Pose
from common.se3 import SE3, rotation_angle
from common.streams import DATUM as DATUM_STREAM
from common.streams import HEALTH, POSE, POSE_IMU, Stream
from common.wire import decode

ROOT = Path(__file__).parents[1]
CAMERA = CameraModel(128, 72, 64.0, 64.0, 63.5, 35.5)
SECONDS, BEGUN = 50, 30
"""GNSS and IMU alone know the attitude after the first turns."""
ELSEWHERE = Datum("", 30.5360, 114.3660, 60.0)
BLANK = bytes(128 * 72)
FIX = ReceiverSolution(10**9, "gnss", FixKind.FIX_3D, 30.5, 114.3, 60.0, 1.5, 3.0, np.zeros(3), 0.1, 1e-8, 20)


@pytest.fixture(scope="module")
def flown() -> GnssFlight:
    """A flight that begins in the air."""
    return flight(2, float(SECONDS), FlightOptions(start="air"))


def known_of(flown: GnssFlight) -> Known:
    return Known({"down": Calibration(CAMERA, T_BODY_CAM)}, np.array(flown.p_body_antenna))


def frame(t_ns: int, index: int = 0) -> CameraFrame:
    return CameraFrame(t_ns, "down", index, 128, 72, Encoding.MONO8, BLANK)


def sensed(flown: GnssFlight) -> Iterator[Sensed]:
    """The measurements, and then frames that show nothing: GNSS and IMU alone tell the motion."""
    yield VehicleState(START_NS, 1, height_home=40.0)
    frames = [(START_NS + k * 2_000_000_000 + 1_234_567, frame(0, k)) for k in range(BEGUN // 2, SECONDS // 2)]
    timed = [(getattr(m, "t_ns", START_NS), m) for m in flown.messages]
    early = [m for _, m in timed if not hasattr(m, "pseudorange") and not isinstance(m, ImuSample)]
    yield from early
    rest = [pair for pair in timed if pair[1] not in early]
    for t_ns, message in merge(rest, frames, key=lambda pair: pair[0]):
        yield frame(t_ns, message.index) if isinstance(message, CameraFrame) else message


@pytest.fixture(scope="module")
def navigator(flown: GnssFlight) -> Navigator:
    """One that the flight will be fed to."""
    return Navigator(known_of(flown), "flight", OdometrySettings())


@pytest.fixture(scope="module")
def told_each(navigator: Navigator, flown: GnssFlight) -> list[list[Output | Photo]]:
    """What it tells at each measurement."""
    return [navigator.feed(measurement) for measurement in sensed(flown)]


@pytest.fixture(scope="module")
def told(told_each: list[list[Output | Photo]]) -> list[Output | Photo]:
    """All that it tells."""
    return [told for each in told_each for told in each]


def test_a_photo_was_taken_where_the_odometry_says(flown: GnssFlight, told: list[Output | Photo]) -> None:
    photos = [m for m in told if isinstance(m, Photo)]
    assert len(photos) >= 4
    for photo in photos[1:]:
        p_world, _, R_world_body = flown.truth(photo.t_ns)
        assert photo.fix is not None
        assert photo.R_enu_cam is not None
        p = geodetic_to_enu(DATUM, photo.fix.latitude_deg, photo.fix.longitude_deg, photo.fix.height)
        # Pseudoranges of the 1.5 m class place the world.
        assert np.linalg.norm(p - (p_world + R_world_body @ T_BODY_CAM.t)) < 5.0
        assert 0.0 < photo.fix.sigma_horizontal < 5.0
        # GNSS alone tells the heading of a multirotor within some degrees.
        assert np.degrees(rotation_angle(photo.R_enu_cam.T @ R_world_body @ T_BODY_CAM.R)) < 10.0
        tilt = (photo.R_enu_cam.T - (R_world_body @ T_BODY_CAM.R).T) @ [0.0, 0.0, 1.0]
        assert np.degrees(np.linalg.norm(tilt)) < 1.5


def test_a_photo_has_the_pose_of_its_moment(told: list[Output | Photo]) -> None:
    """Frames come between two samples of the IMU."""
    datum = next(m for m in told if isinstance(m, Datum))
    poses = [m for m in told if isinstance(m, Pose)]
    t_s = np.array([(p.t_ns - START_NS) * 1e-9 for p in poses])
    for photo in (m for m in told if isinstance(m, Photo)):
        assert photo.fix is not None
        p = geodetic_to_enu(datum, photo.fix.latitude_deg, photo.fix.longitude_deg, photo.fix.height)
        k = int(np.searchsorted(t_s, (photo.t_ns - START_NS) * 1e-9))
        ends = np.array([(pose.T_world_body @ T_BODY_CAM).t for pose in poses[k - 1 : k + 1]])
        assert (p > ends.min(axis=0) - 1e-6).all()
        assert (p < ends.max(axis=0) + 1e-6).all()


def test_there_is_one_world_and_all_poses_are_in_it(flown: GnssFlight, told: list[Output | Photo]) -> None:
    kinds = [type(m) for m in told if isinstance(m, Datum | Pose | Photo)]
    assert kinds[0] is Datum
    assert kinds.count(Datum) == 1
    datum = next(m for m in told if isinstance(m, Datum))
    for pose in [m for m in told if isinstance(m, Pose)][1000::1000]:
        p = T_world_other(DATUM, datum).apply(pose.T_world_body.t)
        assert np.linalg.norm(p - flown.truth(pose.t_ns)[0]) < 5.0


def test_a_world_that_the_flight_has_already_stays(flown: GnssFlight, told: list[Output | Photo]) -> None:
    settled = Navigator(known_of(flown), "flight", OdometrySettings(), datum=ELSEWHERE)
    datum = next(m for m in told if isinstance(m, Datum))
    pose = [m for m in told if isinstance(m, Pose)][-1]
    assert settled._settle(datum) == []
    moved = settled._moved(pose)
    assert isinstance(moved, Pose)
    p_ecef = [T_ecef_enu(where).apply(m.T_world_body.t) for where, m in ((datum, pose), (ELSEWHERE, moved))]
    assert_allclose(p_ecef[0], p_ecef[1], atol=1e-6)
    assert settled.datum is ELSEWHERE


def test_without_an_imu_photos_come_at_the_positions_of_the_receiver() -> None:
    navigator, told = Navigator(Known(), "flight", OdometrySettings()), []
    told += navigator.feed(VehicleState(0, 1, height_home=40.0))
    told += navigator.feed(FIX)
    told += navigator.feed(frame(10**9))
    datum, photo = told
    assert isinstance(datum, Datum)
    assert isinstance(photo, Photo)
    assert (datum.latitude_deg, datum.longitude_deg, datum.height) == pytest.approx((30.5, 114.3, 60.0))


def test_the_configuration_goes_before_what_the_source_knows() -> None:
    known = Known(p_body_antenna=np.array([0.1, 0.2, 0.3]))
    given = OdometrySettings(gnss=GnssSettings(p_body_antenna=(1.0, 0.0, 0.0)))
    assert with_lever_arm(OdometrySettings(), known).gnss.p_body_antenna == (0.1, 0.2, 0.3)
    assert with_lever_arm(given, known) is given
    assert with_lever_arm(given, Known()) is given


def test_the_first_camera_whose_place_is_known_is_followed() -> None:
    there = Calibration(CAMERA, T_BODY_CAM)
    assert mounted(Known({"front": Calibration(CAMERA), "down": there, "rear": there})) == ("down", there)
    assert mounted(Known({"front": Calibration(CAMERA)})) is None


def test_what_was_told_is_summed_up(navigator: Navigator, told: list[Output | Photo]) -> None:
    kept = Told()
    for message in told:
        if not isinstance(message, Photo):
            kept.add(message)
    report = kept.report(navigator.odometry)
    assert report.world_found_s is not None
    assert 0.0 < report.world_found_s < BEGUN
    assert report.poses == len(kept.poses) > 1000
    assert max(report.modes_s, key=lambda mode: report.modes_s[mode]) == Mode.GNSS_INERTIAL
    assert sum(report.modes_s.values()) == pytest.approx(SECONDS - report.world_found_s, abs=1.0)
    assert report.statistics["satellites"]["median"] > 10


def test_poses_are_as_good_as_they_say(flown: GnssFlight, told: list[Output | Photo]) -> None:
    kept = Told()
    for message in told:
        if not isinstance(message, Photo):
            kept.add(message)
    t_ns = START_NS + np.arange(0, SECONDS * 20 - 20) * 50_000_000
    motions = [flown.truth(int(t)) for t in t_ns]
    truth = Trajectory(t_ns, tuple(SE3(R, p) for p, _, R in motions))
    found = kept.compare(truth, DATUM)
    assert found is not None
    assert found.poses == pytest.approx(len(kept.poses) / 200, abs=3)
    assert found.rmse <= found.largest < 8.0  # pseudoranges of the 1.5 m class
    assert found.nees < 14.2  # χ² of three, once in 370: its errors hardly change during the flight
    assert kept.compare(Trajectory(t_ns - 10**12, truth.poses), DATUM) is None


# Live


class _Bus:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.sent: list[tuple[Stream, bytes]] = []

    def publish(self, key: str, payload: bytes, stream: Stream) -> None:
        assert parse_key(key).stream is stream
        self.sent.append((stream, payload))


def test_poses_go_out_at_the_rates_of_their_streams_and_photos_to_the_mapper(
    flown: GnssFlight, told_each: list[list[Output | Photo]]
) -> None:
    bus, photos = _Bus(), list[tuple[Photo, Datum]]()
    node = OdometryNode(AirConfig(), known_of(flown), "flight", bus, lambda *taken: photos.append(taken))  # type: ignore[arg-type]
    again = iter(told_each)
    node._navigator.feed = lambda _: next(again)  # type: ignore[method-assign]
    for measurement in sensed(flown):
        node.take(measurement)  # type: ignore[arg-type]
    node.beat(0)
    count = Counter(stream.name for stream, _ in bus.sent)
    for wanted in (POSE, POSE_IMU):
        poses = [decode(Pose, payload) for stream, payload in bus.sent if stream is wanted]
        spaces_s = np.diff([pose.t_ns for pose in poses]) * 1e-9
        # As many as there are samples of the IMU, which come 5 ms apart.
        assert np.median(spaces_s) == pytest.approx(1 / wanted.rate_hz, abs=0.006 if wanted is POSE else 1e-4)
    assert count[DATUM_STREAM.name] == 2  # found, and the beat
    assert len({datum for _, datum in photos}) == 1
    assert len(photos) >= 4
    health = decode(Health, bus.sent[-1][1])
    assert (health.role, health.level, health.text) == ("odometry", Level.OK, "gnss-inertial")


def test_an_odometry_that_fails_begins_anew_in_the_same_world() -> None:
    node = OdometryNode(AirConfig(), Known(), "flight", _Bus(), lambda *_: None)  # type: ignore[arg-type]
    node.take(VehicleState(0, 1, height_home=40.0))
    node.take(FIX)
    node.take(frame(10**9))
    failed, datum = node._navigator, node._navigator.datum
    assert datum is not None

    def fail(_: object) -> list[Output]:
        raise RuntimeError("indeterminate")

    failed.odometry.feed = fail  # type: ignore[method-assign]
    node.take(ImuSample(2 * 10**9, np.array([0.0, 0.0, 9.8]), np.zeros(3)))
    assert node._navigator is not failed
    assert node._navigator.datum is datum


def test_frames_for_which_there_is_no_room_are_dropped_and_told() -> None:
    process = OdometryProcess(AirConfig(), Known(), lambda *_: None)
    process._process._process = SimpleNamespace(pid=1, exitcode=None)  # type: ignore[assignment]
    for k in range(FRAMES + 3):
        process.take(frame(k, k))
    assert process._process.dropped.value == 3
    process._process._process = SimpleNamespace(pid=None)  # type: ignore[assignment]
    process.close()
    bus = _Bus()
    node = OdometryNode(AirConfig(), Known(), "flight", bus, lambda *_: None)  # type: ignore[arg-type]
    node.beat(3)
    (stream, payload), health = bus.sent[-1], decode(Health, bus.sent[-1][1])
    assert stream is HEALTH
    assert payload
    assert health.level is Level.DEGRADED
    assert "3 frames were dropped" in health.text


# Processes that die


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and that nobody asked how does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_an_odometry_that_was_killed_is_replaced_by_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("air.odometry_process.AGAIN_S", 0.0)
    process = OdometryProcess(AirConfig(), Known(), lambda *_: None)
    sample = ImuSample(1, np.array([0.0, 0.0, 9.8]), np.zeros(3))
    try:
        process.take(sample)
        first = process._process._process.pid
        assert first is not None
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: process._process.exitcode is not None, 10.0)
        process.take(sample)
        second = process._process._process.pid
        assert second not in (None, first)
        assert process._process.exitcode is None
    finally:
        process.close()


MAPPER = """
import sys, time
from air.config import AirConfig
from air.mapping_process import MappingProcess
from common.messages import Datum, Photo
process = MappingProcess(AirConfig(), "flight")
process.take(Photo(1, "a", b"", None, None), Datum("flight", 0.0, 0.0, 0.0))
print(process._process.pid, flush=True)
time.sleep(60)
"""


def test_the_mapper_ends_when_the_odometry_is_killed() -> None:
    command = [sys.executable, "-c", MAPPER]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as odometry:
        assert odometry.stdout is not None
        mapper = int(odometry.stdout.readline())
        time.sleep(1.0)
        assert is_alive(mapper)
        odometry.kill()
    try:
        wait_for(lambda: not is_alive(mapper), 30.0)
    finally:
        if is_alive(mapper):
            os.kill(mapper, signal.SIGKILL)
