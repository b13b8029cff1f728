"""GNSS and IMU without a camera: on a simulated flight against its truth, and on real recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from gnss_flight import DATUM, START_NS, GnssFlight, errors, estimates, flight

from air.gnss.gnss_time import SECOND_NS, to_week
from air.gnss.positioning import PointPosition
from air.gnss.settings import PositioningSettings
from air.odometry.estimator import Estimate, Estimator, blind_frame
from air.odometry.gnss_attitude import InitialAttitude, MeasuredVelocity, find_attitude
from air.odometry.gnss_settings import GnssNoise, GnssSelection, GnssSettings
from air.odometry.gnss_window import _age
from air.odometry.preintegration import ImuBuffer
from air.odometry.settings import ImuSettings, OdometrySettings
from air.positions import find_positions
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.source import open_source
from common.arrays import F64
from common.geo import T_ecef_enu, T_world_other, ecef_to_geodetic
from common.gravity import normal_gravity
from common.measurements import GnssEpoch, ImuSample
from common.messages import Datum, Mode

IMU = replace(ImuSettings(), gravity=normal_gravity(DATUM.latitude_deg, DATUM.height))


@pytest.fixture(scope="module")
def flown() -> GnssFlight:
    """Fifty seconds that begin in the air, with a turn and all errors on."""
    return flight(2, 50.0, FlightOptions(start="air"))


def estimate(
    flown: GnssFlight, carrier: bool = True, messages: list[object] | None = None
) -> tuple[list[Estimate], Datum]:
    """Estimates, and the datum of their world."""
    gnss = GnssSettings(p_body_antenna=flown.p_body_antenna, selection=GnssSelection(carrier=carrier))
    estimator = Estimator(settings=OdometrySettings(gnss=gnss))
    found = estimates(estimator, messages or flown.messages)
    assert estimator.gnss.datum is not None
    return found, estimator.gnss.datum


@pytest.mark.parametrize("carrier", [False, True])
def test_poses_follow_the_truth_within_their_sigma(flown: GnssFlight, carrier: bool) -> None:
    poses, datum = estimate(flown, carrier)
    assert len(poses) > 20
    assert {pose.mode for pose in poses[3:]} == {Mode.GNSS_INERTIAL}
    off, squares = errors(flown, poses, datum)
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 4.0  # pseudoranges of 1.5 m class place it
    assert np.median(squares) < 14.2  # χ² of three, once in 370
    for pose in poses[len(poses) // 2 :: 5]:
        _, v_world, R_world_body = flown.truth(pose.state.t_ns)
        T = T_world_other(DATUM, datum)
        assert pose.state.v_world @ T.R.T == pytest.approx(v_world, abs=0.1)
        turn = gtsam.Rot3.Logmap(gtsam.Rot3(R_world_body.T @ T.R @ pose.state.T_world_body.R))
        assert np.degrees(np.linalg.norm(turn)) < 2.0


def test_a_camera_that_shows_nothing_does_not_keep_it_from_beginning(flown: GnssFlight) -> None:
    times_ns = [m.t_ns for m in flown.messages if isinstance(m, ImuSample)]
    frames = [(t_ns, blind_frame(t_ns)) for t_ns in times_ns[::20]]
    stamped = [(m.t_ns, m) for m in flown.messages if isinstance(m, ImuSample | GnssEpoch)]
    others = [m for m in flown.messages if not isinstance(m, ImuSample | GnssEpoch)]
    messages = [*others, *(m for _, m in sorted([*stamped, *frames], key=lambda item: item[0]))]
    (poses, datum), (usual, _) = estimate(flown, messages=messages), estimate(flown)
    assert poses[0].state.t_ns - usual[0].state.t_ns < 3 * SECOND_NS
    assert len(poses) > 5 * len(usual)  # one at each frame
    off, _ = errors(flown, poses, datum)
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 4.0


def test_carriers_begin_anew_one_after_the_other(flown: GnssFlight) -> None:
    arcs = [f"{system}{number:02d}/7" for system in "GREC" for number in range(1, 33)]
    ages = np.array([[_age(arc, t * SECOND_NS) for arc in arcs] for t in range(0, 1300, 5)])
    renewed = np.diff(ages, axis=0)
    assert set(renewed.ravel().tolist()) == {0, 1}
    assert renewed.sum(axis=1).max() <= 8
    assert (ages[-1] - ages[0] >= 2).all()


def test_the_same_measurements_give_the_same_poses(flown: GnssFlight) -> None:
    some = [m for m in flown.messages if getattr(m, "t_ns", 0) < START_NS + 32 * SECOND_NS]
    first, again = (estimate(flown, True, some)[0] for _ in range(2))
    assert [pose.state.T_world_body.t.tobytes() for pose in first] == [
        pose.state.T_world_body.t.tobytes() for pose in again
    ]


def test_an_outage_of_gnss_is_bridged_by_the_imu(flown: GnssFlight) -> None:
    gap = range(START_NS + 40 * SECOND_NS, START_NS + 43 * SECOND_NS)
    heard = [m for m in flown.messages if not (isinstance(m, GnssEpoch) and m.t_ns in gap)]
    poses, datum = estimate(flown, True, heard)
    off, _ = errors(flown, poses, datum)
    before = [pose.state.t_ns < gap.start for pose in poses].count(True)
    assert np.linalg.norm(off[before:] - off[before - 1], axis=1).max() < 0.5


def felt(R_world_body: F64, bias: F64, seconds: float = 10.0) -> tuple[ImuBuffer, list[MeasuredVelocity]]:
    """A body that keeps its attitude and speeds up, first east and then north; a sample's mean is its value."""
    buffer, velocities, v = ImuBuffer(IMU), [], np.zeros(3)
    for k in range(round(seconds * 100) + 1):
        t = k * 0.01
        a = np.array([1.0, 0.0, 0.0]) if t < seconds / 2 else np.array([0.0, 1.5, 0.2])
        buffer.add(ImuSample(round(t * 1e9), R_world_body.T @ (a + [0, 0, IMU.gravity]), bias))
        if k % 50 == 0:
            velocities.append(MeasuredVelocity(round(t * 1e9), v.copy(), np.full(3, 0.05)))
        v = v + 0.01 * a
    return buffer, velocities


