"""Messages for the tests of the wire: one fixed sample per type (the golden ones) and a strategy per type."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import cv2
import msgpack
import numpy as np
from hypothesis import strategies as st

from common.camera import CameraModel
from common.measurements import (
    CameraFrame,
    ClockPhase,
    ClockState,
    Encoding,
    FixKind,
    GlonassEphemeris,
    GnssEpoch,
    ImuSample,
    Ionosphere,
    KeplerEphemeris,
    RawBytes,
    ReceiverSolution,
    Severity,
    VehicleState,
)
from common.messages import (
    Datum,
    EstimatorState,
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
    EstimatorState(
        *(FLIGHT, 1_400_000_001_000_000_000, 1, Mode.VISUAL_INERTIAL, np.array([0.03, -0.01, 0.02]), np.zeros(3)),
        *(SE3.from_quaternion([0.0, 1.0, 0.0, 0.0], [0.1, 0.0, -0.08]), -0.004, 150, 0, 0.62),
    ),
    smooth_tile(8),
    MapDigest(FLIGHT, 1_400_000_002_000_000_000, np.array([[0, -1, 2, 5], [0, 0, 0, 1]], np.int32)),
    TileRequest(FLIGHT, np.array([[0, -1, 2], [3, 4, -5]], np.int32)),
    Health(1_400_000_003_000_000_000, "uplink", Level.DEGRADED, "video link lost – 12 tiles wait", {"tiles": 12}),
    RawBytes(1_400_000_004_000_000_000, "gnss", bytes(range(16))),
    ImuSample(
        1_400_000_004_005_000_000,
        np.array([0.125, -0.25, 9.8125]),
        np.array([0.5, -0.0625, math.nan]),
        None,
        np.array([0.5, -0.5, 0.5, 0.5]),
        31.5,
        True,
    ),
    CameraFrame(1_400_000_004_010_000_000, "front", 3, 2, 2, Encoding.BGR8, bytes(range(12)), 0.002, None, 1.5e-5),
    GnssEpoch(
        1_400_000_004_100_000_000,
        "gnss",
        ("G05", "R12"),
        ("1C", "1C"),
        np.array([2.0e7, 2.125e7]),
        np.array([1.05e8, math.nan]),
        np.array([-1250.5, 310.25]),
        np.array([45.0, 38.0]),
        np.array([64.5, 0.0]),
        np.array([False, True]),
        np.array([0.32, 0.64]),
        np.array([0.004, math.nan]),
        np.array([0.064, 0.128]),
        np.array([0, -4], np.int32),
        18,
    ),
    KeplerEphemeris(
        t_ns=1_400_000_004_200_000_000,
        satellite="E31",
        source="INAV",
        toe_ns=1_399_999_800_000_000_000,
        toc_ns=1_399_999_800_000_000_000,
        iode=77,
        iodc=77,
        af0=-1.5e-4,
        af1=2.5e-12,
        af2=0.0,
        sqrt_a=5440.609375,
        e=0.00025,
        i0=0.96875,
        omega0=-1.25,
        omega=0.5,
        m0=2.75,
        delta_n=2.5e-9,
        idot=-1.25e-10,
        omega_dot=-5.5e-9,
        cuc=1.5e-6,
        cus=9.5e-6,
        crc=105.5,
        crs=28.25,
        cic=-2.5e-8,
        cis=5e-8,
        group_delay=(-4.5e-9, math.nan),
        accuracy=3.125,
        health=0,
    ),
    GlonassEphemeris(
        1_400_000_004_300_000_000,
        "R12",
        1_399_999_500_000_000_000,
        (1.1e7, -2.2e7, 5.5e6),
        (-750.5, 1200.25, 3000.125),
        (-1.0e-6, 2.0e-6, 0.0),
        6.5e-5,
        1.0e-12,
        -4,
        0,
        0,
    ),
    Ionosphere(1_400_000_004_400_000_000, "G", (1.0e-8, 0.0, -6.0e-8, 0.0), (90112.0, 0.0, -196608.0, -65536.0)),
    ReceiverSolution(
        1_400_000_004_500_000_000,
        "gnss",
        FixKind.RTK_FLOAT,
        30.5,
        114.375,
        62.25,
        0.5,
        0.75,
        np.array([3.0, -0.125, math.nan]),
        0.25,
        math.nan,
        21,
    ),
    ClockState(1_400_000_005_000_000_000, "imu", ClockPhase.LOCKED, -123_456_789_012, -18.5, 1.25e-4, 5000, 3, 1),
    VehicleState(
        1_400_000_005_100_000_000,
        1,
        armed=True,
        q_enu_body=np.array([1.0, 0.0, 0.0, 0.0]),
        height_home=40.5,
        v_enu=np.array([3.0, 0.0, -0.125]),
        fix=FixKind.FIX_3D,
        satellites=14,
        battery=0.75,
        gimbal=(0.0, -1.5, math.nan),
        severity=Severity.WARNING,
        text="wind",
    ),
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

_name = st.text(st.characters(codec="utf-8"), min_size=1, max_size=20)
_issue = st.integers(0, 65535)
_satellite = st.builds("{}{:02d}".format, st.sampled_from("GREC"), st.integers(1, 63))
_unknown_sigma = st.floats(0.0, 1e6) | st.just(math.nan)
_sigmas = st.tuples(*[_unknown_sigma] * 3).map(np.array)
_quaternion = _se3.map(lambda T: T.wxyz)


def _unknown(bound: float) -> st.SearchStrategy[float]:
    return _floats(bound) | st.just(math.nan)


def _known_or_not(n: int) -> st.SearchStrategy[Any]:
    return st.tuples(*[_unknown(1e6)] * n).map(np.array)


def _column(n: int) -> st.SearchStrategy[Any]:
    """What a column of floats may hold: anything."""
    return st.lists(st.floats(width=64), min_size=n, max_size=n).map(lambda values: np.array(values, np.float64))


def _epoch(n: int) -> st.SearchStrategy[GnssEpoch]:
    def names(name: st.SearchStrategy[str]) -> st.SearchStrategy[tuple[str, ...]]:
        return st.lists(name, min_size=n, max_size=n).map(tuple)

    flags = st.lists(st.booleans(), min_size=n, max_size=n).map(lambda values: np.array(values, np.bool_))
    channels = st.lists(st.integers(-7, 13), min_size=n, max_size=n).map(lambda values: np.array(values, np.int32))
    return st.builds(
        GnssEpoch,
        *(_t_ns, _name, names(_satellite), names(st.sampled_from(["1C", "7Q"]))),
        *([_column(n)] * 5),
        flags,
        *([_column(n)] * 3),
        *(channels, st.none() | st.integers(-30, 30), st.booleans()),
    )


def _frame(width: int, height: int, encoding: Encoding, t_ns: int) -> CameraFrame:
    size = width * height * {Encoding.MONO8: 1, Encoding.BGR8: 3}.get(encoding, 2)
    return CameraFrame(t_ns, "front", t_ns, width, height, encoding, bytes(i % 251 for i in range(size)), 0.01, 1.5)


STRATEGIES: dict[type[Any], st.SearchStrategy[Any]] = {
    Datum: st.builds(Datum, _flight, _floats(90.0), _floats(180.0), _floats(1e4)),
    Pose: st.builds(
        Pose, _flight, _t_ns, _count, _se3, st.none() | _vectors(1e3), _vectors(1e6, 0.0), st.sampled_from(Mode)
    ),
    EstimatorState: st.builds(
        EstimatorState,
        *(_flight, _t_ns, _count, st.sampled_from(Mode), _vectors(1e3), _vectors(1e3)),
        *(_se3, _floats(10.0), _count, _count, st.floats(0.0, 1e3)),
        *(st.dictionaries(st.sampled_from("GREC"), _floats(1.0)), _unknown(1.0), _known_or_not(3)),
        *([_unknown_sigma] * 3),
        *(_sigmas, _sigmas, _unknown_sigma, _sigmas, _known_or_not(3), _sigmas),
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
        *(Health, _t_ns, _name, st.sampled_from(Level), _text),
        st.dictionaries(_text, st.integers(-(2**63), 2**63 - 1), max_size=5),
    ),
    RawBytes: st.builds(RawBytes, _t_ns, _name, st.binary(max_size=50)),
    ImuSample: st.builds(
        ImuSample,
        _t_ns,
        _known_or_not(3),
        _known_or_not(3),
        st.none() | _known_or_not(3),
        st.none() | _quaternion,
        st.none() | _floats(100.0),
        st.booleans(),
    ),
    CameraFrame: st.builds(_frame, st.integers(1, 20), st.integers(1, 20), st.sampled_from(Encoding), _t_ns),
    GnssEpoch: st.integers(0, 60).flatmap(_epoch),
    KeplerEphemeris: st.builds(
        KeplerEphemeris,
        *(_t_ns, _satellite, st.sampled_from(["LNAV", "INAV", "D2"]), _t_ns, _t_ns, _issue, _issue),
        *([_floats(1.0)] * 3),
        *(st.floats(0.0, 1e4), st.floats(0.0, 1.0)),
        *([_floats(1e3)] * 13),
        st.tuples(_unknown(1.0), _unknown(1.0)),
        _unknown(1e4),
        _count,
    ),
    GlonassEphemeris: st.builds(
        GlonassEphemeris,
        *(_t_ns, _satellite, _t_ns),
        *([st.tuples(*[_floats(1e8)] * 3)] * 3),
        *(_floats(1.0), _floats(1.0), st.integers(-7, 13), _issue, _count),
    ),
    Ionosphere: st.builds(Ionosphere, _t_ns, st.sampled_from("GCJ"), *([st.tuples(*[_floats(1e6)] * 4)] * 2)),
    ReceiverSolution: st.builds(
        ReceiverSolution,
        *(_t_ns, _name, st.sampled_from(FixKind), _unknown(90.0), _unknown(180.0), _unknown(1e4)),
        *(_unknown_sigma, _unknown_sigma, _known_or_not(3), _unknown_sigma, _unknown_sigma, _issue),
    ),
    ClockState: st.builds(
        ClockState,
        *(_t_ns, _name, st.sampled_from(ClockPhase), st.integers(-(2**63), 2**63 - 1)),
        *(_unknown(1e3), _unknown_sigma, _t_ns, _t_ns, _t_ns),
    ),
    VehicleState: st.builds(
        VehicleState,
        *(_t_ns, st.integers(0, 255), st.none() | st.booleans(), st.none() | _text, st.none() | _quaternion),
        *(st.none() | _floats(bound) for bound in (90.0, 180.0, 1e4, 1e4)),
        *(st.none() | _known_or_not(3), st.none() | st.sampled_from(FixKind), st.none() | _issue),
        *(st.none() | st.floats(0.0, 1.0) for _ in range(5)),
        *(st.none() | st.tuples(*[_unknown(10.0)] * 3), st.none() | st.tuples(*[_unknown(10.0)] * 3)),
        *(st.none() | st.floats(0.0, 1.0), st.none() | st.sampled_from(Severity), st.none() | _text),
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
