"""A folder of photos: order, position, attitude and lens from EXIF and XMP; damage of every kind."""

import io
import os
from collections.abc import Callable
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, TiffImagePlugin

from air.sources.exif import EPOCH, PhotoFacts, R_enu_cam, read_facts
from air.sources.source import PhotoSource, open_photos
from common.geo import geodetic_to_enu
from common.messages import Datum, Photo

RealData = Callable[[str], Path]
START = datetime(2024, 5, 4, 10, 0, 0)
XMP = """<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {}</rdf:RDF></x:xmpmeta>"""


def rational(value: float) -> TiffImagePlugin.IFDRational:
    return TiffImagePlugin.IFDRational(round(value * 1_000_000), 1_000_000)


def dms(degrees: float) -> tuple[TiffImagePlugin.IFDRational, ...]:
    minutes = abs(degrees) % 1 * 60
    return rational(int(abs(degrees))), rational(int(minutes)), rational(minutes % 1 * 60)


def make_jpeg(
    *,
    taken: datetime | None = START,
    subsec: str | None = None,
    position: tuple[float, float, float] | None = (-33.8568, 151.2153, 45.25),
    tags: dict[int, object] | None = None,
    root_tags: dict[int, object] | None = None,
    gps_tags: dict[int, object] | None = None,
    xmp: str | None = None,
    size: tuple[int, int] = (64, 48),
) -> bytes:
    exif = Image.Exif()
    exif.update(root_tags or {})
    ifd = exif.get_ifd(0x8769)
    if taken is not None:
        ifd[0x9003] = taken.strftime("%Y:%m:%d %H:%M:%S")
    if subsec is not None:
        ifd[0x9291] = subsec
    ifd.update(tags or {})
    gps = exif.get_ifd(0x8825)
    if position is not None:
        lat, lon, alt = position
        gps.update({1: "N" if lat >= 0 else "S", 2: dms(lat), 3: "E" if lon >= 0 else "W", 4: dms(lon)})
        gps.update({5: b"\x00" if alt >= 0 else b"\x01", 6: rational(abs(alt))})
    gps.update(gps_tags or {})
    out = io.BytesIO()
    pixels = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    extra = {} if xmp is None else {"xmp": xmp.encode()}
    Image.fromarray(pixels).save(out, "JPEG", exif=exif, **extra)
    return out.getvalue()


def photos_of(folder: Path) -> tuple[PhotoSource, list[Photo]]:
    source = open_photos(f"photos:{folder}")
    photos = list(source)
    assert len(photos) == len(source)
    stamps = [photo.t_ns for photo in photos]
    assert all(a < b for a, b in pairwise(stamps))
    return source, photos


def test_the_position_of_every_hemisphere_is_read() -> None:
    for position in ((-33.8568, 151.2153, 45.25), (48.1, -11.5, -3.5)):
        fix = read_facts(make_jpeg(position=position)).fix
        assert fix is not None
        # 1e-6 in the seconds of the rationals is 3e-10 degrees.
        assert (fix.latitude_deg, fix.longitude_deg, fix.height) == pytest.approx(position, abs=1e-9)
        assert (fix.sigma_horizontal, fix.sigma_vertical) == (1.5, 3.0)


def test_the_stated_position_error_is_used() -> None:
    fix = read_facts(make_jpeg(gps_tags={31: rational(0.03)})).fix
    assert fix is not None
    assert (fix.sigma_horizontal, fix.sigma_vertical) == pytest.approx((0.03, 0.06))


@pytest.mark.parametrize(
    ("jpeg", "trouble"),
    [
        (make_jpeg(position=None), "no GPS position"),
        (make_jpeg(position=(0.0, 0.0, 10.0)), "impossible GPS position"),
        (make_jpeg(position=(95.0, 10.0, 10.0)), "impossible GPS position"),
        (make_jpeg(gps_tags={2: (TiffImagePlugin.IFDRational(0, 0),) * 3}), "no GPS position"),
        (make_jpeg(gps_tags={6: TiffImagePlugin.IFDRational(0, 0)}), "without a usable altitude"),
        (b"no jpeg at all", "no readable image"),
        (b"", "no readable image"),
    ],
)
def test_a_photo_without_a_believable_position_has_no_fix_and_says_why(jpeg: bytes, trouble: str) -> None:
    facts = read_facts(jpeg)
    assert facts.fix is None
    assert any(trouble in text for text in facts.trouble)