@pytest.mark.parametrize("yaw_deg", [-170, -60, 5, 120])
def test_attitude_is_found_in_motion_from_any_heading(yaw_deg: float) -> None:
    R = gtsam.Rot3.Ypr(np.radians(yaw_deg), 0.1, -0.15).matrix()
    bias = np.array([0.01, -0.008, 0.005])
    found = find_attitude(*felt(R, bias), IMU)
    assert isinstance(found, InitialAttitude)
    off = gtsam.Rot3.Logmap(gtsam.Rot3(R.T @ found.state.T_world_body.R))
    assert np.linalg.norm(off) < np.radians(1.0)
    assert found.state.gyro_bias == pytest.approx(bias, abs=1e-3)


def test_attitude_is_refused_without_acceleration() -> None:
    buffer, velocities = felt(np.eye(3), np.zeros(3))
    still = ImuBuffer(IMU)
    for k in range(1001):
        still.add(ImuSample(k * 10_000_000, np.array([0, 0, IMU.gravity]), np.zeros(3)))
    constant = [replace(velocity, v_world=np.array([3.0, 0.0, 0.0])) for velocity in velocities]
    assert isinstance(find_attitude(still, constant, IMU), str)
    assert find_attitude(buffer, velocities[:3], IMU) == "too few velocities"


class Reference:
    """Places and velocities of a segment of comma2k19, in ECEF, by the phone's clock."""

    def __init__(self, folder: Path) -> None:
        self.t_s = np.load(folder / "frame_gps_times")[:, 1]
        self.places, self.velocities = np.load(folder / "frame_positions"), np.load(folder / "frame_velocities")
        self.R_ecef_enu = T_ecef_enu(Datum("car", *ecef_to_geodetic(self.places[0]).tolist())).R

    def at(self, values: F64, t_s: F64) -> F64:
        return np.stack([np.interp(t_s, self.t_s, column) for column in values.T], axis=1)

    def late_s(self, singles: list[PointPosition]) -> float:
        """How far the phone's clock is ahead of the receiver's, within 0.01 s."""
        t_s = np.array([to_week(one.t_ns)[1] - one.clocks["G"] for one in singles])
        measured = np.array([one.velocity for one in singles])
        shifts = np.arange(-0.3, 0.3, 0.01)
        return float(
            min(shifts, key=lambda s: np.std((measured - self.at(self.velocities, t_s + s)) @ self.R_ecef_enu[:, :2]))
        )

    def horizontal(self, t_ns: list[int], p_ecef: list[F64]) -> F64:
        """Distances (N,) m from the reference, which is asked at times of the phone's clock."""
        t_s = np.array([to_week(t)[1] for t in t_ns])
        return np.asarray(
            np.linalg.norm((np.array(p_ecef) - self.at(self.places, t_s)) @ self.R_ecef_enu[:, :2], axis=1)
        )


def rms(values: F64) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_a_car_on_a_motorway_is_followed(real_data: Callable[[str], Path]) -> None:
    """comma2k19: the phone's clock, by which IMU and reference are stamped, is some 0.1 s ahead of the receiver's.

    By how much, the velocities of single points tell; the positions then differ by what measurements lack, the
    satellites' group delays most of all.
    """
    folder = real_data("comma2k19") / "segment"
    items = list(open_source(f"comma2k19:{folder}"))
    reference = Reference(folder / "global_pose")
    singles = [one for _, one in find_positions(items, PositioningSettings()) if isinstance(one, PointPosition)]
    singles = [one for one in singles if np.isfinite(one.velocity).all()]
    late_s = reference.late_s(singles)
    assert 0.08 < late_s < 0.16
    items = [
        replace(item, t_ns=item.t_ns - round(late_s * SECOND_NS)) if isinstance(item, ImuSample) else item
        for item in items
    ]
    items.sort(key=lambda item: item.t_ns if isinstance(item, ImuSample | GnssEpoch) else 0)
    imu = ImuSettings(accel_noise=0.05, gyro_noise=0.002, accel_bias_sigma=0.3, gyro_bias_sigma=0.1)
    gnss = GnssSettings(noise=GnssNoise(rate=0.15, multipath=1.5))
    estimator = Estimator(settings=OdometrySettings(imu=imu, gnss=gnss))
    poses = estimates(estimator, items)
    assert len(poses) > 40
    assert estimator.gnss.datum is not None
    T_ecef_world = T_ecef_enu(estimator.gnss.datum)
    off = reference.horizontal(
        [pose.state.t_ns + round(late_s * SECOND_NS) for pose in poses],
        [T_ecef_world.apply(pose.state.T_world_body.t) for pose in poses],
    )
    singles = [one for one in singles if one.t_ns >= poses[0].state.t_ns]
    single = reference.horizontal(
        [one.t_ns + round((late_s - one.clocks["G"]) * SECOND_NS) for one in singles], [one.position for one in singles]
    )
    assert rms(off) < 0.7 * rms(single)
    assert off.max() < 5.0
    speed = [np.linalg.norm(pose.state.v_world) for pose in poses]
    assert 5.0 < min(speed) < max(speed) < 30.0
    assert poses[-1].covariance[3:6, 3:6].trace() < 8.0**2  # nobody tells the group delays: up to 5 m each
