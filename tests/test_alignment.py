"""The alignment as a whole, on simulated photos whose truth is exact."""

from dataclasses import replace

import numpy as np
import pytest

from air.alignment.alignment import Alignment
from air.alignment.prepare import prepare
from air.alignment.settings import AlignmentSettings
from air.alignment.status import State
from air.sources.source import open_photos
from common.geo import T_world_other
from ground.evaluation.similarity import umeyama

SETTINGS = AlignmentSettings()


@pytest.fixture(scope="module")
def survey():
    source = open_photos("sim:survey?seed=4&photos=14")
    return source.truth, [prepare(photo, SETTINGS) for photo in source]


def aligned(photos):
    alignment = Alignment("test", SETTINGS)
    newest = {}
    for photo in photos:
        newest |= {k.index: k for k in alignment.add(photo)}
    return alignment, newest


def rmse(keyframes, truth, datum, order):
    T = T_world_other(truth.datum, datum)
    ours = np.array([T.apply(k.T_world_cam.t) for k in keyframes])
    true = np.array([truth.T_world_cam[order[k.index]].t for k in keyframes])
    fit = umeyama(ours, true, with_scale=True)
    return float(np.sqrt(((fit.apply(ours) - true) ** 2).sum(axis=1).mean()))


def test_positions_are_found_to_centimetres_and_every_revision_is_newer(survey):
    truth, photos = survey
    alignment = Alignment("test", SETTINGS)
    revisions: dict[int, int] = {}
    for photo in photos:
        for keyframe in alignment.add(photo):
            assert keyframe.revision == revisions.get(keyframe.index, 0) + 1
            revisions[keyframe.index] = keyframe.revision
    final = alignment.finish()
    assert [k.index for k in final] == list(range(len(photos)))
    assert rmse(final, truth, alignment.datum, list(range(14))) < 0.05
    assert alignment.residual_px() < 0.5
    assert all(s.state is State.PLACED for s in alignment.statuses())


def test_the_order_of_arrival_does_not_matter_much(survey):
    truth, photos = survey
    order = [7, 0, 13, 3, 10, 5, 1, 12, 8, 2, 11, 6, 4, 9]
    alignment, _ = aligned([photos[i] for i in order])
    final = alignment.finish()
    assert len(final) == len(photos)
    assert rmse(final, truth, alignment.datum, order) < 0.05


def test_two_halves_that_a_late_photo_connects_become_one_block(survey):
    truth, photos = survey
    order = [0, 1, 2, 3, 9, 10, 11, 12, 13, 4, 5, 6, 7, 8]
    alignment, _ = aligned([photos[i] for i in order])
    final = alignment.finish()
    assert len(final) == len(photos)
    assert not any(s.reason for s in alignment.statuses())
    assert rmse(final, truth, alignment.datum, order) < 0.05


def test_photos_without_position_and_of_another_place_are_named_and_spoil_nothing(survey):
    truth, photos = survey
    elsewhere = prepare(next(iter(open_photos("sim:survey?seed=9&photos=2"))), SETTINGS)
    elsewhere = replace(elsewhere, photo=replace(elsewhere.photo, name="elsewhere.jpg"))
    blind = replace(photos[5], photo=replace(photos[5].photo, fix=None))
    alignment, _ = aligned([elsewhere, *photos[:5], blind, *photos[6:], photos[3]])
    final = alignment.finish()
    status = alignment.statuses()
    assert status[0].state is State.WAITING
    assert "another place" in status[0].reason
    assert status[6].state is State.PLACED
    assert "no GPS" in status[6].reason
    assert status[-1].state is State.REJECTED
    assert photos[3].photo.name in status[-1].reason
    assert rmse(final, truth, alignment.datum, [None, *range(14)]) < 0.05


def test_a_wild_fix_is_outvoted(survey):
    truth, photos = survey
    fix = photos[6].photo.fix
    wild = replace(photos[6], photo=replace(photos[6].photo, fix=replace(fix, latitude_deg=fix.latitude_deg + 0.0005)))
    alignment, _ = aligned([*photos[:6], wild, *photos[7:]])
    final = alignment.finish()
    assert len(final) == len(photos)
    assert rmse(final, truth, alignment.datum, list(range(14))) < 0.06


def test_without_any_position_nothing_is_placed(survey):
    _, photos = survey
    alignment, newest = aligned([replace(p, photo=replace(p.photo, fix=None)) for p in photos[:4]])
    assert not newest
    assert not alignment.finish()
    assert alignment.datum is None
    assert all("no GPS" in s.reason for s in alignment.statuses())


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "growth"), [(1, 1.5), (3, 2.0)])
def test_the_focal_length_is_found_however_seldom_all_photos_are_adjusted(seed, growth):
    """Between adjustments of all photos the block is held together by local ones, with a focal length 3 % wrong."""
    source = open_photos(f"sim:survey?seed={seed}&photos=24")
    alignment = Alignment("test", replace(SETTINGS, growth=growth))
    for photo in source:
        alignment.add(prepare(photo, SETTINGS))
    final = alignment.finish()
    assert len(final) == 24
    assert alignment.cameras[0].fx == pytest.approx(source.truth.camera.fx, rel=0.01)
    assert rmse(final, source.truth, alignment.datum, list(range(24))) < 0.05
