"""Ports of devices: opened, watched, lost, found again; wrong rates and other people's locks are named."""

from __future__ import annotations

import fcntl
import itertools
import random
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from device_ports import LineDriver, VirtualPort, wait_for

from air.devices.port import Arrival, Port
from air.devices.settings import PortConfig
from air.devices.status import State
from common.errors import DeviceError
from common.link import open_link
from common.measurements import Measurement, RawBytes, ReceiverSolution


class Listener:
    def __init__(self) -> None:
        self.arrivals: list[Arrival] = []

    def take(self, arrival: Arrival) -> None:
        self.arrivals.append(arrival)

    def solutions(self) -> list[ReceiverSolution]:
        return [m for a in self.arrivals for m in a.measurements if isinstance(m, ReceiverSolution)]


@pytest.fixture
def port(tmp_path: Path) -> Iterator[VirtualPort]:
    virtual = VirtualPort(tmp_path / "luojia-gnss")
    virtual.plug()
    yield virtual
    if virtual.link.is_symlink():
        virtual.unplug()


def opened(virtual: VirtualPort, listener: Listener) -> Port:
    port = Port(LineDriver(), PortConfig(str(virtual.link), 115_200), listener.take)
    port.start()
    wait_for(lambda: port.status().state is not State.CLOSED, 2.0)
    return port


def test_a_device_is_set_up_and_its_bytes_become_measurements(port: VirtualPort) -> None:
    listener = Listener()
    reader = opened(port, listener)
    wait_for(lambda: port.sent_by_host() == b"go\n", 2.0)
    port.send(b"#1\n#2\nnoi")
    port.send(b"se\n#3\n")
    wait_for(lambda: len(listener.solutions()) == 3, 2.0)
    raw = b"".join(m.data for a in listener.arrivals for m in a.measurements if isinstance(m, RawBytes))
    status = reader.status()
    reader.close()
    assert raw == b"#1\n#2\nnoise\n#3\n"
    assert (status.state, status.fault, status.well) == (State.ALIVE, "", True)
    assert status.counts["dropped_bytes"] == 6
    assert status.age_s is not None
    assert status.age_s < 1.0


def test_a_device_that_was_pulled_out_is_read_again_within_two_seconds(port: VirtualPort) -> None:
    listener = Listener()
    reader = opened(port, listener)
    port.send(b"#1\n")
    wait_for(lambda: len(listener.solutions()) == 1, 2.0)
    port.unplug()
    wait_for(lambda: reader.status().state is State.CLOSED, 2.0)
    wait_for(lambda: "is not there" in reader.status().fault, 3.0)
    threading.Event().wait(1.5)  # the waits between attempts have grown to their longest
    port.plug()
    number = itertools.count(2)

    def read_again() -> bool:
        port.send(b"#%d\n" % next(number))
        return len(listener.solutions()) > 1

    took_s = wait_for(read_again, 5.0)
    assert took_s <= 2.0
    assert reader.status().counts["opened"] == 2
    reader.close()


def test_a_device_that_says_nothing_is_called_silent(port: VirtualPort) -> None:
    reader = opened(port, Listener())
    wait_for(lambda: reader.status().state is State.SILENT, 4.0)
    assert "silent: check power" in reader.status().fault
    reader.close()


class WireAt:
    """A link to a device that sends at one baud rate: at any other, garbage arrives."""

    def __init__(self, sends_at: int, baud: int) -> None:
        self._sends_at, self._baud = sends_at, baud
        self._random = random.Random(3)
        self._wait = threading.Event()

    def read(self) -> bytes:
        self._wait.wait(0.02)
        return b"#7\n" * 8 if self._baud == self._sends_at else self._random.randbytes(24)

    def write(self, data: bytes) -> None:
        pass

    def set_baud(self, baud: int) -> bool:
        self._baud = baud
        return True

    def close(self) -> None:
        pass


def test_a_wrong_baud_rate_is_named_with_the_right_one() -> None:
    listener = Listener()
    config = PortConfig("/dev/luojia-gnss", 9600)
    reader = Port(LineDriver(), config, listener.take, lambda _place, baud: WireAt(38_400, baud))
    reader.start()
    wait_for(lambda: "but it sends at" in reader.status().fault, 5.0)
    wait_for(lambda: reader.status().state is State.ALIVE, 2.0)
    status = reader.status()
    reader.close()
    assert status.fault == "wrong baud rate: 9600 is set, but it sends at 38400"
    assert not status.well
    assert listener.solutions()


def test_garbage_at_every_baud_rate_is_called_another_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("air.devices.port.LISTEN_S", 0.05)
    config = PortConfig("/dev/luojia-gnss", 9600)
    reader = Port(LineDriver(), config, Listener().take, lambda _place, baud: WireAt(1, baud))
    reader.start()
    wait_for(lambda: "another device?" in reader.status().fault, 6.0)
    assert "no frame decodes at 9600 baud nor at any usual rate" in reader.status().fault
    reader.close()


def test_a_port_held_by_another_program_is_named(port: VirtualPort) -> None:
    with port.link.open("rb", buffering=0) as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DeviceError, match=r"luojia-gnss: is held by another program; stop that program"):
            open_link(str(port.link), 9600)


def test_what_is_no_port_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"nothing: is not there; is the device plugged in"):
        open_link(str(tmp_path / "nothing"), 9600)
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match=r"file: is no serial port"):
        open_link(str(tmp_path / "file"), 9600)
    with pytest.raises(DeviceError, match=r"tcp:127.0.0.1:1: nobody listens there"):
        open_link("tcp:127.0.0.1:1", 9600)


def test_a_device_behind_an_address_is_read_as_well() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        address = probe.getsockname()
    listener = Listener()
    reader = Port(LineDriver(), PortConfig(f"udp:127.0.0.1:{address[1]}"), listener.take)
    reader.start()
    wait_for(lambda: reader.status().state is State.OPENED, 2.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b"#1\n#2\n", address)
        wait_for(lambda: len(listener.solutions()) == 2, 2.0)
    reader.close()

    with socket.create_server(("127.0.0.1", 0)) as server:
        reader = Port(LineDriver(), PortConfig(f"tcp:127.0.0.1:{server.getsockname()[1]}"), listener.take)
        reader.start()
        connection, _ = server.accept()
        assert connection.recv(10) == b"go\n"
        connection.sendall(b"#3\n")
        wait_for(lambda: len(listener.solutions()) == 3, 2.0)
        connection.close()  # and opened again
        connection, _ = server.accept()
        connection.sendall(b"#4\n")
        wait_for(lambda: len(listener.solutions()) == 4, 2.0)
        reader.close()
        connection.close()


def test_a_driver_that_fails_is_begun_anew_and_named() -> None:
    class Failing(LineDriver):
        def feed(self, data: bytes, t_ns: int) -> list[Measurement]:
            raise RuntimeError("a fault of ours")

    config = PortConfig("/dev/luojia-gnss", 9600)
    reader = Port(Failing(), config, Listener().take, lambda _place, baud: WireAt(9600, baud))
    reader.start()
    wait_for(lambda: reader.status().counts["opened"] >= 2, 3.0)
    wait_for(lambda: "a fault in the program" in reader.status().fault, 2.0)
    reader.close()
