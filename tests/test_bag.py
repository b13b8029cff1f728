"""ROS bags as a source: both generations, the messages of gnss_comm, maps, damage."""

import io
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

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

WEEK, TOW = 2122, 216_018.25
START_S = 1_599_566_400  # 216 018.00 s of that week, as Unix time: GPST − UTC is 18 s
GREY = np.arange(12, dtype=np.uint8).reshape(3, 4)
COLOUR = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)


class Bag:
    """Writes a small bag of either generation."""

    def __init__(self, path: Path, ros1: bool):
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        for name, text in gnss_comm.DEFINITIONS.items():
            self.store.register(get_types_from_msg(text, f"gnss_comm/msg/{name}"))
        self.writer = Writer1(path) if ros1 else Writer2(path, version=8, storage_plugin=StoragePlugin.SQLITE3)
        self.connections = {}

    def make(self, kind: str, **values):
        return self.store.types[kind](**values)

    def header(self, seconds: float):
        whole = int(seconds // 1)
        time = self.make("builtin_interfaces/msg/Time", sec=whole, nanosec=round((seconds - whole) * 1e6) * 1000)
        values = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id="", **values)

    def write(self, topic: str, seconds: float, message) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], round(seconds * 1e9), serialize(message, kind))

    def imu(self, seconds: float, orientation=(1.0, 0.0, 0.0, 0.0), variance: float = -1.0, up: float = 9.81):
        vector, (w, x, y, z) = "geometry_msgs/msg/Vector3", orientation
        covariance = np.zeros(9)
        covariance[0] = variance
        return self.make(
            "sensor_msgs/msg/Imu",
            header=self.header(seconds),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            orientation_covariance=covariance,
            angular_velocity=self.make(vector, x=0.1, y=0.2, z=0.3),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.make(vector, x=1.0, y=2.0, z=up),
            linear_acceleration_covariance=np.zeros(9),
        )

    def image(self, seconds: float, encoding: str, pixels: np.ndarray, padding: int = 0):
        rows = pixels.reshape(len(pixels), -1)
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(seconds),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1] + padding,
            data=np.pad(rows, ((0, 0), (0, padding))).ravel(),
        )

    def compressed(self, seconds: float, kind: str, data: bytes):
        data = np.frombuffer(data, np.uint8)
        return self.make("sensor_msgs/msg/CompressedImage", header=self.header(seconds), format=kind, data=data)

    def fix(self, seconds: float):
        status = self.make("sensor_msgs/msg/NavSatStatus", status=0, service=1)
        covariance = np.diag([4.0, 4.0, 9.0]).ravel()
        return self.make(
            "sensor_msgs/msg/NavSatFix",
            header=self.header(seconds),
            status=status,
            latitude=30.5,
            longitude=114.4,
            altitude=62.0,
            position_covariance=covariance,
            position_covariance_type=2,
        )

    def gnss(self, kind: str, **values):
        return self.make(f"gnss_comm/msg/{kind}", **values)

    def time(self, tow: float = TOW):
        return self.gnss("GnssTimeMsg", week=WEEK, tow=tow)

    def observation(self, satellite: int, codes: list[int], frequencies: list[float], status: list[int]):
        n = len(codes)
        floats = {
            "freqs": frequencies,
            "CN0": [40.0] * n,
            "psr": [2.1e7 + i for i in range(n)],
            "psr_std": [0.5] * n,
            "cp": [1.1e8] * n,
            "cp_std": [0.01] * n,
            "dopp": [-1234.5] * n,
            "dopp_std": [0.2] * n,
        }
        return self.gnss(
            "GnssObsMsg",
            time=self.time(),
            sat=satellite,
            LLI=np.zeros(n, np.uint8),
            code=np.array(codes, np.uint8),
            status=np.array(status, np.uint8),
            **{name: np.array(values) for name, values in floats.items()},
        )

    def ephemeris(self, satellite: int):
        names = gnss_comm.DEFINITIONS["GnssEphemMsg"].split()[1::2]
        values = {name: 0.001 * i for i, name in enumerate(names)}
        values |= {name: i for i, name in enumerate(("week", "iode", "iodc", "health", "code"))}
        times = {name: self.time(216_000.0 + i) for i, name in enumerate(("ttr", "toe", "toc"))}
        return self.gnss("GnssEphemMsg", **(values | times | {"sat": satellite, "A": 26_560_000.0}))

    def glonass(self, satellite: int):
        names = gnss_comm.DEFINITIONS["GnssGloEphemMsg"].split()[1::2]
        values = {name: 10.0 + i for i, name in enumerate(names)}
        values |= {"iode": 3, "health": 0, "age": 1, "freqo": -5, "sat": satellite, "tau_n": 1e-4}
        return self.gnss("GnssGloEphemMsg", **(values | {"ttr": self.time(), "toe": self.time(216_000.0)}))

    def pvt(self):
        names = gnss_comm.DEFINITIONS["GnssPVTSolnMsg"].split()[1::2]
        values = {name: 1.0 + i for i, name in enumerate(names)} | {"time": self.time(), "fix_type": 3}
        values |= {"valid_fix": True, "diff_soln": True, "carr_soln": 2, "num_sv": 21}
        return self.gnss("GnssPVTSolnMsg", **values)


def write_bag(path: Path, ros1: bool) -> Path:
    bag = Bag(path, ros1)
    jpeg = io.BytesIO()
    Image.fromarray(COLOUR).save(jpeg, "JPEG")
    with bag.writer:
        for i in range(20):
            bag.write("/imu0", START_S + 0.01 * i + 0.1, bag.imu(START_S + 0.01 * i))
        # Arrives late and is stamped early: to be put in its place.
        bag.write("/cam0/image_raw", START_S + 0.3, bag.image(START_S + 0.05, "mono8", GREY, padding=4))
        bag.write("/cam1/image_raw", START_S + 0.3, bag.image(START_S + 0.06, "rgb8", COLOUR))
        bag.write("/front/image/compressed", START_S + 0.3, bag.compressed(START_S + 0.07, "jpeg", jpeg.getvalue()))
        bag.write("/rover/fix", START_S + 0.3, bag.fix(START_S + 0.08))
        meas = [bag.observation(5, [1, 17], [1.57542e9, 1.2276e9], [7, 1]), bag.observation(0, [1], [1.57e9], [7])]
        meas += [bag.observation(32 + 7, [1], [1.602e9 + 5 * 562_500.0], [3]), bag.observation(98, [47], [1.56e9], [7])]
        bag.write("/ublox_driver/range_meas", START_S + 0.3, bag.gnss("GnssMeasMsg", meas=meas))
        for satellite in (5, 32 + 27 + 11, 32 + 27 + 38 + 2):
            bag.write("/ublox_driver/ephem", START_S + 0.3, bag.ephemeris(satellite))
        bag.write("/ublox_driver/glo_ephem", START_S + 0.3, bag.glonass(32 + 7))
        iono = bag.gnss("StampedFloat64Array", header=bag.header(START_S + 0.09), data=np.arange(8.0))
        bag.write("/ublox_driver/iono_params", START_S + 0.3, iono)
        bag.write("/ublox_driver/receiver_pvt", START_S + 0.3, bag.pvt())
        pulse = bag.gnss("GnssTimePulseInfoMsg", time=bag.time(), utc_based=False, time_sys=0)
        bag.write("/ublox_driver/time_pulse_info", START_S + 0.3, pulse)
    return path


@pytest.fixture(scope="module", params=["ros1", "ros2"])
def bag_path(request, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    return write_bag(folder / ("f.bag" if request.param == "ros1" else "f"), request.param == "ros1")


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
