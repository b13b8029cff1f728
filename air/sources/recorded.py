"""Recordings of our own as a source: `F.mcap`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import get_args

from air.sensors.h264 import H264Decoder
from air.sources.known import ENDING, Known, read_known
from air.sources.source import Problem, Sensed, Truth
from common.errors import WireError
from common.keys import parse_key
from common.measurements import CameraFrame, Encoding, Measurement
from common.recording.reader import Recorded, Recording
from common.wire import decode

_MEASUREMENTS = get_args(Measurement)


class RecordedSource:
    """The measurements of a recording in the order in which they were logged; H.264 becomes bgr8 on the way.

    Raises SourceError for a file that is missing or no MCAP.
    """

    def __init__(self, url: str, path: str) -> None:
        self._url = url
        self._recording = Recording(Path(path).expanduser())
        self._refused: Counter[str] = Counter()
        self._decoders: dict[str, H264Decoder] = {}

    @property
    def url(self) -> str:
        """The URL that opened the recording."""
        return self._url

    @property
    def path(self) -> Path:
        """The file."""
        return self._recording.path

    @property
    def known(self) -> Known:
        """What was calibrated, from the folder beside the recording. Raises SourceError and ConfigError."""
        return read_known(self.path.with_suffix(ENDING))

    @property
    def truth(self) -> Truth | None:
        """None: nobody knows the truth of a real flight."""
        return None

    @property
    def problems(self) -> Sequence[Problem]:
        """Damage of the file, and messages that could not be read."""
        name = self._recording.path.name
        damage = [Problem(name, text) for text in self._recording.problems]
        return damage + [Problem(name, f"{text} ({count} times)") for text, count in self._refused.items()]

    def __iter__(self) -> Iterator[Sensed]:
        self._refused.clear()
        self._decoders.clear()
        for recorded in self._recording.messages():
            message = self._read(recorded)
            if message is not None:
                yield message

    def _read(self, recorded: Recorded) -> Measurement | None:
        """The measurement of a message; None for what is none, and, counted, for what cannot be read."""
        try:
            stream = parse_key(recorded.key).stream
            if stream.message not in _MEASUREMENTS:
                return None
            message: Measurement = decode(stream, recorded.payload)  # type: ignore[assignment]
        except WireError as error:
            self._refused[str(error)[:200]] += 1
            return None
        if isinstance(message, CameraFrame) and message.encoding is Encoding.H264:
            return self._unpacked(message)
        return message

    def _unpacked(self, frame: CameraFrame) -> CameraFrame | None:
        decoded = self._decoders.setdefault(frame.camera, H264Decoder()).decode(frame)
        if decoded is None:
            self._refused[f"a frame of camera {frame.camera} cannot be decoded without those before it"] += 1
        return decoded
