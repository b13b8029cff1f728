"""ROS bags as a source: both generations, the messages of gnss_comm, maps, damage."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from bag_samples import COLOUR, GREY, START_S, TOW, WEEK, Bag, write_bag
from rosbags.rosbag2 import StoragePlugin

from air.gnss.gnss_time import from_week
from air.sources import gnss_comm
from air.sources.bag import device_name
from air.sources.source import open_source
from common.errors import LuojiaError, SourceError
from common.measurements import (
    CameraFrame,
    Encoding,
    FixKind,
    GlonassEphemeris,
    GnssEpoch,
    ImuSample,
    Ionosphere,
    KeplerEphemeris,
    ReceiverSolution,
)


@pytest.fixture(scope="module", params=["ros1", "sqlite3", "mcap"])
def bag_path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    if request.param == "ros1":
        return write_bag(folder / "f.bag", ros1=True)
    return write_bag(folder / "f", ros1=False, storage=StoragePlugin[request.param.upper()])


def test_a_single_file_of_ros_2_is_a_bag_too(tmp_path: Path) -> None:
    (file,) = write_bag(tmp_path / "f", ros1=False, storage=StoragePlugin.MCAP).glob("*.mcap")
    assert len(list(open_source(f"bag:{file}"))) == 31


def gpst_ns(offset_s: float) -> int:
    return (START_S + 18) * 10**9 + round(offset_s * 1e9)


def of(items, kind):
    return [item for item in items if isinstance(item, kind)]


def test_images_imu_and_positions_come_by_time_of_their_stamps(bag_path: Path) -> None:
    source = open_source(f"bag:{bag_path}")
    items = list(source)
    assert source.problems == ()
    stamps = [i.t_ns for i in items]
    assert stamps == sorted(stamps)
    assert len(items) == 20 + 3 + 1 + 1 + 3 + 1 + 1 + 1
    imu = of(items, ImuSample)
    assert imu[0].t_ns == gpst_ns(0.0)
    np.testing.assert_array_equal([imu[0].accel, imu[0].gyro], [[1.0, 2.0, 9.81], [0.1, 0.2, 0.3]])
    assert imu[0].q_enu_body is None
    grey, colour, jpeg = of(items, CameraFrame)
    assert (grey.camera, grey.t_ns, grey.encoding, grey.data) == ("cam0", gpst_ns(0.05), Encoding.MONO8, GREY.tobytes())
    assert (colour.camera, colour.encoding, colour.data) == ("cam1", Encoding.BGR8, COLOUR[..., ::-1].tobytes())
    assert (jpeg.camera, jpeg.encoding, jpeg.width, jpeg.height) == ("front", Encoding.JPEG, 4, 3)
    (fix,) = [i for i in of(items, ReceiverSolution) if i.receiver == "rover"]
    assert (fix.kind, fix.latitude_deg, fix.height) == (FixKind.FIX_3D, 30.5, 62.0)
    assert (fix.sigma_horizontal, fix.sigma_vertical) == pytest.approx((2.0, 3.0))


def test_raw_measurements_of_gnss_comm_keep_their_meaning(bag_path: Path) -> None:
    (epoch,) = of(open_source(f"bag:{bag_path}"), GnssEpoch)
    assert epoch.t_ns == from_week(WEEK, TOW)
    assert epoch.satellites == ("G05", "G05", "R07", "C01")
    assert epoch.signals == ("1C", "2L", "1C", "2I")
    np.testing.assert_array_equal(epoch.pseudorange, [2.1e7, 2.1e7 + 1, 2.1e7, 2.1e7])
    np.testing.assert_array_equal(epoch.carrier_phase, [1.1e8, math.nan, 1.1e8, 1.1e8])
    np.testing.assert_array_equal(epoch.half_cycle, [False, True, True, False])
    np.testing.assert_array_equal(epoch.channel, [0, 0, 5, 0])
    np.testing.assert_array_equal(epoch.doppler, [-1234.5] * 4)


def test_ephemerides_of_gnss_comm_keep_their_meaning(bag_path: Path) -> None:
    items = list(open_source(f"bag:{bag_path}"))
    gps, galileo, beidou = of(items, KeplerEphemeris)
    assert [(e.satellite, e.source) for e in (gps, galileo, beidou)] == [
        ("G05", "LNAV"),
        ("E11", "INAV"),
        ("C02", "D2"),
    ]
    assert (gps.t_ns, gps.toe_ns, gps.toc_ns) == tuple(from_week(WEEK, 216_000.0 + i) for i in range(3))
    assert gps.sqrt_a == pytest.approx(math.sqrt(26_560_000.0))
    (glonass,) = of(items, GlonassEphemeris)
    assert (glonass.satellite, glonass.channel, glonass.tau, glonass.age_days) == ("R07", -5, -1e-4, 1)
    assert np.all(np.diff([*glonass.position, *glonass.velocity, *glonass.acceleration]) == 1.0)
    (ionosphere,) = of(items, Ionosphere)
    assert (ionosphere.alpha, ionosphere.beta) == ((0.0, 1.0, 2.0, 3.0), (4.0, 5.0, 6.0, 7.0))
    (pvt,) = [i for i in of(items, ReceiverSolution) if i.receiver != "rover"]
    assert (pvt.kind, pvt.satellites, pvt.t_ns) == (FixKind.RTK_FIXED, 21, from_week(WEEK, TOW))
    assert pvt.v_enu[2] == -(pvt.v_enu[0] + 1)  # the fields run north, east, down by one


def test_satellite_numbers_run_through_the_systems() -> None:
    names = [gnss_comm.satellite_name(number) for number in range(162)]
    assert (names[0], names[1], names[32], names[33], names[59]) == (None, "G01", "G32", "R01", "R27")
    assert (names[60], names[97], names[98], names[160], names[161]) == ("E01", "E38", "C01", "C63", None)


def test_a_map_chooses_topics_names_devices_and_shifts_stamps(bag_path: Path, tmp_path: Path) -> None:
    (tmp_path / "cam.toml").write_text("width=4\nheight=3\nfx=5\nfy=5\ncx=1.5\ncy=1.0\n")
    (tmp_path / "map.toml").write_text(
        'stamp_offset_s = 1.5\n[[topics]]\nname = "/cam1/image_raw"\ndevice = "down"\ncalibration = "cam.toml"\n'
    )
    source = open_source(f"bag:{bag_path}?map={tmp_path / 'map.toml'}")
    (frame,) = source
    assert (frame.camera, frame.t_ns) == ("down", gpst_ns(0.06 + 1.5 - 18))
    assert source.calibrations["down"].camera.fx == 5.0


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('[[topics]]\nname = "/cam9"\n', ["/cam9", "/cam0/image_raw"]),
        ('[[topic]]\nname = "/cam9"\n', ["topic", "topics"]),
        ("[[topics]]\n", ["name is missing"]),
        ('[[topics]]\nname = "/imu0"\ncalibration = "none.yaml"\n', ["none.yaml"]),
    ],
)
def test_a_wrong_map_is_refused_in_one_clear_line(bag_path: Path, tmp_path: Path, text: str, named: list[str]) -> None:
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(LuojiaError) as refused:
        open_source(f"bag:{bag_path}?map={tmp_path / 'map.toml'}")
    assert all(word in str(refused.value) for word in named)
    assert "\n" not in str(refused.value)


def test_of_several_imus_one_is_read(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "f.bag", ros1=True)
    with bag.writer:
        for topic, variance in (("/b/imu", 0.01), ("/a/imu", 0.01)):
            bag.write(topic, START_S, bag.imu(START_S, (0.6, 0.0, 0.0, 0.8), variance, up=float(topic == "/a/imu")))
    source = open_source(f"bag:{tmp_path / 'f.bag'}")
    (sample,) = source
    assert sample.accel[2] == 1.0
    np.testing.assert_array_equal(sample.q_enu_body, [0.6, 0.0, 0.0, 0.8])
    assert any("/b/imu" in problem.text + problem.name for problem in source.problems)


def test_messages_that_make_no_sense_are_counted_and_left_out(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "f.bag", ros1=True)
    with bag.writer:
        bag.write("/depth/image", START_S, bag.image(START_S, "16UC1", GREY))
        bag.write("/cam/image", START_S, bag.image(START_S, "bgr8", GREY))
        bag.write("/jpeg/compressed", START_S, bag.compressed(START_S, "jpeg", b"no image"))
        bag.write("/imu", START_S, bag.imu(START_S, up=math.nan))
        bag.write("/imu", START_S, bag.imu(START_S + 1))
    source = open_source(f"bag:{tmp_path / 'f.bag'}")
    assert len(list(source)) == 1
    assert {problem.name for problem in source.problems} == {"/depth/image", "/cam/image", "/jpeg/compressed", "/imu"}


def test_a_damaged_bag_is_read_as_far_as_possible_or_refused_in_one_line(tmp_path: Path) -> None:
    whole = write_bag(tmp_path / "f.bag", ros1=True).read_bytes()
    rng, read, refusals = np.random.default_rng(1), 0, []
    for trial in range(60):
        damaged = bytearray(whole if trial % 2 else whole[: int(rng.integers(len(whole)))])
        for at in rng.integers(0, max(len(damaged), 1), 3 if trial % 2 else 0):
            damaged[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "d.bag").write_bytes(damaged)
        try:
            list(open_source(f"bag:{tmp_path / 'd.bag'}"))
            read += 1
        except SourceError as error:
            refusals.append(str(error))
    assert read > 0
    assert refusals
    assert not any("\n" in text for text in refusals)


@pytest.mark.parametrize(("path", "named"), [("none.bag", "does not exist"), ("empty", "no bag"), ("x.bag", "no bag")])
def test_what_is_no_bag_is_refused_in_one_line(tmp_path: Path, path: str, named: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "x.bag").write_bytes(b"no bag at all")
    with pytest.raises(SourceError, match=named):
        open_source(f"bag:{tmp_path / path}")


@pytest.mark.parametrize(
    ("topic", "name"),
    [("/cam0/image_raw", "cam0"), ("/camera/color/image_raw", "camera"), ("/image_raw", "image-raw"), ("/", "device")],
)
def test_devices_are_named_after_their_topics(topic: str, name: str) -> None:
    assert device_name(topic) == name


def test_an_epoch_without_known_signals_is_none() -> None:
    assert gnss_comm.epoch(SimpleNamespace(meas=[]), "gnss", 0) is None
