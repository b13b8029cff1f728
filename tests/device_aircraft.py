"""An aircraft with two devices on virtual ports, for the tests and benchmarks of live devices."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from bus_network import free_endpoint
from device_ports import Player, VirtualPort, evenly
from live_system import ROOT, Program


class Aircraft:
    """Two devices behind ports with stable names, and what runs on them.

    Recordings in the folders `gnss` and `xsens` are played at the rate at which they were made.
    """

    def __init__(self, folder: Path, gnss: Path | None = None, xsens: Path | None = None) -> None:
        self.folder, self.endpoint = folder, free_endpoint()
        self.gnss, self.imu = VirtualPort(folder / "luojia-gnss"), VirtualPort(folder / "luojia-imu")
        self.players: list[Player] = []
        self.programs: list[Program] = []
        self.config = folder / "air.toml"
        self.config.write_text(
            f'source = "live:"\n[bus]\nlisten = ["{self.endpoint}"]\nconnect = []\nshared_memory = false\n'
            f'[devices.gnss]\nport = "{self.gnss.link}"\n[devices.imu]\nport = "{self.imu.link}"\n'
        )

        if gnss is not None:
            self.gnss.plug()
            self.play(self.gnss, (gnss / "nhm.ubx").read_bytes(), 113.0)
        if xsens is not None:
            self.imu.plug()
            (recording,) = xsens.glob("*.bin")
            self.play(self.imu, recording.read_bytes(), 47.5)

    def play(self, port: VirtualPort, data: bytes, duration_s: float) -> None:
        self.players.append(Player(port, evenly(data, duration_s)))

    def run(self) -> Program:
        program = Program(["air", "run", "--config", str(self.config)], self.folder / "air.log")
        self.programs.append(program)
        return program

    def check(self, *options: str) -> tuple[int, str]:
        """Exit code and output."""
        command = [sys.executable, "-m", "air", "check", "--config", str(self.config), *options]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=30.0)
        assert not done.stderr
        return done.returncode, done.stdout

    def close(self) -> None:
        for program in self.programs:
            program.process.kill()
            program.process.wait()
        for player in self.players:
            player.stop()
        for port in (self.gnss, self.imu):
            if port.link.is_symlink():
                port.unplug()