def test_the_sub_seconds_of_the_clock_are_read() -> None:
    elapsed_ns = round((START - EPOCH).total_seconds()) * 10**9
    assert read_facts(make_jpeg(subsec="25")).t_ns == elapsed_ns + 250_000_000
    assert read_facts(make_jpeg(subsec="??")).t_ns == elapsed_ns


@pytest.mark.parametrize(
    ("tags", "root_tags", "size", "focal_px"),
    [
        # 24 mm equivalent on 3:2 is 24/36 of the width.
        ({0xA405: 24}, {}, (600, 400), 400.0),
        # Taken at 4000 px with 16393 px/inch, 4.5 mm, then halved.
        ({0x920A: rational(4.5), 0xA20E: rational(400.0), 0xA210: 4, 0xA002: 4000}, {}, (2000, 1500), 900.0),
        ({0x920A: rational(3.61)}, {0x0110: "FC300S\0\0"}, (1920, 1080), 3.61 / 6.17 * 1920),
        ({0x920A: rational(4.0)}, {0x0110: "unheard of"}, (640, 480), 640.0),
        ({0xA405: 0}, {}, (480, 640), 640.0),
    ],
)
def test_the_focal_length_is_guessed(
    tags: dict[int, object], root_tags: dict[int, object], size: tuple[int, int], focal_px: float
) -> None:
    camera = read_facts(make_jpeg(tags=tags, root_tags=root_tags, size=size)).camera
    assert camera is not None
    assert (camera.width, camera.height) == size
    assert camera.fx == camera.fy == pytest.approx(focal_px)
    assert (camera.cx, camera.cy) == ((size[0] - 1) / 2, (size[1] - 1) / 2)


GIMBAL = {"GimbalYawDegree": "+90.00", "GimbalPitchDegree": "-90.00", "GimbalRollDegree": "+0.00"}
ATTRIBUTES = " ".join(f'drone-dji:{key}="{value}"' for key, value in GIMBAL.items()) + "/>"
ELEMENTS = (
    ">" + "".join(f"<drone-dji:{key}>{value}</drone-dji:{key}>" for key, value in GIMBAL.items()) + "</rdf:Description>"
)


@pytest.mark.parametrize("properties", [ATTRIBUTES, ELEMENTS])
def test_gimbal_angles_are_read_as_attributes_and_as_elements(properties: str) -> None:
    R = read_facts(make_jpeg(xmp=XMP.format(properties))).R_enu_cam
    assert R is not None
    # Looking down with the top to the east: right is south, the image's down is west, the axis points down.
    np.testing.assert_allclose(R, np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1]]), atol=1e-12)


def test_gimbal_angles_turn_as_their_definition_says() -> None:
    level = R_enu_cam(0.0, 0.0, 0.0)
    np.testing.assert_allclose(level, np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), atol=1e-12)
    forward = R_enu_cam(np.radians(30), np.radians(-20), np.radians(10))[:, 2]
    assert np.degrees(np.arctan2(forward[0], forward[1])) == pytest.approx(30)
    assert np.degrees(np.arcsin(forward[2])) == pytest.approx(-20)
    assert R_enu_cam(0.0, 0.0, 0.1)[2, 0] < 0, "positive roll lowers the right side"


@pytest.mark.parametrize("properties", ["/>", ATTRIBUTES.replace("-90.00", "down"), "", "><![CDATA[", ELEMENTS[:-40]])
def test_missing_or_malformed_xmp_gives_no_attitude(properties: str) -> None:
    facts = read_facts(make_jpeg(xmp=XMP.format(properties)))
    assert facts.R_enu_cam is None
    assert facts.fix is not None


