"""The one table of streams. Publishers, subscribers, uplink, viewer and documentation all read it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from common.measurements import (
    CameraFrame,
    ClockState,
    GlonassEphemeris,
    GnssEpoch,
    ImuSample,
    Ionosphere,
    KeplerEphemeris,
    RawBytes,
    ReceiverSolution,
    VehicleState,
)
from common.messages import Datum, EstimatorState, Health, Keyframe, MapDigest, MapTile, Message, Pose, TileRequest


class Priority(Enum):
    """Transport priority, from the most to the least urgent."""

    REAL_TIME = auto()
    DATA_HIGH = auto()
    DATA = auto()
    DATA_LOW = auto()
    BACKGROUND = auto()


class Congestion(Enum):
    """What happens when the link is full: the message is dropped, or the sender waits."""

    DROP = auto()
    BLOCK = auto()


class Radio(Enum):
    """Which radios carry a stream: both, the fast video link alone, or the wires on board."""

    BOTH = auto()
    VIDEO = auto()
    LOCAL = auto()


@dataclass(frozen=True)
class Stream:
    """One row of the table.

    `rate_hz` is nominal (0: on change); `max_bytes` is refused above; a stream is stale after `stale_after_s`
    without a message (0: never); `keyed` streams append chunks (a tile's place, a keyframe's index).
    """

    name: str
    message: type[Message]
    rate_hz: float
    priority: Priority
    congestion: Congestion
    radio: Radio
    max_bytes: int
    stale_after_s: float
    keyed: bool = False
    express: bool = False


POSE = Stream("pose", Pose, 10.0, Priority.REAL_TIME, Congestion.DROP, Radio.BOTH, 1_000, 1.0, express=True)
POSE_IMU = Stream("pose/imu", Pose, 200.0, Priority.REAL_TIME, Congestion.DROP, Radio.LOCAL, 1_000, 0.5, express=True)
DATUM = Stream("datum", Datum, 1.0, Priority.DATA_HIGH, Congestion.DROP, Radio.BOTH, 1_000, 5.0)
HEALTH = Stream("health", Health, 1.0, Priority.DATA_HIGH, Congestion.DROP, Radio.BOTH, 4_000, 5.0, keyed=True)
DIGEST = Stream("map/digest", MapDigest, 1.0, Priority.DATA_HIGH, Congestion.DROP, Radio.BOTH, 256_000, 5.0)
KEYFRAME = Stream("keyframe", Keyframe, 0.0, Priority.DATA, Congestion.BLOCK, Radio.VIDEO, 64_000, 0.0, keyed=True)
ESTIMATOR = Stream("estimator", EstimatorState, 1.0, Priority.DATA_HIGH, Congestion.DROP, Radio.BOTH, 2_000, 5.0)
TILE = Stream("map/tile", MapTile, 0.0, Priority.DATA_LOW, Congestion.BLOCK, Radio.VIDEO, 256_000, 0.0, keyed=True)
TILE_REQUEST = Stream("cmd/tiles", TileRequest, 0.0, Priority.DATA_HIGH, Congestion.BLOCK, Radio.BOTH, 64_000, 0.0)

VEHICLE = Stream("vehicle", VehicleState, 10.0, Priority.DATA_HIGH, Congestion.DROP, Radio.BOTH, 4_000, 3.0)
CLOCK = Stream("clock", ClockState, 1.0, Priority.DATA_HIGH, Congestion.DROP, Radio.BOTH, 1_000, 5.0, keyed=True)
RTCM = Stream("rtcm", RawBytes, 1.0, Priority.DATA_HIGH, Congestion.BLOCK, Radio.BOTH, 16_000, 10.0)


def _raw(
    name: str, message: type[Message], rate_hz: float, max_bytes: int, stale_after_s: float, keyed: bool = False
) -> Stream:
    """What a device measured, on the local bus alone: behind what flies, but not in one queue with the pictures."""
    quality = (Priority.DATA_LOW, Congestion.DROP, Radio.LOCAL)
    return Stream(name, message, rate_hz, *quality, max_bytes, stale_after_s, keyed)


RAW_IMU = _raw("raw/imu", ImuSample, 200.0, 1_000, 0.5)
RAW_GNSS = _raw("raw/gnss", GnssEpoch, 10.0, 128_000, 2.0)
RAW_EPHEMERIS = _raw("raw/ephemeris", KeplerEphemeris, 0.0, 1_000, 0.0, keyed=True)
RAW_GLONASS = _raw("raw/glonass", GlonassEphemeris, 0.0, 1_000, 0.0, keyed=True)
RAW_IONOSPHERE = _raw("raw/ionosphere", Ionosphere, 0.0, 1_000, 0.0, keyed=True)
RAW_SOLUTION = _raw("raw/solution", ReceiverSolution, 10.0, 1_000, 2.0)
RAW_BYTES = _raw("raw/bytes", RawBytes, 0.0, 64_000, 0.0, keyed=True)
# Dropping loses frames of 2.8 MB whenever a listener is held up for a few tenths of a second; blocking lost none.
_PICTURES = (Priority.BACKGROUND, Congestion.BLOCK, Radio.LOCAL)
RAW_CAMERA = Stream("raw/camera", CameraFrame, 30.0, *_PICTURES, 8_000_000, 1.0, keyed=True)

STREAMS: tuple[Stream, ...] = (
    *(POSE, POSE_IMU, DATUM, HEALTH, DIGEST, KEYFRAME, ESTIMATOR, TILE, TILE_REQUEST),
    *(VEHICLE, CLOCK, RTCM),
    *(RAW_IMU, RAW_GNSS, RAW_EPHEMERIS, RAW_GLONASS, RAW_IONOSPHERE, RAW_SOLUTION, RAW_BYTES, RAW_CAMERA),
)
