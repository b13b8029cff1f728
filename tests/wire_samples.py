"""Messages for the tests of the wire: one fixed sample per type (the golden ones) and a strategy per type."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
from hypothesis import strategies as st

from common.camera import CameraModel
from common.messages import (
    Datum,
    Health,
    Keyframe,
    Level,
    MapDigest,
    MapTile,
    Message,
    Mode,
    Pose,
    TileId,
    TileRequest,
)
from common.se3 import SE3
from common.wire import encode, schema_name

GOLDEN = Path(__file__).parent / "golden"
FLIGHT = "2025-06-01T10:00:00"


def jpeg(width: int, height: int) -> bytes:
    image = np.full((height, width, 3), 127, np.uint8)
    return bytes(cv2.imencode(".jpg", image)[1])


def smooth_tile(size: int, seed: int = 0, unknown: float = 0.2, relief: float = 5.0) -> MapTile:
    """A tile of gentle relief and colour with a share of unknown cells, of which the arrays say nothing."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size
    known = rng.random((size, size)) >= unknown
    height = relief * np.sin(3 * x + seed) * np.cos(2 * y) + rng.normal(0, 0.02, (size, size))
    sigma = rng.lognormal(np.log(0.05), 0.5, (size, size))
    wave = np.sin(np.arange(size) / 15.0)
    colour = np.stack(np.broadcast_arrays(120 + 60 * wave, 140 + 60 * wave[:, None], 90 + 0 * x), axis=-1)
    return MapTile(
        FLIGHT,
        TileId(0, int(rng.integers(-9, 9)), int(rng.integers(-9, 9))),
        int(rng.integers(0, 1000)),
        1_400_000_000_000_000_000 + seed,
        0.1,
        np.where(known, height, np.nan).astype(np.float32),
        np.where(known, sigma, np.nan).astype(np.float32),
        np.where(known[..., None], colour, 0).astype(np.uint8),
        np.where(known, rng.integers(2, 20, known.shape), 0).astype(np.uint8),
        known & (rng.random(known.shape) < 0.1),
    )


SAMPLES: tuple[Message, ...] = (
    Datum(FLIGHT, 47.3769, -8.5417, 408.25),
    Pose(
        FLIGHT,
        1_400_000_000_123_456_789,
        3,
        SE3.from_quaternion([0.5, 0.5, -0.5, 0.5], [1.5, -2.25, 40.0]),
        np.array([3.0, 0.0, -0.125]),
        np.array([0.25, 0.5, 1.0]),
        Mode.PHOTOGRAMMETRIC,
    ),
    Keyframe(
        FLIGHT,
        7,
        2,
        1_400_000_001_000_000_000,
        "DJI_0007.JPG",
        SE3.from_quaternion([0.0, 1.0, 0.0, 0.0], [10.0, 20.0, 40.5]),
        CameraModel(1600, 1200, 1125.5, 1125.5, 799.5, 599.5, -0.01, 0.002),
        np.array([0.5, 0.5, 0.75]),
        jpeg(8, 6),
    ),
    smooth_tile(8),
    MapDigest(FLIGHT, 1_400_000_002_000_000_000, np.array([[0, -1, 2, 5], [0, 0, 0, 1]], np.int32)),
    TileRequest(FLIGHT, np.array([[0, -1, 2], [3, 4, -5]], np.int32)),
    Health(1_400_000_003_000_000_000, "uplink", Level.DEGRADED, "video link lost – 12 tiles wait", {"tiles": 12}),
)
TYPES = tuple(type(sample) for sample in SAMPLES)


def _floats(bound: float) -> st.SearchStrategy[float]:
    return st.floats(-bound, bound, allow_nan=False)


def _vectors(bound: float, low: float | None = None) -> st.SearchStrategy[Any]:
    return st.tuples(*[st.floats(-bound if low is None else low, bound)] * 3).map(np.array)


def _rows(columns: int) -> st.SearchStrategy[Any]:
    cell = st.integers(-(2**31), 2**31 - 1)
    table = st.lists(st.tuples(*[cell] * columns), max_size=20)
    return table.map(lambda rows: np.array(rows, np.int32).reshape(-1, columns))


_text = st.text(st.characters(codec="utf-8"), max_size=20)
_flight = st.text(st.characters(codec="utf-8"), min_size=1, max_size=60)
_t_ns = st.integers(0, 2**63 - 1)
_count = st.integers(0, 2**31 - 1)
_se3 = st.builds(
    SE3.from_quaternion,
    st.tuples(*[_floats(1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.01),
    _vectors(1e6),
)
_focal = st.floats(1e-3, 1e5)
_pixels = st.integers(1, 65535)
_camera = st.builds(CameraModel, _pixels, _pixels, _focal, _focal, *[_floats(1e5)] * 2, *[_floats(10.0)] * 4)
_tile = st.builds(
    smooth_tile,
    st.integers(1, 40),
    st.integers(0, 2**31),
    st.sampled_from([0.0, 0.3, 0.95, 1.0]),
    st.sampled_from([0.0, 5.0, 300.0, 4000.0]),
)

STRATEGIES: dict[type[Any], st.SearchStrategy[Any]] = {
    Datum: st.builds(Datum, _flight, _floats(90.0), _floats(180.0), _floats(1e4)),
    Pose: st.builds(
        Pose, _flight, _t_ns, _count, _se3, st.none() | _vectors(1e3), _vectors(1e6, 0.0), st.sampled_from(Mode)
    ),
    Keyframe: st.builds(
        Keyframe,
        _flight,
        _count,
        _count,
        _t_ns,
        _text,
        _se3,
        _camera,
        _vectors(1e6, 0.0),
        st.just(b"") | st.builds(jpeg, st.integers(1, 64), st.integers(1, 64)),
    ),
    MapTile: _tile,
    MapDigest: st.builds(MapDigest, _flight, _t_ns, _rows(4)),
    TileRequest: st.builds(TileRequest, _flight, _rows(3)),
    Health: st.builds(
        Health,
        _t_ns,
        st.text(st.characters(codec="utf-8"), min_size=1, max_size=20),
        st.sampled_from(Level),
        _text,
        st.dictionaries(_text, st.integers(-(2**63), 2**63 - 1), max_size=5),
    ),
}


def readable(fields: Any) -> Any:
    """MessagePack values as JSON: byte strings as base64."""
    if isinstance(fields, dict):
        return {name: readable(value) for name, value in fields.items()}
    if isinstance(fields, list):
        return [readable(value) for value in fields]
    if isinstance(fields, bytes):
        return {"base64": base64.b64encode(fields).decode()}
    return fields


def write_golden() -> None:
    """Write the golden bytes anew: only for a new message or version, never to make a test pass."""
    GOLDEN.mkdir(exist_ok=True)
    for sample in SAMPLES:
        payload = encode(sample)
        name = schema_name(type(sample))
        (GOLDEN / f"{name}.msgpack").write_bytes(payload)
        text = json.dumps(readable(msgpack.unpackb(payload)), indent=2, ensure_ascii=False)
        (GOLDEN / f"{name}.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_golden()
