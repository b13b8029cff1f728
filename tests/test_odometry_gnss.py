"""Camera, IMU and raw GNSS in one window: the world is found and kept, whatever fails for a while."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from gnss_flight import BASE_ECEF, DATUM, START_NS, GnssFlight, estimates, flight, with_frames
from odometry_scene import CAMERA, T_BODY_CAM, Scene

from air.gnss.gnss_time import SECOND_NS
from air.odometry.estimator import Estimate, Estimator, blind_frame
from air.odometry.gnss_settings import GnssSettings
from air.odometry.mounting import LENS, MountingSettings
from air.odometry.settings import OdometrySettings
from air.odometry.tracker import TrackedFrame
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.imu import ImuOptions
from air.sources.simulated.motion.mission import FlightOptions
from common.arrays import F64
from common.geo import T_world_other
from common.measurements import GnssEpoch, ImuSample
from common.messages import Mode
from ground.evaluation.similarity import umeyama

SEED, SECONDS = 2, 36.0
IN_THE_AIR = FlightOptions(start="air")
Change = Callable[[float, object], object | None]
"""What becomes of a measurement at a time (s), None if it is lost."""


@pytest.fixture(scope="module")
def flown() -> tuple[GnssFlight, list[object]]:
    """A flight that begins in the air, all errors on, and its measurements."""
    truth = flight(SEED, SECONDS, IN_THE_AIR)
    return truth, with_frames(truth, Scene(SEED, SECONDS, IN_THE_AIR, ImuOptions()))


class Outcome:
    """Estimates in the world, and where they are off."""

    def __init__(
        self,
        flown: tuple[GnssFlight, list[object]],
        change: Change = lambda _, m: m,
        base: F64 | None = None,
        focal: float = CAMERA.fx,
        mounting: MountingSettings | None = None,
    ) -> None:
        truth, messages = flown
        gnss = GnssSettings(p_body_antenna=truth.p_body_antenna)
        settings = OdometrySettings(gnss=gnss, mounting=mounting or MountingSettings())
        self.estimator = Estimator(focal, T_BODY_CAM, settings, base=base)
        changed = (change((getattr(m, "t_ns", START_NS) - START_NS) / SECOND_NS, m) for m in messages)
        told = estimates(self.estimator, (m for m in changed if m is not None))
        self.first_s = self.at_s(told[0])
        begun = next(i for i, one in enumerate(told) if one.note == "the world has been found by GNSS")
        self.estimates = told[begun:]
        self.t_s = np.array([self.at_s(one) for one in self.estimates])
        assert self.estimator.gnss.datum is not None
        T = T_world_other(DATUM, self.estimator.gnss.datum)
        p = np.array([T.apply(one.state.T_world_body.t) for one in self.estimates])
        true = np.array([truth.truth(one.state.t_ns)[0] for one in self.estimates])
        self.off: F64 = p - true
        self.left: F64 = umeyama(p, true, with_scale=False).apply(p) - true
        R = [(T @ one.state.T_world_body).R @ truth.truth(one.state.t_ns)[2].T for one in self.estimates]
        self.yaw_deg = np.degrees([np.arctan2(turn[1, 0], turn[0, 0]) for turn in R])

    @staticmethod
    def at_s(one: Estimate) -> float:
        return (one.state.t_ns - START_NS) / SECOND_NS

    def modes(self, begin_s: float, end_s: float) -> set[Mode]:
        return {one.mode for one, t in zip(self.estimates, self.t_s, strict=True) if begin_s <= t < end_s}


@pytest.fixture(scope="module")
def undisturbed(flown: tuple[GnssFlight, list[object]]) -> Outcome:
    """The flight as it is."""
    return Outcome(flown)


def test_the_world_is_found_soon_and_kept(undisturbed: Outcome) -> None:
    found = undisturbed
    assert found.t_s[0] - found.first_s < 4.0
    assert abs(found.yaw_deg[0]) < 0.5
    assert np.abs(found.yaw_deg[20:]).max() < 0.3
    assert np.linalg.norm(found.left, axis=1).max() < 0.15
    assert found.modes(found.t_s[0], SECONDS) == {Mode.GNSS_VISUAL_INERTIAL}
    newest = found.estimates[-1]
    assert found.off[-1] @ found.off[-1] < 11.3 * np.trace(newest.covariance[3:, 3:])  # χ² of three, once in 100
    assert found.estimator.revision == 1


def test_an_outage_of_gnss_leaves_the_camera(flown: tuple[GnssFlight, list[object]]) -> None:
    out = Outcome(flown, lambda t, m: None if isinstance(m, GnssEpoch) and 14 <= t < 28 else m)
    assert Mode.VISUAL_INERTIAL in out.modes(16.0, 28.0)
    assert out.modes(16.5, 28.0) == {Mode.VISUAL_INERTIAL}
    assert out.modes(31.0, SECONDS) == {Mode.GNSS_VISUAL_INERTIAL}
    steps = np.linalg.norm(np.diff(out.off, axis=0), axis=1)
    assert steps[out.t_s[1:] > 14].max() < 0.3
    assert np.linalg.norm(out.left, axis=1).max() < 0.3


def test_a_blind_camera_leaves_gnss(flown: tuple[GnssFlight, list[object]]) -> None:
    def blind(t: float, m: object) -> object:
        return blind_frame(m.t_ns) if isinstance(m, TrackedFrame) and 15 <= t < 20 else m

    out = Outcome(flown, blind)
    assert Mode.GNSS_INERTIAL in out.modes(16.5, 20.0)
    assert out.modes(23.0, SECONDS) == {Mode.GNSS_VISUAL_INERTIAL}
    assert np.linalg.norm(out.left, axis=1).max() < 0.3


def test_a_gap_of_everything_is_survived(flown: tuple[GnssFlight, list[object]]) -> None:
    """Two seconds without a stamp, as after a step of the clock, and frames of which every fifth is lost besides."""

    def lost(t: float, m: object) -> object | None:
        if isinstance(m, ImuSample | TrackedFrame) and 18 <= t < 20:
            return None
        return None if isinstance(m, TrackedFrame) and round(t * 10) % 5 == 0 else m

    out = Outcome(flown, lost)
    assert out.estimator.window is not None
    assert out.modes(25.0, SECONDS) == {Mode.GNSS_VISUAL_INERTIAL}
    late = out.t_s > 22.0
    assert np.linalg.norm(out.off[late] - out.off[late].mean(axis=0), axis=1).max() < 0.3


def test_wrong_satellites_do_not_move_the_aircraft(
    flown: tuple[GnssFlight, list[object]], undisturbed: Outcome
) -> None:
    """Two satellites are 50 m late from the middle of the flight on, and their carriers and Dopplers drift."""

    def late(t: float, m: object) -> object:
        if not isinstance(m, GnssEpoch) or t < 18.0:
            return m
        wrong = np.isin(m.satellites, sorted(set(m.satellites))[:2])
        return replace(
            m,
            pseudorange=m.pseudorange + 50.0 * wrong,
            carrier_phase=m.carrier_phase + 5.0 * (t - 18.0) * wrong,
            doppler=m.doppler - 5.0 * wrong,
        )

    found = Outcome(flown, late)
    rmse = [float(np.sqrt(np.mean(np.sum(one.left**2, axis=1)))) for one in (found, undisturbed)]
    assert rmse[0] < 1.5 * rmse[1] + 0.02


def test_a_lens_that_is_not_as_calibrated_is_learnt(flown: tuple[GnssFlight, list[object]]) -> None:
    """Two or three pixels, where the calibration claims two."""
    wrong = np.array([2.0, -3.0, 2.0])
    calibrated = replace(CAMERA, fx=CAMERA.fx - wrong[0], fy=CAMERA.fy - wrong[0])
    calibrated = replace(calibrated, cx=CAMERA.cx - wrong[1], cy=CAMERA.cy - wrong[2])

    def seen(_: float, m: object) -> object:
        if not isinstance(m, TrackedFrame) or not len(m.uv):
            return m
        rays = calibrated.rays(m.uv)
        return replace(m, rays=rays / np.linalg.norm(rays, axis=1, keepdims=True))

    out = Outcome(flown, seen, None, calibrated.fx, MountingSettings(focal_px=2.0, centre_px=2.0))
    mounted = out.estimator.mounted
    sigma = np.sqrt(np.diag(mounted.covariance)[LENS])
    assert mounted.learnt[LENS][1:].all()
    assert (np.abs(mounted.u[LENS] - wrong)[1:] < 0.5 * np.abs(wrong[1:])).all()
    assert (np.abs(mounted.u[LENS] - wrong)[mounted.learnt[LENS]] < 4.0 * sigma[mounted.learnt[LENS]]).all()
    assert np.linalg.norm(out.left, axis=1).max() < 0.15


def test_a_base_station_places_the_aircraft_to_centimetres() -> None:
    truth = flight(SEED, 22.0, IN_THE_AIR, base=GnssOptions.base())
    messages = with_frames(truth, Scene(SEED, 22.0, IN_THE_AIR, ImuOptions()))
    out = Outcome((truth, messages), base=BASE_ECEF)
    late = out.t_s > out.t_s[0] + 5.0
    assert late.sum() > 20
    assert np.linalg.norm(out.off[late], axis=1).max() < 0.08


def test_a_base_station_that_begins_in_flight_moves_the_world_in_told_jumps() -> None:
    """So whoever keeps places, as the map does, can move them along."""
    truth = flight(SEED, 30.0, IN_THE_AIR, base=GnssOptions.base())
    messages = with_frames(truth, Scene(SEED, 30.0, IN_THE_AIR, ImuOptions()))

    def silent(t: float, m: object) -> object | None:
        return None if isinstance(m, GnssEpoch) and m.receiver == "base" and t < 18.0 else m

    out = Outcome((truth, messages), silent, base=BASE_ECEF)
    before, after = out.off[out.t_s < 17.9][-1], out.off[out.t_s > 24.0]
    assert np.linalg.norm(before) > 0.3
    assert np.linalg.norm(after, axis=1).max() < 0.08
    jumps = [one for one in out.estimates if one.jump is not None]
    assert 1 <= len(jumps) <= 4
    assert out.estimator.revision == 1 + len(jumps)
    steps = np.diff(out.off, axis=0)
    for step, one in zip(steps, out.estimates[1:], strict=True):
        if one.jump is not None:
            p = one.state.T_world_body.t
            step = step - (p - one.jump.inverse().apply(p))
        assert np.linalg.norm(step) < 0.15