def test_photos_come_in_the_order_of_their_clocks_whatever_their_names(tmp_path: Path) -> None:
    for name, seconds in (("a.JPG", 4), ("b.jpeg", 2), ("c.jpg", 0), ("d.jpg", 0)):
        (tmp_path / name).write_bytes(make_jpeg(taken=START + timedelta(seconds=seconds)))
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "e.jpg").write_bytes(make_jpeg())
    source, photos = photos_of(tmp_path)
    assert [photo.name for photo in photos] == ["c.jpg", "d.jpg", "b.jpeg", "a.JPG"]
    assert (photos[-1].t_ns - photos[0].t_ns) == 4_000_000_000
    assert not source.problems


def test_a_wrong_clock_is_named_and_spoils_nothing_else(tmp_path: Path) -> None:
    for i in range(12):
        taken = {3: datetime(1980, 1, 6), 7: None, 11: datetime(2037, 1, 1)}.get(i, START + timedelta(seconds=2 * i))
        (tmp_path / f"IMG_{i}.jpg").write_bytes(make_jpeg(taken=taken))
    source, photos = photos_of(tmp_path)
    assert [photo.name for photo in photos] == [f"IMG_{i}.jpg" for i in range(12)], "numbers count as numbers"
    assert [round((photo.t_ns - photos[0].t_ns) * 1e-9) for photo in photos] == [2 * i for i in range(12)]
    assert {problem.name for problem in source.problems} == {"IMG_3.jpg", "IMG_7.jpg", "IMG_11.jpg"}
    assert all("clock" in problem.text for problem in source.problems)


