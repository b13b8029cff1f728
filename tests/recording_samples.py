"""What the tests of recordings share: a second of a flight, and files of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from wire_samples import SAMPLES

from common.keys import message_key
from common.measurements import CameraFrame, Encoding, ImuSample
from common.messages import Message
from common.recording.reader import Recorded
from common.recording.writer import RecordingWriter
from common.streams import RAW_CAMERA, RAW_IMU, STREAMS, Stream
from common.wire import encode

START_NS = 1_400_000_000_000_000_000
STEP_NS = 5_000_000


def stream_of(message: Message) -> Stream:
    return next(stream for stream in STREAMS if stream.message is type(message))


def imu(i: int) -> ImuSample:
    return ImuSample(START_NS + i * STEP_NS, np.array([0.1 * i, 0.0, 9.81]), np.array([0.0, 0.01, -0.5]))


def frame(i: int, width: int = 64, height: int = 48) -> CameraFrame:
    """A picture that moves: smooth, so that compression changes little."""
    y, x = np.mgrid[:height, :width]
    grey = 127 + 90 * np.sin((x + 2 * i) / 9.0) * np.cos(y / 7.0)
    pixels = np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
    t_ns = START_NS + i * STEP_NS
    return CameraFrame(t_ns, "front", i, width, height, Encoding.BGR8, pixels.tobytes(), 0.002, 1.0, 1e-5)


def flight(count: int) -> list[Recorded]:
    """Everything that travels once, then so many IMU samples with a frame at every seventh."""
    messages: list[tuple[Stream, Message]] = [(stream_of(sample), sample) for sample in SAMPLES]
    for i in range(count):
        messages.append((RAW_IMU, imu(i)))
        if i % 7 == 0:
            messages.append((RAW_CAMERA, frame(i)))
    return [
        Recorded(START_NS + k * STEP_NS, message_key("uav1", stream, message), encode(message))
        for k, (stream, message) in enumerate(messages)
    ]


def write(path: Path, messages: list[Recorded], per_chunk: int = 20, close: bool = True) -> None:
    """A recording of messages, so many in each chunk."""
    with path.open("wb") as file:
        writer = RecordingWriter(file, {"vehicle": "uav1"})
        for i, message in enumerate(messages, 1):
            writer.add(message.key, message.payload, message.log_ns)
            if i % per_chunk == 0:
                writer.flush()
        if close:
            writer.close()
        else:
            writer.flush()
