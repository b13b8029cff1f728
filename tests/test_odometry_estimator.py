"""The estimator over simulated points: from take-off, in flight, blind, with gaps, rolling rows, and gone astray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from odometry_scene import CAMERA, START_NS, T_BODY_CAM, Scene, aligned_rmse

from air.odometry.estimator import Estimate, Estimator
from air.odometry.initial import KnownSpeed
from air.odometry.row_times import ideal_points
from air.odometry.settings import OdometrySettings
from air.odometry.tracker import TrackedFrame
from air.sources.simulated.imu import ImuOptions
from air.sources.simulated.motion.mission import FlightOptions
from common.arrays import F64
from common.measurements import ImuSample
from common.messages import Mode

AIR, GROUND = FlightOptions(start="air"), FlightOptions(start="ground", stand_s=5.0)
Spoil = Callable[[float, ImuSample | TrackedFrame], ImuSample | TrackedFrame | None]


def nothing_seen(frame: TrackedFrame) -> TrackedFrame:
    none = {name: getattr(frame, name)[:0] for name in ("ids", "uv", "rays", "row_dt_s", "new")}
    return replace(frame, **none, blind=True)


class Flight:
    """What an estimator makes of a scene: its estimates, and the truth at their times."""

    def __init__(self, scene: Scene, spoil: Spoil = lambda t_s, m: m, speed: bool = True) -> None:
        self.scene, self.estimator = scene, Estimator(CAMERA.fx, T_BODY_CAM, OdometrySettings())
        self.estimates: list[Estimate] = []
        self.refusals: list[str] = []
        waiting: list[TrackedFrame] = []
        for message in scene.sensed():
            kept = spoil((message.t_ns - START_NS) * 1e-9, message)
            if isinstance(kept, ImuSample):
                self.estimator.add_imu(kept)
            elif kept is not None:
                waiting.append(kept)
                if speed:
                    true = float(np.linalg.norm(scene.state(kept.t_ns).v_world))
                    self.estimator.add_speed(KnownSpeed(kept.t_ns, true, 0.1))
            while waiting and waiting[0].t_ns <= (self.estimator.buffer.last_ns or 0):
                outcome = self.estimator.add_frame(waiting.pop(0))
                if isinstance(outcome, Estimate):
                    self.estimates.append(outcome)
                else:
                    self.refusals.append(outcome.reason)

    def positions(self, after_s: float = 0.0) -> tuple[F64, F64]:
        kept = [e.state for e in self.estimates if (e.state.t_ns - START_NS) * 1e-9 >= after_s]
        truth = [self.scene.state(state.t_ns).T_world_body.t for state in kept]
        return np.array([state.T_world_body.t for state in kept]), np.array(truth)

    @property
    def modes(self) -> list[Mode]:
        changes: list[Mode] = []
        for estimate in self.estimates:
            if not changes or changes[-1] is not estimate.mode:
                changes.append(estimate.mode)
        return changes

    @property
    def notes(self) -> list[str]:
        return [e.note for e in self.estimates if e.note]


def test_it_begins_on_the_ground_and_follows_the_take_off() -> None:
    flight = Flight(Scene(1, 25.0, GROUND, ImuOptions()))
    assert flight.notes == ["begins at rest"]
    assert flight.estimates[0].state.t_ns < START_NS + 1_300_000_000
    estimate, truth = flight.positions()
    assert truth[-1, 2] > 20.0
    rmse, scale = aligned_rmse(estimate, truth)
    # Where the ground is near, a few of its points alone tell the scale; 3 % is what the map asks for.
    assert rmse < 0.3
    assert scale == pytest.approx(1.0, abs=0.03)


def test_it_begins_in_the_air_within_four_seconds_where_the_speed_is_known() -> None:
    flight = Flight(Scene(1, 12.0, AIR, ImuOptions()))
    assert flight.notes == ["begins in motion"]
    assert flight.estimates[0].state.t_ns < START_NS + 4_000_000_000
    estimate, truth = flight.positions()
    rmse, scale = aligned_rmse(estimate, truth)
    assert rmse < 0.5
    assert scale == pytest.approx(1.0, abs=0.06)  # the speed is known within 0.1 of 3 m/s at first


def test_it_waits_where_nothing_tells_the_scale() -> None:
    flight = Flight(Scene(1, 4.0, AIR, ImuOptions()), speed=False)
    assert not flight.estimates
    assert any("scale" in reason for reason in flight.refusals)


def test_a_blind_camera_leaves_the_imu_and_sight_brings_the_rest_back() -> None:
    def blind(t_s: float, message: ImuSample | TrackedFrame) -> ImuSample | TrackedFrame:
        return nothing_seen(message) if isinstance(message, TrackedFrame) and 7.0 < t_s < 10.0 else message

    flight = Flight(Scene(1, 14.0, AIR, ImuOptions()), blind)
    assert flight.modes == [Mode.VISUAL_INERTIAL, Mode.INERTIAL, Mode.VISUAL_INERTIAL]
    # Velocity known within 0.1 m/s at 7 s, tilt within a few mrad: 3 s of both are about half a metre.
    assert aligned_rmse(*flight.positions())[0] < 1.0
    speed = np.linalg.norm(flight.estimates[-1].state.v_world)
    true = np.linalg.norm(flight.scene.state(flight.estimates[-1].state.t_ns).v_world)
    assert speed == pytest.approx(true, abs=0.5)


def test_a_gap_in_the_imu_and_lost_frames_are_survived() -> None:
    rng = np.random.default_rng(3)

    def spoil(t_s: float, message: ImuSample | TrackedFrame) -> ImuSample | TrackedFrame | None:
        if isinstance(message, ImuSample):
            return None if 6.0 < t_s < 6.2 else message
        return None if rng.random() < 0.2 else message

    flight = Flight(Scene(2, 12.0, AIR, ImuOptions()), spoil)
    assert flight.notes == ["begins in motion"]
    rmse, scale = aligned_rmse(*flight.positions())
    assert rmse < 0.6
    assert scale == pytest.approx(1.0, abs=0.06)


def test_rows_exposed_one_after_the_other_are_moved_to_one_time() -> None:
    scene = Scene(1, 3.0, AIR, ImuOptions(), noise_px=0.0, line_time_s=30e-6)
    frames = [m for m in scene.sensed() if isinstance(m, TrackedFrame)]
    R, moved, unmoved = T_BODY_CAM.R.T, [], []
    for frame in frames[::4]:
        t_s = (frame.t_ns - START_NS) * 1e-9
        motion, T_world_cam = scene.trajectory.at(np.array([t_s])), scene.T_world_cam(t_s)
        omega = motion.omega_body[0]
        v_body = motion.R_world_body[0].T @ motion.v_world[0] + np.cross(omega, T_BODY_CAM.t)
        height = float(T_world_cam.t[2])
        ideal = ideal_points(frame, CAMERA.fx, R @ omega, R @ v_body, {}, height)
        p_cam = T_world_cam.inverse().apply(scene.points)
        there = CAMERA.fx * p_cam[p_cam[:, 2] > 0, :2] / p_cam[p_cam[:, 2] > 0, 2:]
        raw = CAMERA.fx * frame.rays[:, :2] / frame.rays[:, 2:]
        for xy, before in zip(ideal.xy, raw[np.argsort(frame.ids)], strict=True):
            moved.append(np.linalg.norm(there - xy, axis=1).min())
            unmoved.append(np.linalg.norm(there - before, axis=1).min())
    # The body trembles within the 22 ms of a frame, and the ground is not flat: a tenth of a pixel.
    assert np.median(moved) < 0.1
    assert np.median(moved) < 0.3 * np.median(unmoved)


def test_an_estimate_gone_astray_starts_its_window_anew_and_keeps_its_place() -> None:
    flight = Flight(Scene(1, 8.0, AIR, ImuOptions()))
    estimator = flight.estimator
    window = estimator.window
    assert window is not None
    before = window.state()
    frame = nothing_seen(
        TrackedFrame(before.t_ns, *[np.zeros((0, n)) for n in (1, 2, 3)], np.zeros(0), np.zeros(0), True)
    )
    repaired = estimator._repair(window, replace(frame, t_ns=before.t_ns + 100_000_000), before, "a test says so")
    assert isinstance(repaired, Estimate)
    assert "a test says so" in repaired.note
    assert np.linalg.norm(repaired.state.T_world_body.t - before.T_world_body.t) < 1e-6
    again = estimator._repair(window, replace(frame, t_ns=before.t_ns + 200_000_000), before, "it happens again")
    assert not isinstance(again, Estimate)
    assert estimator.window is None


def test_the_imu_alone_is_believed_for_a_while_only() -> None:
    scene = Scene(1, 11.0, AIR, ImuOptions())
    flight = Flight(scene, lambda t_s, m: None if isinstance(m, TrackedFrame) and t_s > 5.0 else m)
    assert flight.estimates
    assert flight.estimator.window is None
    assert flight.estimator.revision == 1


def test_the_same_flight_gives_the_same_bits() -> None:
    runs = [Flight(Scene(2, 7.0, AIR, ImuOptions())).positions()[0] for _ in range(2)]
    assert len(runs[0])
    assert runs[0].tobytes() == runs[1].tobytes()
