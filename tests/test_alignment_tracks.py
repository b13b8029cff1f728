"""Tracks, points and the preparation of single photos."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from air.alignment.points import Points
from air.alignment.prepare import fitted_camera, prepare
from air.alignment.settings import AlignmentSettings
from air.alignment.tracks import Tracks
from common.camera import CameraModel
from common.messages import Photo

FEATURES = 6
links = st.lists(
    st.tuples(
        st.integers(0, 3), st.integers(0, 3), st.lists(st.tuples(*[st.integers(0, FEATURES - 1)] * 2), max_size=6)
    ).filter(lambda link: link[0] != link[1]),
    max_size=12,
)


@given(links)
def test_a_track_holds_one_feature_of_a_photo_and_both_directions_agree(found):
    tracks = Tracks()
    for photo in range(4):
        tracks.add_photo(photo, FEATURES)
    for a, b, pairs in found:
        tracks.link(a, b, np.array(pairs, np.int64).reshape(-1, 2))
    for photo in range(4):
        for feature, track in enumerate(tracks.of(photo).tolist()):
            assert track < 0 or tracks.members(track)[photo] == feature
    for track in range(len(tracks)):
        for photo, feature in tracks.members(track).items():
            assert tracks.of(photo)[feature] == track


def test_matches_through_a_third_photo_join_one_track():
    tracks = Tracks()
    for photo in range(3):
        tracks.add_photo(photo, FEATURES)
    tracks.link(0, 1, np.array([[0, 1]]))
    tracks.link(1, 2, np.array([[1, 2]]))
    assert tracks.members(int(tracks.of(2)[2])) == {0: 0, 1: 1, 2: 2}
    tracks.drop(int(tracks.of(2)[2]), 1)
    assert tracks.of(1)[1] == -1
    assert tracks.members(int(tracks.of(0)[0])) == {0: 0, 2: 2}


@given(st.dictionaries(st.integers(0, 5000), st.floats(-1e3, 1e3), max_size=20))
def test_points_are_what_was_put(wanted):
    points = Points()
    keys = np.array(sorted(wanted), np.int64)
    points.put(keys, np.array([[wanted[k]] * 3 for k in keys.tolist()]).reshape(-1, 3))
    assert points.known(np.arange(-1, 6000)).sum() == len(keys)
    assert np.array_equal(points.at(keys)[:, 0], [wanted[k] for k in keys.tolist()])
    points.forget(keys[:3])
    assert len(points.all()) == max(0, len(keys) - 3)


def jpeg(image):
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=92)
    return buffer.getvalue()


TEXTURE = jpeg(np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8).repeat(8, 0).repeat(8, 1))


def test_a_good_photo_is_prepared():
    ready = prepare(Photo(0, "a.jpg", TEXTURE, None, None), AlignmentSettings())
    assert ready.fault is None
    assert ready.image.shape == (480, 640, 3)
    assert len(ready.features.uv) > 500
    assert (ready.features.uv >= -1).all()
    assert np.allclose(np.linalg.norm(ready.features.descriptors, axis=1), 1, atol=1e-3)


@pytest.mark.parametrize(
    ("damaged", "reason"),
    [
        (TEXTURE[: len(TEXTURE) // 2], "truncated"),
        (b"", "no image|is not an image"),
        (b"no picture at all", "is not an image"),
        (jpeg(np.zeros((480, 640, 3), np.uint8)), "black"),
        (jpeg(np.full((480, 640, 3), 130, np.uint8)), "without texture"),
    ],
)
def test_an_unusable_photo_says_why(damaged, reason):
    ready = prepare(Photo(0, "a.jpg", damaged, None, None), AlignmentSettings())
    assert ready.fault is not None
    assert any(part in ready.fault for part in reason.split("|"))


@given(st.binary(max_size=200), st.integers(0, len(TEXTURE) - 1))
def test_no_bytes_make_the_preparation_raise(noise, at):
    prepared = prepare(Photo(0, "a.jpg", TEXTURE[:at][:3000] + noise, None, None), AlignmentSettings())
    assert bool(prepared.fault) == (prepared.features is None)


def test_a_guess_for_another_size_is_scaled():
    fitted = fitted_camera(CameraModel(4000, 3000, 3000.0, 3000.0, 1999.5, 1499.5), 1000, 750)
    assert (fitted.width, fitted.height, fitted.fx) == (1000, 750, 750.0)
    assert fitted.cx == pytest.approx(499.5)
