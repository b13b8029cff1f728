"""GoPro's telemetry: the key-length-value format GPMF.

Source: GoPro, GPMF Introduction, "Length" and "Type" (all big-endian, aligned to four bytes).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from common.arrays import F64

_HEADER = 8
_NESTED = 0
_COMPLEX = ord("?")
_NUMBERS = {
    "b": ">i1",
    "B": ">u1",
    "s": ">i2",
    "S": ">u2",
    "l": ">i4",
    "L": ">u4",
    "j": ">i8",
    "J": ">u8",
    "f": ">f4",
    "d": ">f8",
    "q": ">i4",
    "Q": ">i8",
}
_TEXT = "cFU"
_FIXED_POINT = {"q": 2.0**-16, "Q": 2.0**-32}
_LONGEST_TYPE = 64
"""Columns of one sample: cameras write at most some thirty."""


@dataclass(frozen=True, eq=False)
class Series:
    """Samples of one sensor in one payload: `values` (N, M) in the units that GPMF names, after scaling.

    `device` is the name of the device that wrote them; `texts` and `numbers` what the stream says of itself by key
    (ORIN, GPSU; TSMP, GPSF).
    """

    device: str
    key: str
    values: F64
    texts: Mapping[str, str]
    numbers: Mapping[str, F64]


@dataclass
class Damage:
    """What had to be dropped: bytes that are no items, and series whose samples make no sense."""

    dropped_bytes: int = 0
    refused: int = 0


@dataclass(frozen=True)
class Item:
    """One key with its value: the type's character, bytes per sample and the samples' bytes."""

    key: str
    type: int
    size: int
    value: bytes


def read_series(payload: bytes, damage: Damage | None = None) -> Iterator[Series]:
    """The series of one payload, device by device. Never raises; what is damaged is counted and left out."""
    damage = damage or Damage()
    for device in read_items(payload, damage):
        if device.key != "DEVC" or device.type != _NESTED:
            continue
        name = ""
        for item in read_items(device.value, damage):
            if item.key == "DVNM":
                name = _text(item)
            elif item.key == "STRM" and item.type == _NESTED:
                series = _read_stream(name, item.value, damage)
                if series is not None:
                    yield series


def read_items(data: bytes, damage: Damage) -> Iterator[Item]:
    """The items that stand one behind the other in some bytes; ends where a length leads beyond them."""
    at = 0
    while at + _HEADER <= len(data):
        key, size, repeat = data[at : at + 4], data[at + 5], int.from_bytes(data[at + 6 : at + 8], "big")
        length = size * repeat
        if at + _HEADER + length > len(data) or not re.fullmatch(rb"[\x20-\x7e]{4}", key):
            # Cameras may fill the rest of a payload with zeros.
            damage.dropped_bytes += len(data[at:].rstrip(b"\0"))
            return
        yield Item(key.decode("ascii"), data[at + 4], size, data[at + _HEADER : at + _HEADER + length])
        at += _HEADER + -(-length // 4) * 4
    damage.dropped_bytes += len(data[at:].rstrip(b"\0"))


def _read_stream(device: str, data: bytes, damage: Damage) -> Series | None:
    """The series of a stream: what describes it, and last its samples; None where it has none."""
    items = list(read_items(data, damage))
    if not items or items[-1].type == _NESTED or chr(items[-1].type) in _TEXT:
        return None
    *described, samples = items
    texts = {item.key: _text(item) for item in described if chr(item.type) in _TEXT}
    tables = {item.key: _table(item, chr(item.type) * _columns(item)).ravel() for item in described}
    numbers = {key: values for key, values in tables.items() if len(values)}
    values = _samples(samples, texts.get("TYPE", ""), numbers.get("SCAL", np.ones(1)))
    if values is None:
        damage.refused += 1
        return None
    return Series(device, samples.key, values, texts, numbers)


def _samples(item: Item, complex_type: str, scale: F64) -> F64 | None:
    """The samples (N, M) of an item, divided by their scale; None where type, size and scale do not fit together."""
    types = _expand(complex_type) if item.type == _COMPLEX else chr(item.type) * _columns(item)
    if not types or sum(np.dtype(_NUMBERS[t]).itemsize for t in types) != item.size:
        return None
    values = _table(item, types)
    if len(scale) not in (1, values.shape[1]) or not np.all(scale):
        return None
    with np.errstate(all="ignore"):
        return np.asarray(values / scale)


def _expand(types: str) -> str:
    """The characters of a TYPE, with repetitions written out: "f[3]L" is "fffL"; empty where one is not known."""
    written = re.sub(r"(.)\[(\d{1,2})\]", lambda m: m[1] * int(m[2]), types[:_LONGEST_TYPE])
    return written if written and len(written) <= _LONGEST_TYPE and set(written) <= _NUMBERS.keys() else ""


def _columns(item: Item) -> int:
    """Numbers per sample of an item of one type; 0 for a type that is no number or a size that does not fit."""
    dtype = _NUMBERS.get(chr(item.type))
    return item.size // np.dtype(dtype).itemsize if dtype else 0


def _table(item: Item, types: str) -> F64:
    """The whole samples of an item as numbers (N, M)."""
    dtype = np.dtype([(str(i), _NUMBERS[t]) for i, t in enumerate(types)])
    if not dtype.itemsize:
        return np.zeros((0, len(types)))
    rows = np.frombuffer(item.value, dtype, len(item.value) // dtype.itemsize)
    with np.errstate(all="ignore"):  # damaged floats are any bit pattern
        columns = [rows[str(i)].astype(np.float64) * _FIXED_POINT.get(t, 1.0) for i, t in enumerate(types)]
    return np.stack(columns, axis=1)


def _text(item: Item) -> str:
    return item.value.rstrip(b"\0").decode("latin-1")
