"""A device that sends bytes: its link is opened, set up, read, watched, and opened again when it was lost."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from air.devices.settings import PortConfig
from air.devices.status import DeviceStatus, State, Watch
from air.sensors.driver import Driver, TimeScale
from common.errors import DeviceError
from common.link import Link, open_link
from common.measurements import Measurement, RawBytes

log = logging.getLogger(__name__)

RATES = (115_200, 38_400, 57_600, 9_600, 230_400, 460_800, 921_600, 19_200, 2_000_000)
"""Baud rates that are tried when nothing decodes, the most common first."""
LISTEN_S = 0.6
"""How long each is listened to."""
PROBE_AGAIN_S = 20.0
RETRY_S = (0.1, 0.2, 0.4, 0.8)
"""Waits between attempts to open, the last one for ever: a device that comes back is read within two seconds."""
OUTGOING = 100
"""Writes that may wait: old corrections are worth nothing."""
START_AGAIN_S = 5.0
"""A device that was switched off and on has forgotten its set-up: one that is silent is set up again."""


@dataclass(frozen=True)
class Arrival:
    """What a device gave at once.

    `arrival_ns` is the host's monotonic time when the last of it came, `sent_ns` when it was sent at the latest.
    """

    device: str
    scale: TimeScale
    arrival_ns: int
    sent_ns: int
    measurements: list[Measurement]


Take = Callable[[Arrival], None]


class Port:
    """A thread that keeps a driver fed from its port. `take` is called on that thread."""

    def __init__(
        self,
        driver: Driver,
        config: PortConfig,
        take: Take,
        open_it: Callable[[str, int], Link] = open_link,
    ) -> None:
        self._driver, self._config, self._take, self._open_it = driver, config, take, open_it
        self._watch = Watch(driver.device, config.port)
        self._baud = config.baud
        self._probed_s = self._set_up_s = -float("inf")
        self._said = ""
        self._outgoing: deque[bytes] = deque(maxlen=OUTGOING)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=driver.device, daemon=True)

    @property
    def device(self) -> str:
        """Name of the device."""
        return self._driver.device

    def start(self) -> None:
        """Begin to read, as soon as the device is there."""
        self._thread.start()

    def close(self) -> None:
        """Stop and let go of the port."""
        self._stopped.set()
        self._thread.join(1.0)

    def status(self) -> DeviceStatus:
        """How the device is doing now."""
        seen = self._driver.counts
        counts = {
            "received_bytes": seen.received_bytes,
            "dropped_bytes": seen.dropped_bytes,
            "bursts": seen.bursts,
            "refused": seen.refused,
            "frames": seen.frames.total(),
        }
        status = self._watch.status(time.monotonic(), counts)
        return status if status.fault else replace(status, fault="; ".join(self._driver.faults))

    def send(self, data: bytes) -> None:
        """Write to the device as soon as may be; while it is gone, what is to be written is lost."""
        self._outgoing.append(data)

    def _run(self) -> None:
        failed = 0
        while not self._stopped.is_set():
            try:
                link = self._open_it(self._config.port, self._baud)
            except DeviceError as error:
                self._lost(str(error).removeprefix(f"{self._config.port}: "))
            else:
                failed = 0
                self._use(link)
            self._stopped.wait(RETRY_S[min(failed, len(RETRY_S) - 1)])
            failed += 1

    def _use(self, link: Link) -> None:
        """Read until the device is gone or nobody wants to read any more."""
        self._watch.opened(time.monotonic())
        self._outgoing.clear()
        self._say(f"{self._config.port} is open")
        try:
            self._set_up(link)
            while not self._stopped.is_set():
                self._read(link)
                self._write(link)
                self._look_after(link)
        except OSError as error:
            self._lost(f"was lost: {' '.join(str(error).split())}; waiting for it to come back")
        except Exception:  # a fault of ours: the other devices go on, and this one begins anew
            log.exception("%s: reading failed", self._driver.device)
            self._lost("reading failed by a fault in the program; the log tells more")
        finally:
            link.close()

    def _read(self, link: Link) -> None:
        data = link.read()
        if not data:
            return
        counts, arrival_ns = self._driver.counts, time.monotonic_ns()
        frames, dropped = counts.frames.total(), counts.dropped_bytes
        measurements = self._driver.feed(data, arrival_ns)
        frames, dropped = counts.frames.total() - frames, counts.dropped_bytes - dropped
        kinds = [type(measurement).__name__ for measurement in measurements]
        self._watch.received(arrival_ns * 1e-9, len(data), frames, dropped, kinds)
        raw = RawBytes(arrival_ns, self._driver.device, data)
        driver = self._driver
        self._take(Arrival(driver.device, driver.scale, arrival_ns, driver.sent_ns, [raw, *measurements]))

    def _write(self, link: Link) -> None:
        while self._outgoing:
            link.write(self._outgoing.popleft())

    def _look_after(self, link: Link) -> None:
        """Help a device that is open but gives nothing."""
        now_s = time.monotonic()
        state = self._watch.state(now_s)
        if state is State.SILENT and now_s - self._set_up_s > START_AGAIN_S:
            self._set_up(link)
        elif state is State.GARBLED and now_s - self._probed_s > PROBE_AGAIN_S:
            self._probe(link)
        self._say(self._watch.status(now_s, {}).fault)

    def _set_up(self, link: Link) -> None:
        self._set_up_s = time.monotonic()
        if data := self._driver.start():
            link.write(data)

    def _probe(self, link: Link) -> None:
        """Listen at other baud rates, and stay at the first one at which frames decode."""
        wrong = self._baud
        for baud in dict.fromkeys((*RATES, self._config.baud)):
            if baud == wrong or not link.set_baud(baud):
                continue
            if self._decodes(link):
                self._baud = baud
                right = baud == self._config.baud
                self._watch.note(
                    "" if right else f"wrong baud rate: {self._config.baud} is set, but it sends at {baud}"
                )
                self._set_up(link)
                return
        if link.set_baud(self._config.baud):
            self._baud = self._config.baud
            self._watch.note(
                f"bytes arrive but no frame decodes at {wrong} baud nor at any usual rate: another device?"
            )
        self._watch.restart(time.monotonic())
        self._probed_s = time.monotonic()

    def _decodes(self, link: Link) -> bool:
        self._watch.restart(time.monotonic())
        until_s = time.monotonic() + LISTEN_S
        while time.monotonic() < until_s and not self._stopped.is_set():
            self._read(link)
        return self._watch.decodes(time.monotonic())

    def _lost(self, text: str) -> None:
        self._watch.closed(text)
        self._say(text)

    def _say(self, text: str) -> None:
        """Log what has changed."""
        if text and text != self._said:
            log.log(logging.INFO if text.endswith("is open") else logging.WARNING, "%s: %s", self._driver.device, text)
        self._said = text
