"""A base station's measurements, from its receiver's link at the ground over the radio to the odometry on board."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from bus_network import free_endpoint, peer_of, router_at, settle, wait_until
from gnss_scene import BASE_ECEF
from rtcm_samples import measured, sent

from air.gnss.msm_writer import MsmWriter
from air.sensing import Sensing
from air.sources.known import Known
from air.sources.simulated.survey import START_NS
from common import rtcm
from common.clock import SystemClock
from common.config import parse
from common.errors import ConfigError
from common.geo import ecef_to_geodetic
from common.keys import stream_key
from common.measurements import FixKind, GnssEpoch, Measurement, RawBytes, ReceiverSolution
from common.streams import RTCM
from common.wire import encode
from ground.config import CorrectionsConfig, GroundConfig
from ground.corrections import Corrections, CorrectionsNode

SECONDS = 12.0
FRAMES = [frame for _, frame in sent(SECONDS)]


def numbers(data: bytes) -> list[int]:
    return [rtcm.message_number(frame) for frame in rtcm.RtcmFilter().feed(data)]


# What is sent


def test_measurements_go_out_once_a_second_whatever_the_receiver_sends() -> None:
    """All systems of the same instant; the place every ten seconds."""
    writer, corrections, out = MsmWriter(), Corrections(), b""
    for i in range(100):
        epoch = replace(measured(1.0)[0], t_ns=START_NS + i * 100_000_000)
        data = b"".join(rtcm.frame(m) for m in (rtcm.pack_place(1, BASE_ECEF), *writer.messages(epoch)))
        out += corrections.feed(b"stray" + data, epoch.t_ns)
    told = numbers(out)
    assert [told.count(n) for n in (1077, 1087, 1097, 1127, 1006)] == [10, 10, 10, 10, 1]
    assert corrections.filter.counts.dropped_bytes == 500


def test_a_second_fits_a_slow_radio() -> None:
    """Of 115 kbit/s a tenth: four systems, 80 signals."""
    passed = Corrections().feed(b"".join(FRAMES), 0)
    assert 0.5e3 < len(passed) / SECONDS < 1.44e3


def test_a_surveyed_place_replaces_the_receivers_own() -> None:
    surveyed = BASE_ECEF + (1.0, 2.0, 3.0)
    passed = rtcm.RtcmFilter().feed(Corrections(surveyed).feed(b"".join(FRAMES), 0))
    (place,) = (p for frame in passed if (p := rtcm.parse_place(rtcm.payload_of(frame))) is not None)
    np.testing.assert_allclose(place, surveyed, atol=1e-4)
    assert rtcm.station_of(rtcm.payload_of(passed[0])) == rtcm.station_of(rtcm.payload_of(passed[1]))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"url": "nowhere"}, "corrections.url is 'nowhere'"),
        ({"position": [30.5, 114.3]}, "corrections.position is [30.5, 114.3]"),
        ({"position": [114.3, 30.5, 62.0]}, "corrections.position is [114.3, 30.5, 62.0]"),
        ({"vehicle": "a/b"}, "corrections.vehicle is 'a/b'"),
    ],
)
def test_impossible_settings_are_named(wrong: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match="allowed") as refused:
        parse({"corrections": wrong}, GroundConfig)
    assert said in str(refused.value)


# The whole way


class Station:
    """A base station's receiver on a TCP port, which sends what it is told to."""

    def __init__(self) -> None:
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"tcp:127.0.0.1:{self._listening.getsockname()[1]}"
        self._link: socket.socket | None = None
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                self._link, _ = self._listening.accept()
            except OSError:
                return

    def say(self, data: bytes) -> None:
        wait_until(lambda: self._link is not None)
        assert self._link is not None
        self._link.sendall(data)

    def hang_up(self) -> None:
        assert self._link is not None
        self._link.close()
        self._link = None

    def close(self) -> None:
        self._listening.close()
        if self._link is not None:
            self._link.close()


