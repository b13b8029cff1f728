"""Writes a recording: payloads as they travelled, under their keys, in compressed chunks with an index."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from importlib.metadata import version
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

import schemas
from common.keys import Key, parse_key
from common.recording.readable import readable_json, readable_schema
from common.streams import Stream
from common.wire import VERSION, schema_name

CHUNK_BYTES = 4_000_000
READABLE_BYTES = 8_000
"""Messages up to this size are written as JSON too: images and bytes of devices would double the file."""
ABOUT = "luojia"
"""Name of the metadata record that says what was recorded."""


class RecordingWriter:
    """An MCAP file that grows; the caller flushes it from time to time and closes it.

    Each message is stored as it travelled (MessagePack, under its key). With `readable`, small ones are stored a
    second time as JSON under `/vehicle/stream`, for viewers that know no MessagePack.
    """

    def __init__(self, file: BinaryIO, about: dict[str, str], readable: bool = True) -> None:
        """Write the head of the file: `about` says what is recorded, in names and texts. Raises OSError."""
        self._mcap = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._mcap.start(library=f"luojia {version('luojia')}")
        self._mcap.add_metadata(ABOUT, about)
        self._readable = readable
        self._keys: dict[str, Key] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[str, int] = {}
        self._counts: Counter[int] = Counter()

    def add(self, key: str, payload: bytes, log_ns: int) -> None:
        """Append a message that arrived at `log_ns` (GPST). Raises WireError for a key that is not ours, OSError."""
        parsed = self._keys.get(key) or self._keys.setdefault(key, parse_key(key))
        self._write(key, "msgpack", parsed.stream, payload, log_ns)
        if self._readable and len(payload) <= READABLE_BYTES:
            text = readable_json(payload, schema_name(parsed.stream.message))
            if text is not None:
                topic = "/".join(["", parsed.vehicle, parsed.stream.name, *parsed.rest])
                self._write(topic, "json", parsed.stream, text, log_ns)

    def add_row(self, topic: str, values: Mapping[str, float | int | str], log_ns: int) -> None:
        """Append a row of a table as JSON, under a topic that is no key of a stream: no reader of streams sees it.

        All rows of a topic have the same names. Raises OSError.
        """
        if topic not in self._channels:
            types = {name: {"type": "string" if isinstance(value, str) else "number"} for name, value in values.items()}
            text = json.dumps({"title": topic, "type": "object", "properties": types}).encode()
            schema = self._mcap.register_schema(topic, "jsonschema", text)
            self._channels[topic] = self._mcap.register_channel(topic, "json", schema)
        self._add(self._channels[topic], json.dumps(values).encode(), log_ns)

    def flush(self) -> None:
        """Hand everything so far to the file as a whole chunk. Raises OSError."""
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the index; the file itself stays open. Raises OSError."""
        self._mcap.finish()  # type: ignore[no-untyped-call]

    def _write(self, topic: str, encoding: str, stream: Stream, data: bytes, log_ns: int) -> None:
        self._add(self._channels.get(topic) or self._open_channel(topic, encoding, stream), data, log_ns)

    def _add(self, channel: int, data: bytes, log_ns: int) -> None:
        self._counts[channel] += 1
        self._mcap.add_message(channel, log_ns, data, log_ns, self._counts[channel])

    def _open_channel(self, topic: str, encoding: str, stream: Stream) -> int:
        name = schema_name(stream.message)
        if (name, encoding) not in self._schemas:
            schema = schemas.load(name.rpartition(".v")[0], VERSION)
            told = schema if encoding == "msgpack" else readable_schema(schema)
            data = json.dumps(told, ensure_ascii=False).encode()
            self._schemas[name, encoding] = self._mcap.register_schema(name, "jsonschema", data)
        channel = self._mcap.register_channel(topic, encoding, self._schemas[name, encoding])
        return self._channels.setdefault(topic, channel)
