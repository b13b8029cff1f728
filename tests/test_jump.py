"""When the odometry's world jumps, what was placed in it moves along: photos, keyframes, tiles, the ground's map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pymap3d
import pytest
from numpy.testing import assert_allclose

from air.alignment.prepare import PreparedPhoto, prepare
from air.alignment.settings import AlignmentSettings
from air.config import AirConfig
from air.jump import Jump
from air.live import LiveMap
from air.mapping.settings import MappingSettings
from air.mapping_process import WAITING, MappingProcess, Taken
from air.navigation import Navigator
from air.odometry.settings import OdometrySettings
from air.preparation import prepared
from air.sources.known import known_of
from air.sources.simulated.survey import Survey, SurveyOptions
from air.sources.source import open_source
from common.arrays import F64
from common.geo import T_world_other
from common.messages import Datum, GnssFix, MapTile, Photo, Pose
from common.se3 import SE3, rotation_vector_to_matrix
from common.wire import encode
from ground.cloud import Cloud

DATUM = Datum("flight", 47.0, 8.0, 500.0)
T_NEW_OLD = SE3(rotation_vector_to_matrix(np.array([0.0, 0.0, np.radians(1.5)])), np.array([0.6, -0.9, 0.8]))
"""A turn and a shift as of a world that code alone had placed."""
PHOTOS, BEFORE = 7, 5


def jump(T_new_old: SE3 = T_NEW_OLD, datum: Datum = DATUM, revision: int = 4) -> Jump:
    return Jump(10**9, revision, datum, T_new_old)


def photo(revision: int | None = 3, R_enu_cam: F64 | None = None) -> Photo:
    return Photo(1, "a", b"", None, GnssFix(47.001, 8.002, 540.0, 0.3, 0.5), R_enu_cam, 0.01, revision)


def test_a_photo_moves_with_the_world_that_it_was_placed_in() -> None:
    R_enu_cam = rotation_vector_to_matrix(np.array([3.0, 0.2, -0.1]))
    moved = jump().moved(photo(3, R_enu_cam))
    enu = [
        pymap3d.geodetic2enu(p.fix.latitude_deg, p.fix.longitude_deg, p.fix.height, 47.0, 8.0, 500.0)
        for p in (photo(), moved)
        if p.fix is not None
    ]
    assert_allclose(enu[1], T_NEW_OLD.apply(np.array(enu[0])), atol=1e-6)
    assert moved.R_enu_cam is not None
    # The verticals of two places a metre apart differ by 2e-7 rad.
    assert_allclose(moved.R_enu_cam, T_NEW_OLD.R @ R_enu_cam, atol=1e-6)
    assert moved.revision == 4


@pytest.mark.parametrize("revision", [None, 0, 2, 4, 5])
def test_a_photo_that_stands_in_another_world_stays(revision: int | None) -> None:
    there = photo(revision)
    assert jump().moved(there) is there


def test_a_jump_is_the_same_at_any_datum() -> None:
    elsewhere = Datum("", 47.003, 8.004, 480.0)
    T = T_world_other(elsewhere, DATUM)
    p = np.array([30.0, -20.0, 40.0])
    assert_allclose(jump().at(elsewhere).apply(T.apply(p)), T.apply(T_NEW_OLD.apply(p)), atol=1e-8)


def test_jumps_keep_their_place_between_photos() -> None:
    items = list(prepared([photo(), jump(), photo()], AlignmentSettings()))
    assert [isinstance(item, Jump) for item in items] == [False, True, False]


def test_a_mapper_that_is_behind_gets_every_jump() -> None:
    process = MappingProcess(AirConfig(), "flight")
    process.take(jump(), DATUM)  # nothing was mapped yet
    process._process = SimpleNamespace(pid=1)  # type: ignore[assignment]
    for _ in range(WAITING + 3):
        process.take(photo(), DATUM)
    process.take(jump(), DATUM)
    process._photos.put(None)
    taken = list(Taken(process._photos, lambda: None))
    assert len(taken) == WAITING + 1
    assert isinstance(taken[-1], Jump)
    process._photos.cancel_join_thread()


@pytest.mark.slow
def test_a_jump_is_told_between_the_poses_of_the_old_world_and_those_of_the_new() -> None:
    """With a base station carriers become whole cycles soon after the world was found by code, and move it."""
    source = open_source("sim:plain?duration=40&flight.start=air&seed=3")
    navigator = Navigator(known_of(source), "flight", OdometrySettings())
    told = [message for measurement in source for message in navigator.feed(measurement)]
    jumps = [k for k, message in enumerate(told) if isinstance(message, Jump)]
    assert jumps
    assert navigator.datum is not None
    for k in jumps:
        found = told[k]
        assert isinstance(found, Jump)
        before = next(m for m in reversed(told[:k]) if isinstance(m, Pose))
        after = next(m for m in told[k:] if isinstance(m, Pose))
        assert (before.revision, after.revision) == (found.revision - 1, found.revision)
        p = before.T_world_body.t
        assert 0.1 < np.linalg.norm(found.at(navigator.datum).apply(p) - p) < 5.0


# The map


class Flight:
    """A simulated survey whose first photos were placed in a world that jumps after them."""

    def __init__(self) -> None:
        survey = Survey("", SurveyOptions(seed=4, photos=PHOTOS, gps_noise=0.02, focal_error=0.0))
        self.truth = survey.truth
        T, datum = T_NEW_OLD.inverse(), survey.truth.datum
        false = jump(T, datum, revision=0)
        self.photos: list[PreparedPhoto] = []
        for k, taken in enumerate(survey):
            R_enu_cam = self.truth.T_world_cam[k].R
            fix = replace(taken.fix, sigma_horizontal=0.02, sigma_vertical=0.02)
            known = {"fix": fix, "camera": self.truth.camera, "R_enu_cam": R_enu_cam, "attitude_sigma": 1e-3}
            taken = replace(taken, **known)
            placed = replace(taken, revision=1) if k >= BEFORE else false.moved(replace(taken, revision=-1))
            self.photos.append(prepare(placed, AlignmentSettings()))
        self.jump = jump(T_NEW_OLD, datum, revision=1)
        coarse = MappingSettings(cell=0.4, tile_cells=64, image_pixels=300_000, match_pixels=100_000)
        self.live = LiveMap("flight", AirConfig(mapping=coarse), replace(datum, flight="flight"))
        self.cloud = Cloud()
        self.revisions: dict[object, int] = {}
        self.newest: dict[int, SE3] = {}

    def fly(self) -> Iterator[None]:
        """Map the photos; stops before the jump, after it, and at the end."""
        for taken in self.photos[:BEFORE]:
            self.grow(self.live.align(taken))
        yield
        self.grow(self.live.move(self.jump))
        yield
        for taken in self.photos[BEFORE:]:
            self.grow(self.live.align(taken))
        yield

    def grow(self, keyframes: list) -> None:  # type: ignore[type-arg]
        growth = self.live.grow(keyframes)
        for keyframe in growth.keyframes:
            assert keyframe.revision == self.revisions.get(keyframe.index, 0) + 1
            self.revisions[keyframe.index] = keyframe.revision
            self.newest[keyframe.index] = keyframe.T_world_cam
        self.send(growth.tiles)
        while tiles := self.live.correct(in_flight=True):
            self.send(tiles)

    def send(self, tiles: list[MapTile]) -> None:
        for tile in tiles:
            assert tile.revision == self.revisions.get(tile.id, 0) + 1
            self.revisions[tile.id] = tile.revision
            assert self.cloud.add("uav1", tile, encode(tile))

    def camera_errors(self) -> F64:
        """How far the keyframes are from where the cameras were (N,) m."""
        return np.array([np.linalg.norm(T.t - self.truth.T_world_cam[i].t) for i, T in self.newest.items()])

    def height_errors(self) -> F64:
        """Height of the ground's map above the truth (N,) m, of every cell that it holds."""
        errors = []
        for held in self.cloud.tiles():
            tile = held.decoded()
            row, column = np.nonzero(np.isfinite(tile.height) & ~tile.disputed)
            size = tile.height.shape[0]
            xy = np.stack([tile.id.x * size + column + 0.5, tile.id.y * size + row + 0.5], axis=1) * tile.cell
            errors.append(tile.height[row, column] - self.truth.world.height(xy))
        return np.concatenate(errors)


def test_tiles_of_before_a_jump_lie_where_the_truth_is_and_leave_no_ghost() -> None:
    flight = Flight()
    steps = flight.fly()
    next(steps)
    wrong = flight.height_errors()
    old = {held.id: held.revision for held in flight.cloud.tiles()}
    assert abs(np.median(wrong) + T_NEW_OLD.t[2]) < 0.1
    assert (flight.camera_errors() > 0.8).all()
    next(steps)
    right = flight.height_errors()
    assert abs(np.median(right)) < 0.05  # m; the noise of the positions is 0.02
    assert np.mean(np.abs(right) < 0.3) > np.mean(np.abs(wrong + T_NEW_OLD.t[2]) < 0.3) - 0.02
    assert all(flight.revisions[tile] > revision for tile, revision in old.items())
    assert len(right) == pytest.approx(len(wrong), rel=0.02)  # the old place is empty
    assert (flight.camera_errors() < 0.1).all()
    next(steps)
    assert abs(np.median(flight.height_errors())) < 0.1  # a quarter of a cell
    assert (flight.camera_errors() < 0.1).all()
