"""A real Chromium on a page: pictures of it, and what its web socket received when, as the browser itself reports."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
import pytest
import zstandard

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--no-first-run",
]


@dataclass(frozen=True)
class Frame:
    """One web socket frame that the browser received; `monotonic_ns` when this process learnt of it."""

    monotonic_ns: int
    payload: bytes

    def messages(self) -> list[dict[str, Any]]:
        """The viewer's messages in the frame: maps with `type` and mostly `name`; arrays are left out.

        viser's frame: sizes of the plain and of the compressed part (little-endian uint64), a zstd-compressed
        MessagePack part, then raw buffers.
        """
        size = int.from_bytes(self.payload[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(self.payload[16 : 16 + size])
        return list(_messages(msgpack.unpackb(inner, strict_map_key=False)))


def _messages(value: Any) -> Iterator[dict[str, Any]]:
    """Every map with a type that a value contains."""
    if isinstance(value, dict):
        if isinstance(value.get("type"), str):
            yield value
        else:
            for inner in value.values():
                yield from _messages(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _messages(inner)


class Browser:
    """One open page."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.frames: list[Frame] = []
        page.on("websocket", lambda ws: ws.on("framereceived", self._note))

    def wait(self, seconds: float) -> None:
        """Let the page run; its events are only noted while waiting here."""
        self.page.wait_for_timeout(seconds * 1000)

    def screenshot(self, path: Path | None = None) -> np.ndarray:
        """What the page looks like, (H, W, 3) uint8 RGB."""
        png = self.page.screenshot(path=path, timeout=120_000)
        return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])

    def text(self) -> str:
        """The text that the page shows."""
        return str(self.page.inner_text("body"))

    def received(self, node: str) -> list[Frame]:
        """The frames that brought a node of the scene whose name begins so."""
        return [f for f in self.frames if any(str(m.get("name", "")).startswith(node) for m in f.messages())]

    def _note(self, payload: bytes | str) -> None:
        if isinstance(payload, bytes):
            self.frames.append(Frame(time.monotonic_ns(), payload))


@contextmanager
def chromium(url: str, width: int = 1280, height: int = 800) -> Iterator[Browser]:
    """A page at a URL in a headless Chromium with software rendering; the test is skipped where there is none."""
    if not CHROMIUM.exists():
        pytest.skip("needs Debian's Chromium")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        program = driver.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        try:
            browser = Browser(program.new_page(viewport={"width": width, "height": height}))
            browser.page.goto(url)
            yield browser
        finally:
            program.close()
