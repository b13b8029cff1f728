"""The readers of outside bytes that are fuzzed. To add one: a function of bytes, and what it usually reads."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from broadcast_samples import GLONASS, SENT_NS, SIGNAL, SOME, pieces_of
from conftest import DATA
from fuzz_importers import (
    bag_seeds,
    dataflash_seeds,
    gpmf_seeds,
    read_dataflash,
    read_file,
    read_gpmf,
    ulog_seeds,
)
from gnss_samples import NAVIGATION, OLD_OBSERVATIONS
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from recording_samples import flight, write
from ubx_samples import EPOCH, SOLUTION, STREAM

from air.gnss import beidou_d1_d2, glonass_strings, inav, lnav
from air.gnss.bits import split
from air.gnss.msm_writer import MsmWriter
from air.gnss.precise_orbit import read_sp3
from air.gnss.rinex_lines import Lines
from air.gnss.rinex_navigation import read_navigation
from air.gnss.rinex_observation import read_observations
from air.sensors import ubx, xbus
from air.sensors.driver import Driver
from air.sensors.gnss_rtcm import RtcmReceiver
from air.sensors.gnss_ublox import UbloxReceiver
from air.sensors.imu_xsens import XsensImu
from air.sensors.mavlink import MavlinkVehicle
from air.sensors.mtdata2 import DataId, Precision, pack
from air.sensors.ubx_messages import NAV_PVT, RXM_RAWX, RXM_SFRBX, NavigationBits, pack_sfrbx
from air.sensors.ubx_pvt import pack_pvt
from air.sensors.ubx_rawx import pack_rawx
from common import rtcm
from common.errors import SourceError
from common.mavlink import Stamps
from common.recording.reader import MAX_PROBLEMS, Recording


@dataclass(frozen=True)
class Reader:
    """`read` takes any bytes and returns; `seeds` gives what it usually reads, at least one, a few thousand bytes each.

    `read` may raise what it says it raises only if it catches that itself: here every exception is a failure.
    """

    name: str
    read: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]


def recorded(name: str, *parts: tuple[int, int]) -> list[bytes]:
    """Parts (first byte, length) of a real recording, none where it is not beside this checkout."""
    path = DATA / name
    if not path.exists():
        return []
    with path.open("rb") as file:
        out = []
        for first, length in parts:
            file.seek(first)
            out.append(file.read(length))
        return out


def of_driver(name: str, driver: Callable[[], Driver], seeds: Callable[[], list[bytes]]) -> Reader:
    """Feeds a new driver in pieces; it must account for every byte and hold no more than it was given."""

    def read(data: bytes) -> None:
        it, at, step = driver(), 0, 1 + len(data) % 997
        while at < len(data):
            it.feed(data[at : at + step], 0)
            at += step
        assert it.counts.received_bytes == len(data)
        assert 0 <= it.counts.dropped_bytes <= len(data)

    return Reader(name, read, seeds)


# u-blox, navigation messages, RTCM


def _ubx_seeds() -> list[bytes]:
    return [STREAM, *recorded("gnss/nhm.ubx", (0, 6000), (100_000, 6000))]


def _ubx_messages(data: bytes) -> None:
    """The bytes as payloads of the messages that are read, in frames that are whole."""
    driver = UbloxReceiver()
    driver.feed(_TIME, 0)
    for message in (RXM_RAWX, RXM_SFRBX, NAV_PVT):
        driver.feed(ubx.frame(message, data[:8000]), 0)


def _ubx_payloads() -> list[bytes]:
    pieces = [(eph.satellite, words) for eph in (*SOME.values(), GLONASS) for words in pieces_of(eph)]
    subframes = [pack_sfrbx(NavigationBits(name, SIGNAL[name[0]], 0, words)) for name, words in pieces]
    return [pack_rawx(EPOCH), pack_pvt(SOLUTION, 18), *subframes]


_TIME = ubx.frame(RXM_RAWX, struct.pack("<dHbBBBxx", 200_000.0, 2370, 18, 0, 1, 1))


def _navigation_bits(data: bytes) -> None:
    """The bytes as messages whose parity and CRC are right: what is behind the checks."""
    bits = int.from_bytes(data[:400], "big")
    subframes, pages, strings = (split(bits, 3, 300), split(bits, 10, 300), split(bits, 4, 85))
    lnav.ephemeris(subframes, "G05", SENT_NS)
    lnav.ionosphere(subframes[0], "G", SENT_NS)
    inav.ephemeris(split(bits, 5, 128), "E12", SENT_NS)
    beidou_d1_d2.ephemeris(subframes, "C21", SENT_NS)
    beidou_d1_d2.ephemeris(pages, "C03", SENT_NS)
    beidou_d1_d2.place(pages[0], "D2")
    glonass_strings.ephemeris(strings, "R07", 5, SENT_NS, 18)


def _rtcm(data: bytes) -> None:
    passing = rtcm.RtcmFilter()
    out = b"".join(passing.feed(data[:1000]) + passing.feed(data[1000:]))
    assert len(out) + passing.counts.dropped_bytes <= passing.counts.received_bytes == len(data)


def _msm(data: bytes) -> None:
    """The bytes as messages of a base station in frames that are whole."""
    driver = RtcmReceiver(near_ns=SENT_NS)
    for number in (1005, 1006, 1074, 1085, 1096, 1117, 1127):
        driver.feed(rtcm.frame(bytes([number >> 4, (number & 15) << 4 | data[0] & 15 if data else 0]) + data[1:900]), 0)


def _base_seeds() -> list[bytes]:
    return [b"".join(map(rtcm.frame, MsmWriter().messages(EPOCH)))]


_GNSS = (
    of_driver("base", lambda: RtcmReceiver(near_ns=SENT_NS), _base_seeds),
    Reader("msm", _msm, lambda: [message[1:] for message in MsmWriter().messages(EPOCH)]),
    of_driver("ubx", UbloxReceiver, _ubx_seeds),
    Reader("ubx messages", _ubx_messages, _ubx_payloads),
    Reader("navigation bits", _navigation_bits, lambda: [bytes(range(250)), bytes(400)]),
    Reader("rtcm", _rtcm, lambda: [rtcm.frame(b"\x43\x50" + bytes(range(n))) * 3 for n in (0, 20, 250)]),
)

# All


def read_recording(data: bytes) -> None:
    with tempfile.NamedTemporaryFile(suffix=".mcap") as file:
        file.write(data)
        file.flush()
        try:
            recording = Recording(Path(file.name))
        except SourceError:
            return
        for _ in recording.messages():
            pass
        assert len(recording.problems) <= MAX_PROBLEMS
        recording.close()


def recordings() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.mcap"
        write(path, flight(30))
        return [path.read_bytes()]


def read_rinex(data: bytes) -> None:
    """As navigation, as observations and as precise orbits: a damaged header may call a file anything."""
    text = data.decode("ascii", "replace").splitlines()
    for messages in (read_navigation(Lines(text)), read_observations(Lines(text), {}, "gnss"), read_sp3(Lines(text))):
        for _ in messages:
            pass


def rinex_seeds() -> list[bytes]:
    return [
        NAVIGATION.encode(),
        OLD_OBSERVATIONS.encode(),
        *recorded("gnss/matrtklib_static/rover.obs", (0, 12_000)),
        *recorded("comma2k19/Sta20124_excerpt_GPS.sp3.txt", (0, 2000)),
    ]


def xbus_seeds() -> list[bytes]:
    values = (0.1, 0.2, 0.3, 0.4)
    counts = {DataId.SAMPLE_TIME_FINE: 3, DataId.SAMPLE_TIME_COARSE: 2, DataId.PACKET_COUNTER: 1}
    reals: dict[int, tuple[float, ...]] = {
        DataId.ACCELERATION: values[:3],
        DataId.RATE_OF_TURN: values[:3],
        DataId.DELTA_V: values[:3],
        DataId.DELTA_Q: values,
        DataId.QUATERNION: values,
        DataId.TEMPERATURE: values[:1],
    }
    packets = reals | {identifier: (count,) for identifier, count in counts.items()}
    made = [xbus.frame(xbus.MessageId.MT_DATA2, pack(packets, precision)) for precision in Precision]
    answers = XsensImu().start() + xbus.frame(xbus.MessageId.ERROR, b"!") + xbus.frame(0x99, bytes(300))
    recording = "xsens/20260503_204234_xsensmti_with_gnss_recording.bin"
    return [b"".join(made), answers, *recorded(recording, (0, 3000), (200_000, 3000))]


def mavlink_seeds() -> list[bytes]:
    """Links and logs; the driver is told which is which, and must survive the other."""
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    link = b"".join(
        message.pack(sender)
        for message in (
            mavlink.MAVLink_heartbeat_message(2, 3, 0x81, 5, 4, 3),
            mavlink.MAVLink_attitude_message(5, 0.1, 0.2, 0.3, 0, 0, 0),
            mavlink.MAVLink_global_position_int_message(9, 476_000_000, 80_000_000, 500_000, 40_000, 1, 2, 3, 4),
            mavlink.MAVLink_statustext_message(4, b"hello", 7, 0),
        )
    )
    stamped = (1_533_430_795_000_000).to_bytes(8, "big") + link[:21]
    return [link, stamped * 3, *recorded("cuav/testimgs/flight.tlog", (0, 4000), (400_000, 4000))]


_ALL: tuple[Reader, ...] = (
    of_driver("xbus", XsensImu, xbus_seeds),
    of_driver("mavlink", MavlinkVehicle, mavlink_seeds),
    of_driver("tlog", partial(MavlinkVehicle, stamps=Stamps.TLOG), mavlink_seeds),
    Reader("mcap", read_recording, recordings),
    *_GNSS,
    Reader("rinex", read_rinex, rinex_seeds),
    Reader("gpmf", read_gpmf, gpmf_seeds),
    Reader("dataflash", read_dataflash, dataflash_seeds),
    Reader("ulog", partial(read_file, "ulog"), ulog_seeds),
    Reader("bag", partial(read_file, "bag"), bag_seeds),
)

READERS = {reader.name: reader for reader in _ALL}