class Receiver:
    """The devices on board: a receiver that knows the time, and takes corrections."""

    def __init__(self) -> None:
        self.known, self.taken, self.told = Known(), b"", threading.Event()
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Measurement]:
        nan, unknown = float("nan"), np.full(3, np.nan)
        yield ReceiverSolution(START_NS, "gnss", FixKind.TIME_ONLY, nan, nan, nan, nan, nan, unknown, nan, nan, 0)
        self.told.set()
        self._closed.wait()

    def statuses(self) -> list[object]:
        return []

    def correct(self, data: bytes) -> None:
        self.taken += data

    def close(self) -> None:
        self._closed.set()


class Way:
    """Ground and aircraft, joined by a Zenoh session each."""

    def __init__(self, position: tuple[float, ...] = ()) -> None:
        endpoint = free_endpoint()
        self.station, self.devices, self.heard = Station(), Receiver(), list[Measurement]()
        self.ground, self.air = router_at(endpoint), peer_of(endpoint)
        self.node = CorrectionsNode(CorrectionsConfig(self.station.url, position=position), self.ground, SystemClock())
        sensing = Sensing(self.devices, self.air, "uav1", SystemClock(), self.heard.append)  # type: ignore[arg-type]
        self._flying = threading.Thread(target=sensing.run, daemon=True)
        self._flying.start()
        self.devices.told.wait(5.0)
        settle(self.ground, self.air)
        self.node.start()

    @property
    def epochs(self) -> list[GnssEpoch]:
        return [m for m in self.heard if isinstance(m, GnssEpoch)]

    def close(self) -> None:
        self.node.close()
        self.devices.close()
        self._flying.join(5.0)
        self.station.close()
        self.air.close()
        self.ground.close()


@pytest.fixture
def way() -> Iterator[Way]:
    it = Way()
    yield it
    it.close()


def test_what_a_base_measures_reaches_receiver_and_odometry(way: Way) -> None:
    """All that is whole; damage stays at the ground."""
    damaged = bytearray(FRAMES[4])
    damaged[20] ^= 1
    way.station.say(b"noise" + bytes(damaged) + b"".join(FRAMES))
    wait_until(lambda: way.devices.taken.endswith(FRAMES[-1]))
    assert b"noise" not in way.devices.taken
    assert bytes(damaged) not in way.devices.taken
    wait_until(lambda: len(way.epochs) == SECONDS)
    for epoch, told in zip(way.epochs, measured(SECONDS), strict=True):
        assert (epoch.receiver, epoch.t_ns) == ("base", round(told.t_ns, -6))
        assert len(epoch.satellites) == len(told.satellites)
        assert epoch.p_ecef is not None
        np.testing.assert_allclose(epoch.p_ecef, BASE_ECEF, atol=1e-4)


def test_a_link_that_was_lost_is_read_again(way: Way) -> None:
    way.station.say(FRAMES[1])
    wait_until(lambda: bool(way.devices.taken))
    way.station.hang_up()
    way.station.say(b"".join(FRAMES[5:]))
    wait_until(lambda: way.devices.taken.endswith(FRAMES[-1]))


def test_a_receiver_that_speaks_something_else_is_told(way: Way, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    way.station.say(b"$GNGGA,090000.00,3032.13,N,11421.93,E,1,12,0.7,62.0,M,,M,,*5C\r\n" * 300)
    wait_until(lambda: "no RTCM 3 arrives" in caplog.text)
    way.station.say(FRAMES[1])
    wait_until(lambda: "is read again" in caplog.text)


def test_what_is_no_correction_is_refused(way: Way) -> None:
    key = stream_key("uav1", RTCM)
    for payload in (b"\x93", encode(RawBytes(1, "base", b"\xd3\x00\x13 no frame"))):
        way.ground.publish(key, payload, RTCM)
    wait_until(lambda: bool(way.devices.taken))
    assert way.epochs == []


def test_a_surveyed_position_arrives_instead_of_the_receivers() -> None:
    """1e-9 degrees are 0.1 mm."""
    surveyed = BASE_ECEF + (3.0, 0.0, 0.0)
    way = Way(tuple(round(float(x), 9) for x in ecef_to_geodetic(surveyed)))
    try:
        way.station.say(b"".join(FRAMES))
        wait_until(lambda: len(way.epochs) == SECONDS)
        for epoch in way.epochs:
            np.testing.assert_allclose(epoch.p_ecef, surveyed, atol=3e-4)  # type: ignore[arg-type]
    finally:
        way.close()
