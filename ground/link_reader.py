"""A link to a device at the ground, read for ever: one that breaks is opened again."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from common.errors import BusError, DeviceError
from common.link import Link, open_link

log = logging.getLogger(__name__)

RETRY_S = 1.0


class LinkReader:
    """A thread that hands what a link says to whoever takes it, and logs once what is wrong."""

    def __init__(
        self,
        name: str,
        url: str,
        baud: int,
        take: Callable[[bytes], bool],
        open_it: Callable[[str, int], Link] = open_link,
    ) -> None:
        """`take` says whether the bytes made sense; it may raise BusError."""
        self._name, self._url, self._baud, self._take, self._open_it = name, url, baud, take, open_it
        self._fault = ""
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin to read, as soon as the link is there."""
        self._thread.start()

    def close(self) -> None:
        """Stop and let go of the link."""
        self._stopped.set()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                link = self._open_it(self._url, self._baud)
            except DeviceError as error:
                self._note(str(error))
            else:
                try:
                    self._read(link)
                except OSError as error:
                    self._note(f"{self._url}: {error.strerror or error}")
                finally:
                    link.close()
            self._stopped.wait(RETRY_S)

    def _read(self, link: Link) -> None:
        while not self._stopped.is_set():
            try:
                if self._take(link.read()):
                    self._note("")
            except BusError as error:
                self._note(str(error))

    def _note(self, fault: str) -> None:
        """Log what is wrong, or that nothing is any more."""
        if fault != self._fault:
            self._fault = fault
            if fault:
                log.warning("%s: %s", self._name, fault)
            else:
                log.info("%s: %s is read again", self._name, self._url)
