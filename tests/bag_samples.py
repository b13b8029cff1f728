"""Small ROS bags of both generations, for tests."""

import io
from pathlib import Path

import numpy as np
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from air.sources import gnss_comm

WEEK, TOW = 2122, 216_018.25
START_S = 1_599_566_400  # 216 018.00 s of that week, as Unix time: GPST − UTC is 18 s
GREY = np.arange(12, dtype=np.uint8).reshape(3, 4)
COLOUR = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)


class Bag:
    """Writes a small bag of either generation."""

    def __init__(self, path: Path, ros1: bool, storage: StoragePlugin = StoragePlugin.SQLITE3):
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        for name, text in gnss_comm.DEFINITIONS.items():
            self.store.register(get_types_from_msg(text, f"gnss_comm/msg/{name}"))
        self.writer = Writer1(path) if ros1 else Writer2(path, version=8, storage_plugin=storage)
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


def write_bag(path: Path, ros1: bool, storage: StoragePlugin = StoragePlugin.SQLITE3) -> Path:
    bag = Bag(path, ros1, storage)
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
