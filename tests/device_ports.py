"""Virtual serial ports with a stable name, as udev would give it, and what is played into them."""

from __future__ import annotations

import contextlib
import os
import pty
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

import numpy as np

from air.sensors.driver import Counts, TimeScale
from common.measurements import FixKind, Measurement, ReceiverSolution


class VirtualPort:
    """A pty behind a symbolic link that stays the same when the device is pulled out and put in again."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.sent = 0
        self._ends: tuple[int, int] | None = None
        self._lock = threading.Lock()

    def plug(self) -> None:
        master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        with self._lock:
            self._ends = master, slave
            self.link.symlink_to(os.ttyname(slave))

    def unplug(self) -> None:
        with self._lock:
            self.link.unlink()
            for end in self._ends or ():
                os.close(end)
            self._ends = None

    def send(self, data: bytes) -> None:
        """Bytes from the device; lost while nobody reads, as on a wire."""
        with self._lock, contextlib.suppress(BlockingIOError):
            if self._ends is not None:
                self.sent += os.write(self._ends[0], data)

    def sent_by_host(self) -> bytes:
        with self._lock, contextlib.suppress(BlockingIOError):
            return os.read(self._ends[0], 65_536) if self._ends is not None else b""
        return b""


class Player:
    """Plays chunks of (seconds, bytes) into a port at real rate, over and over."""

    def __init__(self, port: VirtualPort, chunks: list[tuple[float, bytes]]) -> None:
        self._port, self._chunks = port, chunks
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopped.is_set():
            begun_s = time.monotonic()
            for at_s, data in self._chunks:
                if self._stopped.wait(max(0.0, begun_s + at_s - time.monotonic())):
                    return
                self._port.send(data)


def evenly(data: bytes, duration_s: float, step_s: float = 0.01) -> list[tuple[float, bytes]]:
    """A recording cut into equal pieces, at its mean rate."""
    steps = round(duration_s / step_s)
    cuts = [len(data) * i // steps for i in range(steps + 1)]
    return [(i * step_s, data[cuts[i] : cuts[i + 1]]) for i in range(steps)]


class LineDriver:
    """A tiny protocol: a line is `#` and a number, which is seconds of GPST."""

    device = "gnss"
    scale = TimeScale.GNSS

    def __init__(self) -> None:
        self.counts = Counts()
        self.sent_ns = 0
        self._held = b""

    @property
    def faults(self) -> tuple[str, ...]:
        return ()

    def start(self) -> bytes:
        return b"go\n"

    def feed(self, data: bytes, t_ns: int) -> list[Measurement]:
        self.counts.received_bytes += len(data)
        self.sent_ns = t_ns
        *lines, self._held = (self._held + data).split(b"\n")
        self._held = self._held[-100:]
        found: list[Measurement] = []
        for line in lines:
            if line[:1] == b"#" and line[1:].isdigit():
                self.counts.frames["line"] += 1
                found.append(solution(int(line[1:]) * 1_000_000_000))
            else:
                self.counts.dropped_bytes += len(line) + 1
        return found


def solution(t_ns: int) -> ReceiverSolution:
    return ReceiverSolution(t_ns, "gnss", FixKind.FIX_3D, 30.5, 114.3, 40.0, 1.0, 2.0, np.zeros(3), 0.1, 1e-8, 12)


def wait_for(condition: Callable[[], bool], timeout_s: float) -> float:
    """Seconds until the condition held."""
    begun_s = time.monotonic()
    while not condition():
        assert time.monotonic() - begun_s < timeout_s, f"not within {timeout_s} s"
        time.sleep(0.01)
    return time.monotonic() - begun_s
