"""The wire keeps what it is given, refuses what does not fit, and can be read without code of ours."""

from __future__ import annotations

import json
import math
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_samples import FLIGHT, GOLDEN, SAMPLES, STRATEGIES, TYPES, jpeg, readable, smooth_tile

import schemas
from common.errors import WireError
from common.messages import Datum, EstimatorState, Health, Keyframe, Level, MapDigest, MapTile, Message, Pose, TileId
from common.se3 import SE3
from common.streams import STREAMS, TILE
from common.tile_images import SIGMA_MIN, SIGMA_RATIO
from common.wire import decode, encode, schema_name

by_type = pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.__name__)
by_sample = pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: type(sample).__name__)


def assert_same(a: Any, b: Any) -> None:
    """Equal field by field; rotations within rounding."""
    if isinstance(a, SE3):
        np.testing.assert_allclose(a.R, b.R, atol=1e-12)
        np.testing.assert_array_equal(a.t, b.t)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif is_dataclass(a):
        assert type(a) is type(b)
        for f in fields(a):
            assert_same(getattr(a, f.name), getattr(b, f.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    else:
        assert type(a) is type(b)
        assert a == b or (a != a and b != b)


def assert_same_tile(a: MapTile, b: MapTile, payload: bytes) -> None:
    """Equal within the quantisation that the payload states; colours within what JPEG does to a gradient."""
    plain = ("flight", "id", "revision", "t_ns", "cell", "views", "disputed")
    for name in plain:
        assert_same(getattr(a, name), getattr(b, name))
    known = np.isfinite(a.height)
    np.testing.assert_array_equal(known, np.isfinite(b.height))
    np.testing.assert_array_equal(known, np.isfinite(b.sigma))
    step = msgpack.unpackb(payload)["height_step"]
    rounding = np.spacing(np.abs(a.height[known]))
    assert (np.abs(a.height[known].astype(float) - b.height[known]) <= step / 2 + rounding).all()
    highest = SIGMA_MIN * SIGMA_RATIO**254
    ratio = b.sigma[known] / a.sigma[known].clip(SIGMA_MIN, highest)
    assert (np.abs(np.log(ratio)) <= 0.5001 * math.log(SIGMA_RATIO)).all()
    assert (b.colour[~known] == 0).all()
    if known.any():
        assert np.abs(a.colour[known].astype(int) - b.colour[known]).mean() < 4


@by_type
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_every_message_survives_the_wire(kind: type[Message], data: st.DataObject) -> None:
    message = data.draw(STRATEGIES[kind])
    payload = encode(message)
    assert payload == encode(message), "encoding is not deterministic"
    back = decode(kind, payload)
    if isinstance(message, MapTile):
        assert isinstance(back, MapTile)
        assert_same_tile(message, back, payload)
    else:
        assert_same(message, back)


@settings(max_examples=40, deadline=None)
@given(STRATEGIES[MapTile])
def test_a_tile_sent_on_by_a_station_loses_nothing_more(tile: MapTile) -> None:
    once = decode(MapTile, encode(tile))
    twice = decode(MapTile, encode(once))
    for name in ("height", "sigma", "views", "disputed"):
        assert_same(getattr(once, name), getattr(twice, name))


@by_sample
def test_golden_bytes_are_written_and_read_as_on_the_first_day(sample: Message) -> None:
    name = schema_name(type(sample))
    golden = (GOLDEN / f"{name}.msgpack").read_bytes()
    description = json.loads((GOLDEN / f"{name}.json").read_text(encoding="utf-8"))
    assert readable(msgpack.unpackb(golden)) == description
    if isinstance(sample, MapTile):
        assert_same_tile(sample, decode(MapTile, golden), golden)
        assert_same_but_for_compression(msgpack.unpackb(encode(sample)), msgpack.unpackb(golden))
    else:
        assert_same(sample, decode(type(sample), golden))
        assert encode(sample) == golden


def assert_same_but_for_compression(today: dict[str, Any], golden: dict[str, Any]) -> None:
    """Another build of zlib or libjpeg may compress otherwise: pixels count, not the bytes that hold them."""
    assert list(today) == list(golden)
    for name, value in golden.items():
        if name.endswith("_png"):
            np.testing.assert_array_equal(_image(today[name]), _image(value))
        elif name.endswith("_jpeg"):
            assert np.abs(_image(today[name]).astype(int) - _image(value)).max() <= 3
        else:
            assert today[name] == value


def _image(data: bytes) -> Any:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


# Any MessagePack reader, with the schema alone


def read_by_schema(value: Any, schema: dict[str, Any], defs: dict[str, Any]) -> Any:
    """What an integrator would write: follow the schema, open images, columns and tables as it says."""
    schema = defs[schema["$ref"].rsplit("/", 1)[1]] if "$ref" in schema else schema
    if schema.get("dtype") and schema.get("type") == "object":
        return np.frombuffer(value["data"], "<i4").reshape(value["shape"])
    if "dtype" in schema:
        return np.frombuffer(value, {"float64": "<f8", "int32": "<i4", "bool": "?"}[schema["dtype"]])
    if value is None and "number" in schema.get("type", ()):
        return NAN
    if isinstance(value, list) and "number" in schema.get("items", {}).get("type", ()):
        return [NAN if item is None else item for item in value]
    if schema.get("contentMediaType") == "image/png" or schema.get("shape") == ["N", "N", 3]:
        image = _image(value)
        assert image.ndim == (2 if schema["channels"] == 1 else 3)
        return image[..., ::-1] if image.ndim == 3 else image
    if isinstance(value, dict):
        inner = schema.get("properties", {})
        return {name: read_by_schema(item, inner.get(name, {}), defs) for name, item in value.items()}
    return value


def read(sample: Message) -> dict[str, Any]:
    file = Path(schemas.__file__).parent / f"{schema_name(type(sample))}.json"
    schema = json.loads(file.read_text(encoding="utf-8"))
    raw = msgpack.unpackb(encode(sample))
    jsonschema.Draft202012Validator(schema).validate(raw)
    result: dict[str, Any] = read_by_schema(raw, schema, schema.get("$defs", {}))
    assert set(schema["required"]) <= result.keys() <= schema["properties"].keys()
    return result


def assert_transform(read_back: dict[str, Any], T: SE3) -> None:
    w, x, y, z = read_back["quaternion"]
    assert w >= 0
    p = np.array([0.3, -0.7, 1.1])
    u = np.array([x, y, z])
    rotated = p + 2 * np.cross(u, np.cross(u, p) + w * p)
    np.testing.assert_allclose(rotated + read_back["position"], T.apply(p), atol=1e-12)


@by_sample
def test_any_messagepack_reader_reads_every_message_by_its_schema(sample: Message) -> None:
    got = read(sample)
    for f in fields(sample):
        want = getattr(sample, f.name)
        if isinstance(want, SE3):
            assert_transform(got[f.name], want)
        elif isinstance(want, TileId):
            assert (got["level"], got["x"], got["y"]) == (want.level, want.x, want.y)
        elif f.name not in got:  # the images of a tile; what is not required, where unknown
            continue
        elif is_dataclass(want):
            assert got[f.name] == vars(want)
        elif isinstance(want, np.ndarray | tuple | float):
            np.testing.assert_array_equal(got[f.name], want)
        elif want is None:
            assert got[f.name] is None or math.isnan(got[f.name])
        else:
            assert got[f.name] == want


def test_any_image_reader_reads_the_planes_of_a_tile_north_up() -> None:
    tile = smooth_tile(64)
    got = read(tile)
    north_up = {name: getattr(tile, name)[::-1] for name in ("height", "sigma", "colour", "views", "disputed")}
    known = got["height_png"] > 0
    height = got["height_base"] + (got["height_png"][known] - 1.0) * got["height_step"]
    sigma = got["sigma_min"] * got["sigma_ratio"] ** (got["sigma_png"][known] - 1.0)
    np.testing.assert_array_equal(known, np.isfinite(north_up["height"]))
    np.testing.assert_allclose(height, north_up["height"][known], atol=0.0026)
    np.testing.assert_allclose(sigma, north_up["sigma"][known], rtol=0.031)
    np.testing.assert_array_equal(got["views_png"], north_up["views"])
    np.testing.assert_array_equal(got["disputed_png"] > 0, north_up["disputed"])
    assert np.abs(got["colour_jpeg"][known].astype(int) - north_up["colour"][known]).mean() < 3


# Sizes


@pytest.mark.parametrize("spread", [0.0, 1.0, 400.0, 1e6])
def test_a_tile_of_pure_noise_still_fits_its_stream(spread: float) -> None:
    rng = np.random.default_rng(1)
    n = 256
    noise = MapTile(
        FLIGHT,
        TileId(0, 0, 0),
        0,
        0,
        0.1,
        (rng.random((n, n)) * spread).astype(np.float32),
        rng.lognormal(0, 5, (n, n)).astype(np.float32),
        rng.integers(0, 256, (n, n, 3), dtype=np.uint8),
        rng.integers(0, 256, (n, n), dtype=np.uint8),
        rng.random((n, n)) < 0.5,
    )
    payload = encode(noise)
    assert len(payload) <= TILE.max_bytes
    back = decode(TILE, payload)
    assert isinstance(back, MapTile)
    assert_same(noise.views, back.views)
    assert np.abs(noise.height - back.height).max() <= spread * 0.02 + 0.003


def test_unknown_cells_do_not_disturb_the_colours_beside_them() -> None:
    """A black mask under JPEG would ring into the known cells; a smooth filling costs them nothing."""
    whole = smooth_tile(64, unknown=0.0)
    masked = smooth_tile(64, unknown=0.5)
    known = np.isfinite(masked.height)
    error = np.abs(decode(MapTile, encode(masked)).colour[known].astype(int) - masked.colour[known])
    error_whole = np.abs(decode(MapTile, encode(whole)).colour[known].astype(int) - whole.colour[known])
    assert error.mean() < error_whole.mean() + 1.0


# Refusals


def changed(sample: Message, **changes: Any) -> bytes:
    """The payload of a sample with fields replaced (or removed where the value is `...`)."""
    raw = {**msgpack.unpackb(encode(sample)), **changes}
    return bytes(msgpack.packb({name: value for name, value in raw.items() if value is not ...}))


DATUM, POSE, KEYFRAME, ESTIMATOR, TILE_SAMPLE, DIGEST, REQUEST, HEALTH = SAMPLES[:8]
RAW, IMU, FRAME, EPOCH, KEPLER, GLONASS, IONOSPHERE, SOLUTION, CLOCK, VEHICLE = SAMPLES[8:]
PNG_8 = bytes(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1])
PNG_9 = bytes(cv2.imencode(".png", np.zeros((9, 9), np.uint8))[1])
BOMB = bytes(cv2.imencode(".png", np.zeros((8000, 8000), np.uint8))[1])
NAN = float("nan")


@pytest.mark.parametrize(
    ("sample", "changes", "field"),
    [
        (POSE, {"v": 2}, "version"),
        (POSE, {"v": ...}, "version"),
        (POSE, {"t_ns": ...}, "t_ns is missing"),
        (POSE, {"speed": 1.0}, "'speed' is not a field"),
        (POSE, {"t_ns": 1.0}, "t_ns"),
        (POSE, {"t_ns": -1}, "t_ns"),
        (POSE, {"t_ns": True}, "t_ns"),
        (POSE, {"flight": b"bytes"}, "flight"),
        (POSE, {"flight": "x" * 65}, "flight"),
        (POSE, {"sigma": [1.0, NAN, 1.0]}, r"sigma\[1\]"),
        (POSE, {"sigma": [1.0, 1.0]}, "sigma has 2 items"),
        (POSE, {"sigma": [1.0, 1.0, -1.0]}, r"sigma\[2\]"),
        (POSE, {"v_world": [1.0, 1.0, math.inf]}, r"v_world\[2\]"),
        (POSE, {"mode": "flying"}, "mode.*allowed: 'initializing'"),
        (POSE, {"T_world_body": {"position": [0, 0, 0], "quaternion": [0, 0, 0, 0]}}, "quaternion has norm 0"),
        (POSE, {"T_world_body": {"position": [0, 0, 0], "quaternion": [-1, 0, 0, 0]}}, r"quaternion\[0\]"),
        (POSE, {"T_world_body": {"position": [0, 0, 0]}}, "T_world_body.quaternion is missing"),
        (DATUM, {"latitude_deg": 91.0}, "latitude_deg"),
        (DATUM, {"height": "high"}, "height"),
        (KEYFRAME, {"thumbnail": b"GIF89a"}, "thumbnail"),
        (KEYFRAME, {"thumbnail": jpeg(1025, 4)}, "thumbnail is 1025 px"),
        (KEYFRAME, {"camera": {"width": 5}}, r"camera.height is missing"),
        (TILE_SAMPLE, {"height_png": PNG_8}, "height_png has bit depth 8"),
        (TILE_SAMPLE, {"views_png": PNG_9}, "views_png is 9 x 9 px, not 8 x 8"),
        (TILE_SAMPLE, {"views_png": BOMB}, "views_png is 8000 x 8000 px"),
        (TILE_SAMPLE, {"size": 9}, "height_png is 8 x 8 px, not 9 x 9"),
        (TILE_SAMPLE, {"size": 4000}, "size"),
        (TILE_SAMPLE, {"sigma_png": PNG_8}, "sigma_png knows other cells"),
        (TILE_SAMPLE, {"views_png": PNG_8[:-20]}, "views_png"),
        (TILE_SAMPLE, {"views_png": PNG_8 + b"more"}, "views_png"),
        (TILE_SAMPLE, {"colour_jpeg": jpeg(8, 7)}, "colour_jpeg is 8 x 7 px"),
        (TILE_SAMPLE, {"colour_jpeg": jpeg(8, 8)[:-9]}, "colour_jpeg is not a whole JPEG"),
        (TILE_SAMPLE, {"height_step": 1e300}, "exceeds float32"),
        (TILE_SAMPLE, {"cell": 0.0}, "cell"),
        (DIGEST, {"tiles": {"shape": [2, 3], "data": b""}}, r"tiles.shape\[1\]"),
        (DIGEST, {"tiles": {"shape": [2, 4], "data": bytes(31)}}, "tiles.data has 31 bytes"),
        (REQUEST, {"tiles": {"shape": [1, 3], "data": "text"}}, "tiles.data"),
        (HEALTH, {"level": "fine"}, "level"),
        (HEALTH, {"counts": {"tiles": 1.5}}, "counts.tiles"),
        (HEALTH, {"text": "x" * 1001}, "text"),
        (RAW, {"data": "text"}, "data"),
        (IMU, {"accel": [0.0, 0.0]}, "accel has 2 items"),
        (IMU, {"accel": None}, "accel"),
        (IMU, {"q_enu_body": [0.5, 0.5, 0.5, 0.0]}, "q_enu_body has norm 0.866"),
        (IMU, {"saturated": 1}, "saturated is 1, not boolean"),
        (FRAME, {"data": bytes(11)}, "data has 11 bytes, not 12 for 2 x 2 px bgr8"),
        (FRAME, {"encoding": "gif"}, "encoding"),
        (EPOCH, {"doppler": bytes(15)}, "doppler has 15 bytes, no multiple of 8"),
        (EPOCH, {"doppler": bytes(24)}, "doppler has 3 rows, satellites has 2"),
        (EPOCH, {"signals": ["1C"]}, "signals has 1 rows"),
        (EPOCH, {"half_cycle": b"\x00\x02"}, "half_cycle holds something else"),
        (EPOCH, {"satellites": ["G5", "R12"]}, r"satellites\[0\]"),
        (KEPLER, {"e": 1.5}, "e is 1.5"),
        (GLONASS, {"position": [1.0, 2.0, None]}, r"position\[2\]"),
        (IONOSPHERE, {"system": "GPS"}, "system"),
        (SOLUTION, {"kind": "4d"}, "kind"),
        (SOLUTION, {"sigma_time": -1.0}, "sigma_time"),
        (CLOCK, {"offset_ns": 0.5}, "offset_ns"),
        (VEHICLE, {"battery": 75}, "battery"),
        (ESTIMATOR, {"clock_s": {"GPS": 1e-4}}, "name 'clock_s.GPS'"),
        (ESTIMATOR, {"clock_s": {"G": None}}, "clock_s.G"),
        (ESTIMATOR, {"code_rms_m": -1.0}, "code_rms_m"),
        (VEHICLE, {"fix": "rtk"}, "fix"),
    ],
)
def test_a_field_that_does_not_fit_is_refused_by_name(sample: Message, changes: dict[str, Any], field: str) -> None:
    name = schema_name(type(sample)).split(".")[0]
    with pytest.raises(WireError, match=f"^{name}: .*{field}"):
        decode(type(sample), changed(sample, **changes))


def test_a_field_that_is_not_required_is_left_out_where_unknown() -> None:
    assert isinstance(ESTIMATOR, EstimatorState)
    known = replace(ESTIMATOR, clock_s={"G": 1e-4}, code_rms_m=1.5, lever_arm=np.array([0.0, NAN, 0.1]))
    more = msgpack.unpackb(encode(known)).keys() - msgpack.unpackb(encode(ESTIMATOR)).keys()
    assert more == {"clock_s", "code_rms_m", "lever_arm"}


def test_every_stream_refuses_more_than_it_allows() -> None:
    for stream in STREAMS:
        with pytest.raises(WireError, match="bytes; its stream allows"):
            decode(stream, bytes(stream.max_bytes + 1))


def test_a_type_that_does_not_travel_is_refused() -> None:
    with pytest.raises(WireError, match="TileId is no message"):
        encode(TileId(0, 0, 0))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (replace(POSE, sigma=np.array([1.0, NAN, 1.0])), r"sigma\[1\]"),
        (replace(POSE, sigma=np.ones(2)), r"sigma is float64 of shape \(2,\)"),
        (replace(POSE, v_world=[1.0, 2.0, 3.0]), "v_world is list"),
        (replace(POSE, T_world_body=SE3(np.eye(3), np.array([0, NAN, 0]))), r"T_world_body.position\[1\]"),
        (replace(POSE, T_world_body=SE3(np.full((3, 3), NAN), np.zeros(3))), "T_world_body.R"),
        (replace(POSE, T_world_body=SE3(-np.eye(3), np.zeros(3))), "T_world_body.R is not a rotation"),
        (replace(POSE, t_ns=None), "t_ns"),
        (replace(TILE_SAMPLE, height=np.zeros((8, 8))), "height is float64"),
        (replace(TILE_SAMPLE, sigma=np.zeros((8, 9), np.float32)), "sigma is float32 of shape"),
        (replace(TILE_SAMPLE, sigma=np.full((8, 8), NAN, np.float32)), "sigma"),
        (replace(TILE_SAMPLE, height=np.full((8, 8), np.inf, np.float32)), "height is infinite"),
        (replace(TILE_SAMPLE, views=np.zeros((8, 8), np.int64)), "views is int64"),
        (replace(DIGEST, tiles=np.zeros((2, 4), np.int64)), "tiles is int64"),
        (replace(KEYFRAME, thumbnail=b"not a jpeg"), "thumbnail"),
        (Health(0, "x", Level.OK, "", {"n": 2**70}), "counts.n"),
        (Datum("", 0.0, 0.0, 0.0), "flight"),
        (replace(IMU, accel=np.zeros(4)), r"accel is float64 of shape \(4,\)"),
        (replace(IMU, gyro=np.array([0.0, math.inf, 0.0])), r"gyro\[1\]"),
        (replace(IMU, q_enu_body=np.zeros(4)), "q_enu_body has norm 0"),
        (replace(EPOCH, cn0=np.zeros(2, np.float32)), r"cn0 is float32 of shape \(2,\)"),
        (replace(EPOCH, cn0=np.zeros(3)), "cn0 has 3 rows"),
        (replace(FRAME, width=3), "data has 12 bytes"),
        (replace(SOLUTION, satellites=NAN), "satellites"),
        (replace(RAW, data=bytes(70_000)), "its stream allows 64000"),
        (MapDigest(FLIGHT, 0, np.zeros((20_000, 4), np.int32)), "its stream allows"),
    ],
)
def test_encode_refuses_a_message_that_does_not_fit(message: Any, field: str) -> None:
    with pytest.raises(WireError, match=field):
        encode(message)


def test_a_number_written_as_an_integer_is_read_as_a_number() -> None:
    """JavaScript writes 1.0 as 1."""
    back = decode(Datum, changed(DATUM, height=408))
    assert_same(back.height, 408.0)
    back_pose = decode(Pose, changed(POSE, sigma=[1, 2, 3]))
    assert back_pose.sigma.dtype == np.float64
    camera = {**msgpack.unpackb(encode(KEYFRAME))["camera"], "fx": 1000}
    assert_same(decode(Keyframe, changed(KEYFRAME, camera=camera)).camera.fx, 1000.0)