def test_damaged_photos_are_passed_on_and_named(tmp_path: Path) -> None:
    sound = make_jpeg(size=(320, 240))
    files = {"0.jpg": sound, "1.jpg": sound[: len(sound) // 2], "2.jpg": sound, "3.jpg": b"", "4.jpg": os.urandom(999)}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    source, photos = photos_of(tmp_path)
    assert {photo.name: photo.jpeg for photo in photos} == files
    blank = [photo for photo in photos if photo.name in ("3.jpg", "4.jpg")]
    assert [(photo.camera, photo.fix, photo.R_enu_cam) for photo in blank] == [(None, None, None)] * 2
    assert {problem.name for problem in source.problems} == {"3.jpg", "4.jpg"}
    assert next(photo for photo in photos if photo.name == "1.jpg").fix is not None


def test_a_photo_that_vanishes_is_named(tmp_path: Path) -> None:
    for i in range(3):
        (tmp_path / f"{i}.jpg").write_bytes(make_jpeg(taken=START + timedelta(seconds=i)))
    source = open_photos(f"photos:{tmp_path}")
    (tmp_path / "1.jpg").unlink()
    assert [photo.name for photo in source] == ["0.jpg", "2.jpg"]
    assert [problem.name for problem in source.problems] == ["1.jpg"]


HEADER = make_jpeg(
    subsec="12", tags={0x920A: rational(4.5), 0xA20E: rational(16393.4), 0xA002: 4000}, xmp=XMP.format(ATTRIBUTES)
)


@settings(max_examples=300, deadline=None)
@given(
    edits=st.lists(st.tuples(st.integers(0, len(HEADER) - 1), st.integers(0, 255)), max_size=30),
    length=st.integers(0, len(HEADER)),
)
def test_no_damage_to_a_header_raises(edits: list[tuple[int, int]], length: int) -> None:
    damaged = bytearray(HEADER)
    for place, value in edits:
        damaged[place] = value
    assert_believable(read_facts(bytes(damaged[:length])))


def assert_believable(facts: PhotoFacts) -> None:
    if facts.fix is not None:
        assert np.isfinite([facts.fix.latitude_deg, facts.fix.longitude_deg, facts.fix.height]).all()
        assert facts.fix.sigma_horizontal > 0
    if facts.camera is not None:
        assert np.isfinite(facts.camera.K).all()
        assert facts.camera.fx > 0
    if facts.R_enu_cam is not None:
        np.testing.assert_allclose(facts.R_enu_cam @ facts.R_enu_cam.T, np.eye(3), atol=1e-9)


def test_every_byte_of_the_header_may_be_wrong() -> None:
    end = HEADER.index(b"\xff\xdb")
    for place in range(end):
        for value in (0x00, 0xFF, HEADER[place] ^ 0x01):
            assert_believable(read_facts(HEADER[:place] + bytes([value]) + HEADER[place + 1 : end + 200]))


def test_brighton_beach_is_read_as_it_was_flown(real_data: RealData) -> None:
    source, photos = photos_of(real_data("brighton_beach") / "images")
    assert (len(photos), list(source.problems)) == (18, [])
    first = photos[0]
    assert first.camera is not None
    assert first.fix is not None
    assert first.R_enu_cam is not None
    assert first.camera.fx == pytest.approx(1123, abs=2)
    assert (first.fix.latitude_deg, first.fix.longitude_deg) == pytest.approx((46.842607, -91.994560), abs=1e-6)
    # Nadir to 0.1°, the top of the image to the north-east.
    assert first.R_enu_cam[2, 2] == pytest.approx(-1, abs=1e-5)
    np.testing.assert_allclose(-first.R_enu_cam[:2, 1], [np.sqrt(0.5)] * 2, atol=1e-3)


def test_gimbal_angles_agree_with_how_the_ground_moves_through_brighton_beach(real_data: RealData) -> None:
    """The shift between two nadir photos, turned by the attitude, must point where GPS says the drone went.

    Only the first line: on the way back the drone stored its images turned by 180° without saying so anywhere.
    """
    _, photos = photos_of(real_data("brighton_beach") / "images")
    for before, after in pairwise(photos[:5]):
        assert before.fix is not None
        assert after.fix is not None
        assert before.R_enu_cam is not None
        datum = Datum("", before.fix.latitude_deg, before.fix.longitude_deg, before.fix.height)
        flown = geodetic_to_enu(datum, after.fix.latitude_deg, after.fix.longitude_deg, after.fix.height)
        shift = before.R_enu_cam @ [*-_shift_of_the_centre(before.jpeg, after.jpeg), 0.0]
        angle = np.degrees(np.arctan2(shift[0], shift[1]) - np.arctan2(flown[0], flown[1]))
        # 14 m flown with fixes good to about a metre, and a gimbal compass good to several degrees.
        assert abs((angle + 180) % 360 - 180) < 12


def _shift_of_the_centre(before: bytes, after: bytes) -> np.ndarray:
    """How far the ground in the centre of one photo has moved in the next (2,), px of quarter-size images."""
    flags = cv2.IMREAD_REDUCED_GRAYSCALE_4 | cv2.IMREAD_IGNORE_ORIENTATION
    images = [cv2.imdecode(np.frombuffer(jpeg, np.uint8), flags) for jpeg in (before, after)]
    (points_a, features_a), (points_b, features_b) = (
        cv2.SIFT_create(3000).detectAndCompute(image, None) for image in images
    )
    good = [a for a, b in cv2.BFMatcher().knnMatch(features_a, features_b, k=2) if a.distance < 0.8 * b.distance]
    seen_a = np.array([points_a[match.queryIdx].pt for match in good])
    seen_b = np.array([points_b[match.trainIdx].pt for match in good])
    similarity, inliers = cv2.estimateAffinePartial2D(seen_a, seen_b, ransacReprojThreshold=4)
    assert inliers.sum() >= 20
    centre = np.array([images[0].shape[1] / 2, images[0].shape[0] / 2])
    return np.asarray(similarity @ [*centre, 1.0] - centre)


def test_caliterra_gives_positions_and_a_focal_length_from_the_pixel_pitch(real_data: RealData) -> None:
    source, photos = photos_of(real_data("caliterra") / "images")
    assert (len(photos), list(source.problems)) == (75, [])
    assert all(photo.fix is not None and photo.R_enu_cam is None for photo in photos)
    # 4.5 mm at 16393 px/inch, resized from 4000 to 1600 px.
    assert photos[0].camera is not None
    assert photos[0].camera.fx == pytest.approx(4.5 / 25.4 * 16393.44 * 0.4, rel=1e-4)


def test_photos_without_exif_come_by_name_and_say_so(real_data: RealData) -> None:
    source, photos = photos_of(real_data("cuav") / "testimgs")
    assert [photo.name for photo in photos] == sorted(photo.name for photo in photos)
    assert all(photo.fix is None and photo.camera is not None for photo in photos)
    assert {problem.name for problem in source.problems} == {photo.name for photo in photos}
