"""Links to devices: a serial port, a TCP connection, a UDP socket, behind one face."""

from __future__ import annotations

import errno
import os
import select
import socket
import stat
import termios
from pathlib import Path
from typing import Protocol

import serial

from common.errors import DeviceError

READ_BYTES = 4096
WAIT_S = 0.05
"""A read returns after so long at the latest."""
CONNECT_S = 1.0


class Link(Protocol):
    """Bytes to and from a device. Reading and writing raise OSError when the device is gone."""

    def read(self) -> bytes:
        """What has come, after 50 ms at the latest; empty when nothing has."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes; at most half a second."""
        ...

    def set_baud(self, baud: int) -> bool:
        """Whether the link has a baud rate, which is then changed."""
        ...

    def close(self) -> None:
        """Let go of the device."""
        ...


def open_link(place: str, baud: int) -> Link:
    """The link to a place: a path, tcp:HOST:PORT or udp:HOST:PORT (listens there).

    Raises DeviceError, in one line, saying what is wrong with the place and what to do.
    """
    kind, _, address = place.partition(":")
    try:
        if kind not in ("tcp", "udp"):
            return _SerialLink(place, baud)
        host, _, port = address.rpartition(":")
        return _TcpLink(host, int(port)) if kind == "tcp" else _UdpLink(host, int(port))
    except (OSError, ValueError, OverflowError) as error:
        raise DeviceError(f"{place}: {explained(place, error)}") from error


class _SerialLink:
    def __init__(self, path: str, baud: int) -> None:
        # Our lock keeps a second program of ours from taking every other byte.
        self._port = serial.Serial(path, baud, timeout=WAIT_S, write_timeout=0.5, exclusive=True)

    def read(self) -> bytes:
        # All that is there at once: pyserial's own read would wait for a number of bytes, and take five system calls.
        if not select.select([self._port], [], [], WAIT_S)[0]:
            return b""
        data = os.read(self._port.fileno(), READ_BYTES)
        if not data:
            raise OSError(errno.EIO, "the device is gone")
        return data

    def write(self, data: bytes) -> None:
        self._port.write(data)

    def set_baud(self, baud: int) -> bool:
        try:
            self._port.baudrate = baud
            self._port.reset_input_buffer()
        except termios.error as error:
            raise OSError(*error.args) from error
        except ValueError:  # a rate that this chip does not have
            return False
        return True

    def close(self) -> None:
        self._port.close()


class _TcpLink:
    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), CONNECT_S)
        self._socket.settimeout(WAIT_S)

    def read(self) -> bytes:
        try:
            data = self._socket.recv(READ_BYTES)
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError(errno.ECONNRESET, "closed by the other side")
        return data

    def write(self, data: bytes) -> None:
        self._socket.sendall(data)

    def set_baud(self, baud: int) -> bool:
        return False

    def close(self) -> None:
        self._socket.close()


class _UdpLink:
    """Listens, and answers whoever spoke last."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError:
            self._socket.close()
            raise
        self._socket.settimeout(WAIT_S)
        self._peer: tuple[str, int] | None = None

    def read(self) -> bytes:
        try:
            data, self._peer = self._socket.recvfrom(65_536)
        except TimeoutError:
            return b""
        return data

    def write(self, data: bytes) -> None:
        if self._peer is not None:
            self._socket.sendto(data, self._peer)

    def set_baud(self, baud: int) -> bool:
        return False

    def close(self) -> None:
        self._socket.close()


def explained(place: str, error: Exception) -> str:
    """Why a place cannot be opened, in one line, and what to do."""
    number = getattr(error, "errno", None)
    if number in (errno.EBUSY, errno.EAGAIN, errno.EADDRINUSE):
        return "is held by another program; stop that program (luojia-air, gpsd, ModemManager)"
    if number in (errno.EACCES, errno.EPERM):
        return "permission denied; install the udev rules, or put the user into the group dialout"
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO):
        return "is not there; is the device plugged in, and are the udev rules installed?"
    if number == errno.ECONNREFUSED:
        return "nobody listens there"
    path = Path(place)
    if number == errno.ENOTTY or (place.startswith("/") and path.exists() and not stat.S_ISCHR(path.stat().st_mode)):
        return "is no serial port"
    return " ".join(str(error).split())
