"""Reading and preparing photos ahead of the one in work, so that both cores are busy."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from air.alignment.prepare import PreparedPhoto, prepare
from air.alignment.settings import AlignmentSettings
from air.jump import Jump
from common.messages import Photo

AHEAD = 6
WORKERS = 2
Waiting = Future[PreparedPhoto] | Jump | BaseException | None


def prepared(photos: Iterable[Photo | Jump], settings: AlignmentSettings) -> Iterator[PreparedPhoto | Jump]:
    """The photos in their order, each prepared by a pool of threads while earlier ones are worked on; jumps between.

    At most a few are held at a time, so a long flight needs no more memory. An error of the source is raised here.
    """
    waiting: queue.Queue[Waiting] = queue.Queue(AHEAD)
    stop = threading.Event()
    with ThreadPoolExecutor(WORKERS, "prepare") as pool:

        def read() -> None:
            try:
                for photo in photos:
                    item = photo if isinstance(photo, Jump) else pool.submit(prepare, photo, settings)
                    if not _put(waiting, item, stop):
                        return
                _put(waiting, None, stop)
            except BaseException as error:
                _put(waiting, error, stop)

        reader = threading.Thread(target=read, name="reader", daemon=True)
        reader.start()
        try:
            while (item := waiting.get()) is not None:
                if isinstance(item, BaseException):
                    raise item
                yield item if isinstance(item, Jump) else item.result()
        finally:
            stop.set()
            reader.join()


def _put(waiting: queue.Queue[Waiting], item: Waiting, stop: threading.Event) -> bool:
    while not stop.is_set():
        try:
            waiting.put(item, timeout=0.1)
        except queue.Full:
            continue
        return True
    return False
