"""Reads a recording as far as it is whole: cut anywhere, without its index, or with damage in between."""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata

from common.errors import SourceError
from common.recording.writer import ABOUT

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 256_000_000
MAX_PROBLEMS = 100
FOREVER_NS = 1 << 64
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI8sQ")
_MESSAGE = struct.Struct("<HIQQ")
_COMPRESSION = b"\x04\x00\x00\x00zstd"
_OPCODES = {int(opcode) for opcode in Opcode}


class Recorded(NamedTuple):
    """A message of a recording: when it was logged (GPST, ns), its key, and its payload as it travelled."""

    log_ns: int
    key: str
    payload: bytes


@dataclass(frozen=True)
class ChunkPlace:
    """Where a chunk lies in the file, and from when to when its messages were logged (ns, both included)."""

    offset: int
    length: int
    first_ns: int
    last_ns: int


class _DamagedError(Exception):
    """A chunk that cannot be read; the text says why."""


class Recording:
    """An MCAP file of ours. `about` tells what was recorded; `problems` what could not be read, as far as known.

    Opening walks over the heads of the records, which needs neither index nor end of the file. Raises SourceError
    for a file that is missing or no MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.about: dict[str, str] = {}
        self.problems: list[str] = []
        self.whole = False
        self._channels: dict[int, Channel] = {}
        try:
            with path.open("rb") as file:
                self._bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is empty"
            raise SourceError(f"{path}: cannot be read: {reason}") from error
        if self._bytes[: len(MAGIC)] != MAGIC:
            raise SourceError(f"{path}: is no MCAP recording")
        self.chunks = list(self._walk())

    @property
    def first_ns(self) -> int:
        """When the first message was logged, GPST ns; 0 when there is none."""
        return min((chunk.first_ns for chunk in self.chunks), default=0)

    @property
    def last_ns(self) -> int:
        """When the last message was logged, GPST ns; 0 when there is none."""
        return max((chunk.last_ns for chunk in self.chunks), default=0)

    def messages(
        self, start_ns: int | None = None, end_ns: int | None = None, encoding: str = "msgpack"
    ) -> Iterator[Recorded]:
        """The messages logged from `start_ns` to before `end_ns`, in the order in which they came.

        Those of another encoding are passed over: "json" gives the readable copies and the tables. Chunks outside are
        not unpacked, unless the file has lost its index, which tells the channels.
        """
        start = 0 if start_ns is None else start_ns
        end = FOREVER_NS if end_ns is None else end_ns
        last_count: dict[int, int] = {}
        for chunk in self.chunks:
            outside = chunk.last_ns < start or chunk.first_ns >= end
            if outside and self.whole:
                continue
            try:
                records = self._records_of(chunk)
            except _DamagedError as error:
                self._tell(f"the chunk at byte {chunk.offset} is damaged and skipped: {error}")
                continue
            for channel_id, count, log_ns, payload in records:
                channel = self._channels.get(channel_id)
                if channel is None:
                    self._tell(f"a channel's name is lost: messages of number {channel_id} are skipped")
                    continue
                if channel.message_encoding != encoding:
                    continue
                missing = count - last_count.get(channel_id, 0 if start_ns is None else count - 1) - 1
                last_count[channel_id] = count
                if missing > 0:
                    self._tell(f"{missing} messages of {channel.topic} before message {count} are missing")
                if start <= log_ns < end:
                    yield Recorded(log_ns, channel.topic, payload)

    def close(self) -> None:
        """Let go of the file."""
        self._bytes.close()

    def _tell(self, problem: str) -> None:
        if len(self.problems) < MAX_PROBLEMS and problem not in self.problems:
            self.problems.append(problem)

    def _walk(self) -> Iterator[ChunkPlace]:
        """The chunks, found by the heads of the records; on the way, what stands outside of them."""
        size, offset = len(self._bytes), len(MAGIC)
        while offset + _RECORD.size <= size:
            opcode, length = _RECORD.unpack_from(self._bytes, offset)
            body = offset + _RECORD.size
            chunk = self._chunk_at(body, length)
            if chunk is not None:
                yield chunk
            elif opcode == Opcode.CHUNK or not (self._plausible(offset) and self._plausible(body + length)):
                offset = self._skip_damage(offset)
                continue
            elif opcode in (Opcode.CHANNEL, Opcode.METADATA):
                self._note(opcode, self._bytes[body : body + length])
            elif opcode == Opcode.FOOTER:
                self.whole = True
                break
            offset = body + length
        if not self.whole:
            self._tell(f"it ends without its index at byte {size}: cut, or never closed; read up to there")

    def _plausible(self, offset: int) -> bool:
        """Whether a record may begin here, or the file end. A damaged length betrays itself by what follows."""
        size = len(self._bytes)
        if offset + _RECORD.size > size or self._bytes[offset : offset + len(MAGIC)] == MAGIC:
            return offset <= size
        opcode, length = _RECORD.unpack_from(self._bytes, offset)
        return opcode in _OPCODES and length <= size - offset - _RECORD.size

    def _skip_damage(self, offset: int) -> int:
        """Where the next chunk may begin, past bytes that are no record."""
        head = _RECORD.size + _CHUNK.size - 16
        found = self._bytes.find(_COMPRESSION, offset + 1 + head)
        if found < 0:
            return len(self._bytes)
        self._tell(f"bytes {offset} to {found - head} are no record and skipped")
        return found - head

    def _chunk_at(self, body: int, length: int) -> ChunkPlace | None:
        """The chunk that a record holds, whatever its opcode says, or None when it does not look like one."""
        if body + max(length, _CHUNK.size) > len(self._bytes):
            return None
        first_ns, last_ns, _, _, compression, packed = _CHUNK.unpack_from(self._bytes, body)
        whole = compression == _COMPRESSION and packed == length - _CHUNK.size
        return ChunkPlace(body, length, first_ns, last_ns) if whole else None

    def _note(self, opcode: int, record: bytes) -> None:
        stream = ReadDataStream(BytesIO(record))
        try:
            if opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self._channels[channel.id] = channel
            elif (metadata := Metadata.read(stream)).name == ABOUT:
                self.about = dict(metadata.metadata)
        except Exception as error:  # the library lets through whatever goes wrong in it
            self._tell(f"a record of kind {opcode} is damaged and skipped: {error}")

    def _records_of(self, chunk: ChunkPlace) -> list[tuple[int, int, int, bytes]]:
        """Channel, count, log time and payload of the messages of a chunk; its channels are noted."""
        data = self._unpack(chunk)
        found, offset = [], 0
        while offset + _RECORD.size <= len(data):
            opcode, length = _RECORD.unpack_from(data, offset)
            body = offset + _RECORD.size
            if length > len(data) - body:
                raise _DamagedError("a record runs past its end")
            if opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
                channel, count, log_ns, _ = _MESSAGE.unpack_from(data, body)
                found.append((channel, count, log_ns, data[body + _MESSAGE.size : body + length]))
            elif opcode == Opcode.CHANNEL:
                self._note(opcode, data[body : body + length])
            offset = body + length
        return found

    def _unpack(self, chunk: ChunkPlace) -> bytes:
        """The records of a chunk. Raises _DamagedError when they are not what the checksum says."""
        _, _, size, checksum, _, _ = _CHUNK.unpack_from(self._bytes, chunk.offset)
        packed = self._bytes[chunk.offset + _CHUNK.size : chunk.offset + chunk.length]
        if size > MAX_CHUNK_BYTES:
            raise _DamagedError(f"it claims {size} bytes")
        try:
            if zstandard.frame_content_size(packed) != size:
                raise _DamagedError("its size is not what its head says")
            data = zstandard.decompress(packed, max_output_size=size)
        except zstandard.ZstdError as error:
            raise _DamagedError(str(error)) from error
        if zlib.crc32(data) != checksum:
            raise _DamagedError("its checksum is wrong")
        return data
