"""From a photo's arrival to its tiles in a browser: a real aircraft process, a real ground, a real Chromium.

    python tests/benchmarks/bench_live.py photos:DIR --every 2

A photo arrives when the pace of its source says so, whether or not the aircraft has time for it then. Its tiles are
those of the first update that follows from it; it is shown when the last of them came through the browser's socket.
"""

from __future__ import annotations

import argparse
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from browser import Browser, chromium  # noqa: E402

from air.sources.source import open_photos  # noqa: E402
from common.bus import BusConfig, ZenohBus  # noqa: E402
from common.config import parse  # noqa: E402
from common.keys import all_of  # noqa: E402
from common.messages import MapTile, TileId  # noqa: E402
from common.streams import TILE  # noqa: E402
from common.wire import decode  # noqa: E402
from ground.config import GroundConfig  # noqa: E402
from ground.serve import running  # noqa: E402
from ground.viewer.tiles import TileShown  # noqa: E402

BRIGHTON = ROOT.parent / "shared" / "data" / "brighton_beach" / "images"
SENT = re.compile(r"(\S+): \d+ keyframes and (\d+) tiles sent")
ENDED = "the source has ended"
PATIENCE_S = 300.0


@dataclass
class Log:
    """What the aircraft said, each line with the time at which it was read."""

    lines: list[tuple[float, str]] = field(default_factory=list)

    def follow(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self.lines.append((time.monotonic(), line.rstrip()))

    def when(self, text: str) -> float | None:
        return next((t for t, line in self.lines if text in line), None)

    def tiles_of(self) -> dict[str, tuple[float, int]]:
        """By photo: when its tiles had left the aircraft, and how many there were."""
        found = ((t, SENT.search(line)) for t, line in self.lines)
        return {match[1]: (t, int(match[2])) for t, match in found if match}


@dataclass(frozen=True)
class Row:
    """One photo: its tiles, and s after its arrival when they had left the aircraft and were in the browser."""

    name: str
    tiles: int
    sent: float
    first: float
    last: float


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def aircraft(source: str, pace: float, endpoint: str, folder: Path) -> Iterator[Log]:
    config = folder / "air.toml"
    config.write_text(f'pace = {pace}\n[bus]\nconnect = ["{endpoint}"]\nshared_memory = false\n')
    command = [sys.executable, "-m", "air", "run", "--config", str(config), "--source", source]
    log = Log()
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        threading.Thread(target=log.follow, args=(process,), daemon=True).start()
        try:
            yield log
        finally:
            process.terminate()


def measure(source: str, every_s: float, screenshot: Path | None) -> list[Row]:
    photos = [(photo.name, photo.t_ns) for photo in open_photos(source)]
    spacing_s = np.diff([t_ns for _, t_ns in photos]).mean() * 1e-9
    pace = float(spacing_s / every_s)
    published: list[MapTile] = []
    shown: list[TileShown] = []

    def note(_key: str, payload: bytes) -> None:
        published.append(decode(MapTile, payload))

    with tempfile.TemporaryDirectory() as folder:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        settings = {
            "bus": {"listen": [endpoint], "shared_memory": False},
            "store": {"path": f"{folder}/ground.sqlite"},
            "viewer": {"port": free_port()},
        }
        with running(parse(settings, GroundConfig)) as viewer:
            assert viewer is not None
            viewer.on_tile_shown(shown.append)
            bus = ZenohBus(BusConfig("client", connect=(endpoint,), shared_memory=False))
            bus.subscribe(all_of(TILE), note)
            with chromium(viewer.url, 960, 600) as browser:
                browser.wait(5.0)
                with aircraft(source, pace, endpoint, Path(folder)) as log:
                    log_time = _watch(browser, log)
                    if screenshot is not None:
                        browser.screenshot(screenshot)
                begun_s = log.when(f"{photos[0][0]} arrived")
                assert begun_s is not None, "\n".join(line for _, line in log.lines)
                due_s = {name: begun_s + (t_ns - photos[0][1]) * 1e-9 / pace for name, t_ns in photos}
                names = _nodes(browser)
            bus.close()
    print(f"{len(photos)} photos, one in {every_s:g} s on average, {log_time - begun_s:.0f} s until all was done")
    sent = log.tiles_of()
    rows = (
        _row(name, t_ns, due_s[name], *sent[name], published, shown, names) for name, t_ns in photos if name in sent
    )
    return [row for row in rows if row is not None]


def _watch(browser: Browser, log: Log) -> float:
    """Let the page run until the aircraft is done and what it sent was shown; when that was."""
    deadline_s = time.monotonic() + PATIENCE_S
    while log.when(ENDED) is None:
        assert time.monotonic() < deadline_s, "\n".join(line for _, line in log.lines[-20:])
        browser.wait(0.05)
    done_s = time.monotonic()
    browser.wait(5.0)
    return done_s


def _nodes(browser: Browser) -> dict[TileId, list[float]]:
    """When each tile came through the web socket, s."""
    times: dict[TileId, list[float]] = {}
    for frame in browser.frames:
        for message in frame.messages():
            name = str(message.get("name", ""))
            if message["type"].endswith("PointCloudMessage") and name.startswith("/map/"):
                level, x, y = map(int, name.rsplit("/", 1)[1].split("_"))
                times.setdefault(TileId(level, x, y), []).append(frame.monotonic_ns * 1e-9)
    return times


def _row(
    name: str,
    t_ns: int,
    due_s: float,
    sent_s: float,
    count: int,
    published: list[MapTile],
    shown: list[TileShown],
    nodes: dict[TileId, list[float]],
) -> Row | None:
    """The figures of one photo; None for one that changed no tile."""
    its: dict[TileId, MapTile] = {}
    for tile in published:
        if tile.t_ns == t_ns and len(its) < count:
            its.setdefault(tile.id, tile)
    visible = [tile for tile in its.values() if np.isfinite(tile.height).any()]
    arrivals = [_arrival(tile, shown, nodes) for tile in visible]
    if not arrivals:
        return None
    return Row(name, len(arrivals), sent_s - due_s, min(arrivals) - due_s, max(arrivals) - due_s)


def _arrival(tile: MapTile, shown: list[TileShown], nodes: dict[TileId, list[float]]) -> float:
    """When this revision of a tile, or a later one, was in the browser."""
    handed = [s.monotonic_ns * 1e-9 for s in shown if s.id == tile.id and s.revision >= tile.revision]
    # The frame may be noted a moment before the callback returns.
    return min((t for t in nodes.get(tile.id, []) if handed and t > min(handed) - 0.05), default=float("inf"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default=f"photos:{BRIGHTON}")
    parser.add_argument("--every", type=float, default=2.0, metavar="S", help="mean time between photos")
    parser.add_argument("--screenshot", type=Path, metavar="PNG")
    args = parser.parse_args()
    rows = measure(args.source, args.every, args.screenshot)
    print(f"{'photo':16} tiles  sent s  first tile s  last tile s")
    for row in rows:
        print(f"{row.name:16} {row.tiles:5} {row.sent:7.2f} {row.first:13.2f} {row.last:12.2f}")
    last = np.array([row.last for row in rows])
    print(f"arrival to browser: p50 {np.median(last):.2f}, p95 {np.quantile(last, 0.95):.2f}, max {last.max():.2f} s")


if __name__ == "__main__":
    main()
