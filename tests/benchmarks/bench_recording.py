"""Recordings: what a flight at full rate loses on its way to the file, and how fast a file is written and read.

A camera of 1280 × 720 px at 30 Hz (raw, as-is, as JPEG and as H.264 in the file), an IMU at 200 Hz and a GNSS receiver
of 40 signals at 10 Hz are published by one process and recorded by `luojia-air record`, which are two processes
on one machine; then the file is replayed to a listener as fast as possible.

python tests/benchmarks/bench_recording.py [--seconds 30] [--json]
"""

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from bus_network import free_endpoint  # noqa: E402

from common.bus import BusConfig, ZenohBus  # noqa: E402
from common.keys import PREFIX, alive_key, message_key  # noqa: E402
from common.measurements import CameraFrame, Encoding, GnssEpoch, ImuSample  # noqa: E402
from common.recording.reader import Recording  # noqa: E402
from common.streams import RAW_CAMERA, RAW_GNSS, RAW_IMU  # noqa: E402
from common.wire import encode  # noqa: E402

WIDTH, HEIGHT = 1280, 720
FORMATS = ("jpeg", "h264", "as-is")


def ground(size=4096):
    """A picture to fly over, as rough as grass and paths: noise of every size."""
    rng = np.random.default_rng(1)
    picture = np.full((size, size, 3), 110.0)
    for step in (4, 16, 64, 256):
        coarse = rng.normal(0, 14, (size // step, size // step, 3)).astype(np.float32)
        picture += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(picture + rng.normal(0, 3, picture.shape), 0, 255).astype(np.uint8)


def frames():
    """Two seconds of frames of a flight, to be repeated."""
    picture = ground()
    return [np.ascontiguousarray(picture[8 * i : 8 * i + HEIGHT, 4 * i : 4 * i + WIDTH]).tobytes() for i in range(60)]


def messages(tick, pixels):
    """What is published at a tick of 1/600 s."""
    t_ns = time.time_ns()
    if tick % 3 == 0:
        yield RAW_IMU, ImuSample(t_ns, np.array([0.1, 0.2, 9.8]), np.array([0.01, 0.0, tick * 1e-6]))
    if tick % 20 == 0:
        i = tick // 20
        yield RAW_CAMERA, CameraFrame(t_ns, "down", i, WIDTH, HEIGHT, Encoding.BGR8, pixels[i % len(pixels)], 0.002)
    if tick % 60 == 0:
        yield RAW_GNSS, epoch(t_ns, 40)


def epoch(t_ns, n):
    """An epoch of n signals."""
    rng = np.random.default_rng(t_ns % 2**32)
    names = tuple(f"G{i % 32 + 1:02d}" for i in range(n))
    columns = [rng.normal(2e7, 1e6, n) for _ in range(5)]
    sigmas = [rng.random(n) for _ in range(3)]
    return GnssEpoch(t_ns, "gnss", names, ("1C",) * n, *columns, np.zeros(n, bool), *sigmas, np.zeros(n, np.int32), 18)


def fly(camera, seconds, pixels, folder):
    """Record a flight; the figures of it, and the file."""
    endpoint, config = free_endpoint(), folder / "air.toml"
    config.write_text(
        f'[recorder]\nconnect = ["{endpoint}"]\ncamera = "{camera}"\nwarn_free_mb = 0\nmin_free_mb = 500\n'
    )
    bus = ZenohBus(BusConfig("peer", listen=(endpoint,)))
    alive = threading.Event()
    bus.watch_alive(alive_key("uav1", "recorder"), lambda _, there: alive.set() if there else None)
    command = [sys.executable, "-m", "air", "record", "--out", str(folder), "--config", str(config)]
    recorder = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    alive.wait(30.0)
    time.sleep(1.0)
    sent, begun_s = defaultdict(list), time.monotonic()
    for tick in range(round(600 * seconds)):
        time.sleep(max(0.0, begun_s + tick / 600 - time.monotonic()))
        for stream, message in messages(tick, pixels):
            key, payload = message_key("uav1", stream, message), encode(message)
            # Compressed frames differ from what was sent: their times must be the same.
            raw = stream is not RAW_CAMERA or camera == "as-is"
            sent[key].append(hashlib.blake2b(payload).digest() if raw else message.t_ns)
            bus.publish(key, payload, stream)
    late_s = time.monotonic() - begun_s - seconds
    time.sleep(1.0)
    recorder.send_signal(signal.SIGINT)
    _, status, used = os.wait4(recorder.pid, 0)
    bus.close()
    path = next(folder.glob("*.mcap"))
    size_mb = path.stat().st_size / 1e6
    figures = check(path, sent, camera) | {
        "messages": sum(map(len, sent.values())),
        "mb_per_s": size_mb / seconds,
        "cpu": (used.ru_utime + used.ru_stime) / seconds,
        "late_s": late_s,
        "exit": status,
    }
    return path, figures


def check(path, sent, camera):
    """How many messages are missing in the file, or are not what was sent."""
    import msgpack

    kept = defaultdict(list)
    for message in Recording(path).messages():
        if message.key in sent:
            packed = "/raw/camera/" in message.key and camera != "as-is"
            digest = msgpack.unpackb(message.payload)["t_ns"] if packed else hashlib.blake2b(message.payload).digest()
            kept[message.key].append(digest)
    lost = sum(len(there) - len(kept[key]) for key, there in sent.items())
    differing = sum(len(set(kept[key]) - set(there)) for key, there in sent.items())
    return {"lost": lost, "differing": differing}


def replay(path, folder):
    """Replay a file as fast as possible: MB of payload per second, and messages that did not arrive."""
    endpoint, config = free_endpoint(), folder / "replay.toml"
    config.write_text(f'[bus]\nconnect = ["{endpoint}"]\n')
    listener = ZenohBus(BusConfig("peer", listen=(endpoint,)))
    got = []
    listener.subscribe(f"{PREFIX}/**", lambda _, payload: got.append((time.monotonic(), len(payload))))
    listener.declare_alive(alive_key("listener", "test"))
    command = [sys.executable, "-m", "air", "replay", str(path), "--config", str(config), "--speed", "inf", "--quiet"]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    time.sleep(0.5)
    listener.close()
    stored = sum(1 for _ in Recording(path).messages())
    took_s = max(got[-1][0] - got[0][0], 1e-3)
    return {"replay_mb_per_s": sum(size for _, size in got) / 1e6 / took_s, "replay_lost": stored - len(got)}


def read(path):
    """MB of payload per second that a reader of the file gets, from memory."""
    begun_s, size = time.monotonic(), 0
    for message in Recording(path).messages():
        size += len(message.payload)
    return {"read_mb_per_s": size / 1e6 / (time.monotonic() - begun_s)}


def main():
    """Runs the benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--formats", nargs="+", default=FORMATS, choices=FORMATS)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    pixels, results = frames(), {}
    for camera in args.formats:
        with tempfile.TemporaryDirectory() as folder:
            path, figures = fly(camera, args.seconds, pixels, Path(folder))
            results[camera] = figures | read(path) | replay(path, Path(folder))
    if args.json:
        print(json.dumps(results))
        return
    print(
        "| camera in the file | messages | lost | differing | record MB/s | CPU s/s | read MB/s | replay MB/s | lost |"
    )
    print("| --- " * 9 + "|")
    for camera, f in results.items():
        print(
            f"| {camera} | {f['messages']} | {f['lost']} | {f['differing']} | {f['mb_per_s']:.1f} | {f['cpu']:.2f} "
            f"| {f['read_mb_per_s']:.0f} | {f['replay_mb_per_s']:.0f} | {f['replay_lost']} |"
        )
    print(f"\n{args.seconds:g} s each: 1280 × 720 px at 30 Hz, IMU 200 Hz, GNSS 10 Hz. CPU is the recorder's.\n")


if __name__ == "__main__":
    main()
