"""The records of an ArduPilot log (DataFlash, `.bin`): bytes → messages. The log describes its own formats.

Source: ArduPilot, libraries/AP_Logger, "Structure of the log file" (LogStructure.h): every message begins with A3 95
and its type; type 128 (FMT) gives length, name, format characters and column names of another type.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from common.counts import Counts

_HEAD = b"\xa3\x95"
_HEADER = 3
_FMT = 128
_CHARACTERS: Mapping[str, tuple[str, float | None]] = {
    "a": ("64s", None),
    "b": ("b", None),
    "B": ("B", None),
    "h": ("h", None),
    "H": ("H", None),
    "i": ("i", None),
    "I": ("I", None),
    "f": ("f", None),
    "d": ("d", None),
    "n": ("4s", None),
    "N": ("16s", None),
    "Z": ("64s", None),
    "c": ("h", 0.01),
    "C": ("H", 0.01),
    "e": ("i", 0.01),
    "E": ("I", 0.01),
    "L": ("i", 1e-7),
    "M": ("B", None),
    "q": ("q", None),
    "Q": ("Q", None),
    "g": ("e", None),
}
"""How a format character is packed, and the unit of its numbers where it is not one."""

Value = int | float | bytes


@dataclass(frozen=True)
class LogMessage:
    """One message of a log: its name, and its values by column, in the units of the column."""

    name: str
    values: Mapping[str, Value]

    def number(self, column: str) -> float | None:
        """The value of a column, None where this version of the message has no such number or it is not finite."""
        value = self.values.get(column)
        return None if value is None or isinstance(value, bytes) or not math.isfinite(value) else float(value)


@dataclass(frozen=True)
class _Format:
    name: str
    layout: struct.Struct
    columns: tuple[str, ...]
    units: tuple[float | None, ...]


_FMT_FORMAT = _Format("FMT", struct.Struct("<BB4s16s64s"), ("Type", "Length", "Name", "Format", "Columns"), (None,) * 5)


class LogScanner:
    """Finds the messages of a log in bytes that may be damaged; gives those whose name is wanted."""

    def __init__(self, wanted: frozenset[str], counts: Counts) -> None:
        self._wanted = wanted
        self._counts = counts
        self._formats: dict[int, _Format] = {_FMT: _FMT_FORMAT}
        self._held = b""
        self._in_burst = False

    def feed(self, data: bytes) -> Iterator[LogMessage]:
        """The messages that these bytes complete, while they are being iterated."""
        self._counts.received_bytes += len(data)
        held, at = self._held + data, 0
        while True:
            begin = held.find(_HEAD, at)
            if begin < 0 or begin + _HEADER > len(held):
                # The last byte may be the first half of a header.
                rest = begin if begin >= 0 else len(held) - held.endswith(_HEAD[:1])
                self._drop(rest - at)
                self._held = held[rest:]
                return
            self._drop(begin - at)
            at = begin
            form = self._formats.get(held[at + 2])
            if form is None:
                self._drop(1)
                at += 1
                continue
            end = at + _HEADER + form.layout.size
            if end > len(held):
                self._held = held[at:]
                return
            yield from self._message(form, held[at + _HEADER : end])
            at = end
            self._in_burst = False

    def close(self) -> None:
        """Count what is left of a message that the log does not hold to its end."""
        self._drop(len(self._held))
        self._held = b""

    def _message(self, form: _Format, body: bytes) -> Iterator[LogMessage]:
        self._counts.frames[form.name] += 1
        if form is not _FMT_FORMAT and form.name not in self._wanted:
            return
        raw = form.layout.unpack(body)
        if form is _FMT_FORMAT:
            self._define(*raw)
            return
        scaled = (v if unit is None else v * unit for v, unit in zip(raw, form.units, strict=True))
        yield LogMessage(form.name, dict(zip(form.columns, scaled, strict=True)))

    def _define(self, number: int, length: int, name: bytes, characters: bytes, columns: bytes) -> None:
        """Take in the description of a message, unless it contradicts itself."""
        letters, names = _text(characters), tuple(_text(columns).split(","))
        if number == _FMT:
            return
        if not set(letters) <= _CHARACTERS.keys() or len(letters) != len(names):
            self._counts.refused += 1
            return
        layout = struct.Struct("<" + "".join(_CHARACTERS[letter][0] for letter in letters))
        if layout.size + _HEADER != length:
            self._counts.refused += 1
            return
        self._formats[number] = _Format(_text(name), layout, names, tuple(_CHARACTERS[c][1] for c in letters))

    def _drop(self, count: int) -> None:
        if count > 0:
            self._counts.dropped_bytes += count
            self._counts.bursts += not self._in_burst
            self._in_burst = True


def _text(value: bytes) -> str:
    return value.split(b"\0")[0].decode("latin-1")
