"""Photos out of a video flight."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from air.jump import Jump
from air.sensors.calibration import Calibration
from air.sources.source import Sensed, open_photos
from air.sources.stills import STEP, StillPicker
from common.camera import CameraModel
from common.geo import enu_to_geodetic, geodetic_to_enu
from common.measurements import CameraFrame, Encoding, FixKind, ReceiverSolution, VehicleState
from common.messages import Datum, Mode, Photo, Pose
from common.se3 import SE3

HOME = Datum("", 30.5, 114.3, 20.0)
CAMERA = CameraModel(128, 72, 64.0, 64.0, 63.5, 35.5)
MOUNTED = {"down": Calibration(CAMERA, SE3(np.diag([1.0, -1.0, -1.0]), np.zeros(3)))}
SPEED, HEIGHT = 3.0, 40.0
SECOND_NS = 1_000_000_000


def solution(t_s: float, height: float = HEIGHT, kind: FixKind = FixKind.FIX_3D) -> ReceiverSolution:
    where = enu_to_geodetic(HOME, np.array([SPEED * t_s, 0.0, height]))
    velocity = np.array([SPEED, 0.0, 0.0])
    return ReceiverSolution(round(t_s * 1e9), "gnss", kind, *map(float, where), 1.5, 3.0, velocity, 0.1, 1e-8, 20)


def frame(t_s: float, encoding: Encoding = Encoding.BGR8, camera: str = "down") -> CameraFrame:
    image = np.full((72, 128, 3), 90, np.uint8)
    data = cv2.imencode(".jpg", image)[1].tobytes() if encoding is Encoding.JPEG else image.tobytes()
    return CameraFrame(round(t_s * 1e9), camera, round(t_s * 10), 128, 72, encoding, data)


def flight(seconds: int, height: float = HEIGHT) -> Iterator[Sensed]:
    """From the ground at the start; frames at 10 Hz, positions once a second, a tenth of a second before the frame."""
    yield solution(-1.0, height=0.0)
    for i in range(10 * seconds):
        if i % 10 == 0:
            yield solution(i / 10 - 0.1, height)
        yield frame(i / 10)


def photos(measurements: Iterator[Sensed], calibrations: dict[str, Calibration] | None = None) -> list[Photo]:
    picker = StillPicker(MOUNTED if calibrations is None else calibrations)
    return [photo for m in measurements if (photo := picker.feed(m)) is not None]


def test_photos_are_as_far_apart_as_the_ground_below_asks_for() -> None:
    taken = photos(flight(60))
    east = np.array([geodetic_to_enu(HOME, p.fix.latitude_deg, p.fix.longitude_deg, p.fix.height)[0] for p in taken])
    step = STEP * HEIGHT * 72 / 64
    assert len(taken) == pytest.approx(60 * SPEED / step, abs=2)
    assert (np.diff(east) >= step - 1e-6).all()
    assert (np.diff(east) < step + 0.1 * SPEED + 1e-6).all()


def test_a_photo_has_the_position_of_its_moment() -> None:
    """The receiver's position, up to a second old, is carried on by its velocity."""
    for photo in photos(flight(30)):
        p = geodetic_to_enu(HOME, photo.fix.latitude_deg, photo.fix.longitude_deg, photo.fix.height)
        assert_allclose(p, [SPEED * photo.t_ns * 1e-9, 0.0, HEIGHT], atol=0.01)
        assert 1.5 <= photo.fix.sigma_horizontal < 1.7
        assert cv2.imdecode(np.frombuffer(photo.jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (72, 128, 3)
        assert photo.camera == CAMERA


def test_near_the_ground_no_photo_is_taken() -> None:
    assert photos(flight(20, height=5.0)) == []


def test_the_height_that_telemetry_tells_counts_for_a_flight_that_begins_in_the_air() -> None:
    def airborne() -> Iterator[Sensed]:
        yield from (m for m in flight(10) if m.t_ns >= 0)

    assert photos(airborne()) == []
    picker = StillPicker(MOUNTED)
    picker.feed(VehicleState(0, 1, height_home=HEIGHT))
    assert any(picker.feed(m) is not None for m in airborne())


def test_the_attitude_of_the_airframe_and_the_mounting_tell_that_of_the_camera() -> None:
    picker = StillPicker(MOUNTED)
    picker.feed(VehicleState(0, 1, q_enu_body=np.array([0.0, 0.0, 0.0, 1.0]), height_home=HEIGHT))
    (photo, *_) = [p for m in flight(10) if (p := picker.feed(m)) is not None]
    assert photo.R_enu_cam is not None
    assert_allclose(photo.R_enu_cam @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    assert photo.attitude_sigma > 0


@pytest.mark.parametrize("kind", [FixKind.NONE, FixKind.FIX_3D])
def test_without_a_position_of_now_no_photo_is_taken(kind: FixKind) -> None:
    picker = StillPicker(MOUNTED)
    picker.feed(VehicleState(0, 1, height_home=HEIGHT))
    picker.feed(solution(0.0, kind=kind))
    assert picker.feed(frame(5.0)) is None


def test_frames_of_a_second_camera_and_of_video_streams_are_left_alone() -> None:
    picker = StillPicker({})
    picker.feed(VehicleState(0, 1, height_home=HEIGHT))
    picker.feed(solution(0.0))
    first = picker.feed(frame(0.1, Encoding.JPEG))
    assert first is not None
    assert first.camera is None
    assert first.jpeg == frame(0.1, Encoding.JPEG).data
    picker.feed(solution(20.0))
    assert picker.feed(frame(20.1, camera="front")) is None
    assert picker.feed(CameraFrame(20 * SECOND_NS, "down", 9, 128, 72, Encoding.H264, b"\0\0\0\1")) is None
    assert picker.feed(frame(20.1)) is not None


def pose(t_s: float, error: float = 0.0, revision: int = 1) -> Pose:
    """The odometry's, which knows better than the receiver by how much that is off."""
    T_world_body = SE3(np.eye(3), np.array([SPEED * t_s + error, 0.0, HEIGHT]))
    return Pose(
        "", round(t_s * 1e9), revision, T_world_body, None, np.array([0.3, 0.4, 0.7]), Mode.GNSS_VISUAL_INERTIAL
    )


def test_once_the_odometry_knows_its_world_photos_are_where_it_says_until_it_falls_silent() -> None:
    """Poses come 20 ms apart, from 10 s to 30 s, 5 m east of where the receiver believes to be."""

    def navigated() -> Iterator[Sensed | Datum | Pose]:
        for m in flight(60):
            if m.t_ns == 10 * SECOND_NS:
                yield HOME
            yield m
            if isinstance(m, CameraFrame) and 10 * SECOND_NS <= m.t_ns < 30 * SECOND_NS:
                yield from (pose(m.t_ns * 1e-9 + k * 0.02 + 0.007, 5.0) for k in range(5))

    picker = StillPicker(MOUNTED)
    taken = [photo for m in navigated() if (photo := picker.feed(m)) is not None]
    for photo in taken:
        p = geodetic_to_enu(HOME, photo.fix.latitude_deg, photo.fix.longitude_deg, photo.fix.height)
        off = p - [SPEED * photo.t_ns * 1e-9, 0.0, HEIGHT]
        if 10.2 < photo.t_ns * 1e-9 < 29.9:
            assert_allclose(off, [5.0, 0.0, 0.0], atol=1e-3)
            assert_allclose([photo.fix.sigma_horizontal, photo.fix.sigma_vertical], [np.sqrt(0.125), 0.7])
            assert_allclose(photo.R_enu_cam, np.diag([1.0, -1.0, -1.0]), atol=1e-4)
        elif not 9.9 < photo.t_ns * 1e-9 < 30.4:
            assert_allclose(off, 0.0, atol=0.01)
            assert photo.R_enu_cam is None
    assert sum(10.2 < photo.t_ns * 1e-9 < 29.9 for photo in taken) >= 6
    assert sum(photo.t_ns > 31 * SECOND_NS for photo in taken) >= 8


@pytest.mark.parametrize("known", [True, False])
def test_a_frame_at_a_jump_of_the_world_is_where_the_new_world_says(known: bool) -> None:
    """The poses of before a jump serve with those after it, moved along, or not at all."""
    picker = StillPicker(MOUNTED)
    for m in (VehicleState(0, 1, height_home=HEIGHT), HOME, pose(0.0), pose(1.0)):
        picker.feed(m)
    assert picker.feed(frame(1.01)) is None  # waits for the poses to pass it
    if known:
        picker.feed(Jump(SECOND_NS, 2, HOME, SE3(np.eye(3), np.array([5.0, 0.0, 0.0]))))
    photo = picker.feed(pose(1.02, error=5.0, revision=2))
    assert photo is not None
    assert photo.revision == 2
    p = geodetic_to_enu(HOME, photo.fix.latitude_deg, photo.fix.longitude_deg, photo.fix.height)
    assert_allclose(p, [SPEED * 1.01 + 5.0, 0.0, HEIGHT], atol=1e-3 if known else SPEED * 0.01 + 1e-3)


@pytest.mark.slow
def test_a_simulated_flight_gives_photos_of_its_site() -> None:
    taken = list(open_photos("sim:playground?seed=2&duration=12&flight.start=air&camera.rate_hz=5&base=off"))
    assert len(taken) >= 2
    image = cv2.imdecode(np.frombuffer(taken[0].jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (720, 1280, 3)
    assert image.std() > 10
    assert taken[0].R_enu_cam is not None
    assert taken[0].R_enu_cam[2, 2] < -0.9
