"""A whole system on loopback: aircraft and grounds as processes, stopped and killed as their users would."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from bus_network import client_of, collect, free_endpoint, router_at, wait_until

from common.keys import all_of, parse_key
from common.messages import Keyframe, MapDigest, MapTile
from common.streams import DIGEST, KEYFRAME, TILE
from common.wire import decode
from ground.store import read_store

ROOT = Path(__file__).parent.parent
Held = dict[str, tuple[int, bytes]]


@dataclass
class Program:
    """One of our commands as a process; its output is appended to a file."""

    command: list[str]
    log: Path
    process: subprocess.Popen[bytes] = field(init=False)

    def __post_init__(self) -> None:
        with self.log.open("ab") as log:
            command = [sys.executable, "-m", *self.command]
            self.process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT)

    def said(self) -> str:
        return self.log.read_text(errors="replace")

    def stop(self, number: int = signal.SIGINT) -> tuple[int, float]:
        """Exit code and how long it took to end, s."""
        begun_s = time.monotonic()
        self.process.send_signal(number)
        return self.process.wait(timeout=20.0), time.monotonic() - begun_s


class LiveSystem:
    """Starts programs that find each other at one endpoint, and looks at what each of them holds of the map."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint = free_endpoint()
        self.programs: list[Program] = []

    def aircraft(self, source: str, pace: float) -> Program:
        config = self.folder / "air.toml"
        config.write_text(f'pace = {pace}\n[bus]\nconnect = ["{self.endpoint}"]\nshared_memory = false\n')
        return self._start(["air", "run", "--config", str(config), "--source", source], "air.log")

    def ground(self, name: str, mode: str = "router") -> Program:
        config, where = self.folder / f"{name}.toml", "listen" if mode == "router" else "connect"
        config.write_text(
            f'station = "{name}"\n'
            f'[bus]\nmode = "{mode}"\n{where} = ["{self.endpoint}"]\nshared_memory = false\n'
            f'[store]\npath = "{self.folder / name}.sqlite"\n[viewer]\nenabled = false\n'
        )
        return self._start(["ground", "serve", "--config", str(config)], f"{name}.log")

    def _start(self, command: list[str], log: str) -> Program:
        program = Program(command, self.folder / log)
        self.programs.append(program)
        return program

    def on_ground(self, name: str) -> Held:
        """Revision and bytes of every tile and keyframe in the store of a station, by the end of its key."""
        path = self.folder / f"{name}.sqlite"
        if not path.exists():
            return {}
        cloud, _ = read_store(path)
        tiles = {f"{t.id.level}/{t.id.x}/{t.id.y}": (t.revision, t.payload) for t in cloud.tiles()}
        keyframes = {str(k.keyframe.index): (k.keyframe.revision, k.payload) for k in cloud.keyframes()}
        return tiles | keyframes

    def on_aircraft(self) -> Held:
        """The same of the aircraft, asked directly: no ground may be up, for it would answer too."""
        bus = router_at(self.endpoint)
        try:
            wait_until(lambda: bool(list(bus.query(all_of(DIGEST), timeout_s=1.0))), 30.0)
            held: Held = {}
            for stream, message in ((TILE, MapTile), (KEYFRAME, Keyframe)):
                for key, payload in bus.query(all_of(stream), timeout_s=10.0):
                    held["/".join(parse_key(key).rest)] = (decode(message, payload).revision, payload)
            return held
        finally:
            bus.close()

    def settle(self, *names: str, timeout_s: float = 30.0) -> None:
        """Return when stations, of which one is the router, hold what the aircraft lists once it lists nothing new."""
        bus = client_of(self.endpoint)
        digests, subscription = collect(bus, all_of(DIGEST))

        def settled() -> bool:
            rows = [decode(MapDigest, payload).tiles for _, payload in digests[-3:]]
            if len(rows) < 3 or len(rows[-1]) == 0 or not all(np.array_equal(r, rows[-1]) for r in rows):
                return False
            listed = {f"{level}/{x}/{y}": revision for level, x, y, revision in rows[-1].tolist()}
            return all(_tiles(self.on_ground(name)) == listed for name in names)

        try:
            wait_until(settled, timeout_s)
        finally:
            subscription.close()
            bus.close()

    def close(self) -> None:
        for program in self.programs:
            program.process.kill()
            program.process.wait()


def _tiles(held: Held) -> dict[str, int]:
    return {key: revision for key, (revision, _) in held.items() if "/" in key}
