"""The wire: time to encode and decode each message, and its size beside the limit of its stream.

The tiles are those of a simulated village with the noise of a map; photos tell of it the colours.

python tests/benchmarks/bench_wire.py
"""

import statistics
import time

import cv2
import numpy as np
from figures import Figure

from air.alignment.alignment import thumbnail
from air.sources.simulated.survey import Survey, SurveyOptions
from common.measurements import CameraFrame, Encoding, GnssEpoch, ImuSample
from common.messages import Datum, Health, Keyframe, Level, MapDigest, MapTile, Mode, Pose, TileId, TileRequest
from common.streams import STREAMS
from common.wire import decode, encode

FLIGHT = "2024-06-01T09-00-00"
CELL, CELLS = 0.1, 256
REPEATS = 30


def tile_of(world, x, y):
    """A tile of the village as the mapper would see it: 3 cm of noise, a hole, some cells of doubt."""
    rng = np.random.default_rng([x & 0xFFFF, y & 0xFFFF])
    east, north = (((i * CELLS + np.arange(CELLS)) + 0.5) * CELL for i in (x, y))
    xy = np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2)
    z, solid = world.top(xy)
    colour = world.colour(np.column_stack([xy, z]), solid, np.zeros(len(xy), np.int32)).reshape(CELLS, CELLS, 3)
    shape = (CELLS, CELLS)
    known = np.hypot(*(np.indices(shape) - 60)) > 20
    height = z.reshape(shape) + cv2.GaussianBlur(rng.normal(0, 0.1, shape), None, 1.0)
    return MapTile(
        FLIGHT,
        TileId(0, x, y),
        7,
        1_400_000_000_000_000_000,
        CELL,
        np.where(known, height, np.nan).astype(np.float32),
        np.where(known, rng.lognormal(np.log(0.04), 0.3, shape), np.nan).astype(np.float32),
        np.where(known[..., None], colour, 0).astype(np.uint8),
        np.where(known, rng.integers(2, 9, shape), 0).astype(np.uint8),
        known & (rng.random(shape) < 0.02),
    )


def messages():
    """One message of each kind, and several tiles, by name."""
    survey = Survey("", SurveyOptions(photos=12))
    truth, photo = survey.truth, survey.photo(0)
    image = cv2.cvtColor(cv2.imdecode(np.frombuffer(photo.jpeg, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    pose = truth.T_world_cam[0]
    rows = np.column_stack([np.zeros(2000, np.int32), np.indices((40, 50)).reshape(2, -1).T, np.full(2000, 7)])
    rows = rows.astype(np.int32)
    sigma = np.array([0.02, 0.02, 0.03])
    columns = np.full(40, 2e7)
    signals = (("G05",) * 40, ("1C",) * 40, *[columns] * 5, columns < 0, *[columns] * 3, np.zeros(40, np.int32))
    single = {
        "datum": Datum(FLIGHT, 30.5, 114.4, 62.0),
        "pose": Pose(FLIGHT, photo.t_ns, 3, pose, np.array([3.0, 0.1, 0.0]), sigma, Mode.PHOTOGRAMMETRIC),
        "health": Health(photo.t_ns, "mapper", Level.OK, "12 photos placed", {"placed": 12, "tiles": 20}),
        "keyframe": Keyframe(FLIGHT, 0, 1, photo.t_ns, photo.name, pose, truth.camera, sigma, thumbnail(image)),
        "digest of 2000 tiles": MapDigest(FLIGHT, photo.t_ns, rows),
        "IMU sample": ImuSample(photo.t_ns, sigma, sigma, sigma, np.array([1.0, 0, 0, 0])),
        "GNSS epoch of 40 signals": GnssEpoch(photo.t_ns, "gnss", *signals),
        "raw frame of 1280 × 720 px": CameraFrame(
            photo.t_ns, "down", 0, 1280, 720, Encoding.BGR8, bytes(1280 * 720 * 3)
        ),
        "request of 2000 tiles": TileRequest(FLIGHT, np.ascontiguousarray(rows[:, :3])),
    }
    tiles = {f"tile {x}, {y}": tile_of(truth.world, x, y) for x in (-1, 0) for y in (-1, 0)}
    return single | tiles


def milliseconds(work):
    """Median CPU time of a call, ms."""
    times = []
    for _ in range(REPEATS):
        begun = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - begun))
    return statistics.median(times)


def limit_of(message):
    """Most bytes that the stream of a message may carry in one."""
    return next(stream.max_bytes for stream in STREAMS if stream.message is type(message))


def main():
    """Runs the benchmark."""
    cv2.setNumThreads(1)
    print("| message | encode, ms | decode, ms | bytes | target |\n| --- | --- | --- | --- | --- |")
    for name, message in messages().items():
        payload = encode(message)
        size = Figure(name, "", 0, most=limit_of(message))
        encoded = milliseconds(lambda message=message: encode(message))
        decoded = milliseconds(lambda message=message, payload=payload: decode(type(message), payload))
        print(f"| {name} | {encoded:.3f} | {decoded:.3f} | {size.cell(len(payload))} | ≤ {size.most} |")
    print(f"\nTiles: {CELLS} × {CELLS} cells. One thread.\n")


if __name__ == "__main__":
    main()
