"""Writes GPMF: what the tests feed to its reader."""

from __future__ import annotations

import struct

import numpy as np


def item(key: str, kind: str, size: int, repeat: int, value: bytes) -> bytes:
    """One key with its value, padded to four bytes."""
    head = key.encode() + (kind.encode() if kind else b"\0") + struct.pack(">BH", size, repeat)
    return head + value + b"\0" * (-len(value) % 4)


def text(key: str, value: str) -> bytes:
    return item(key, "c", 1, len(value), value.encode("latin-1"))


def nested(key: str, *items: bytes) -> bytes:
    value = b"".join(items)
    return item(key, "", 1, len(value), value)


def table(key: str, kind: str, dtype: str, values) -> bytes:
    """Samples (N, M) of one type."""
    rows = np.atleast_2d(np.asarray(values, dtype))
    return item(key, kind, rows.shape[1] * rows.itemsize, len(rows), rows.tobytes())


def payload(*streams: bytes, device: str = "Camera") -> bytes:
    return nested("DEVC", table("DVID", "L", ">u4", [1]), text("DVNM", device), *streams)


def imu_stream(key: str, samples, total: int, *more: bytes, scale: int = 418) -> bytes:
    """A stream of three channels, whose first sample has the number `total` less its samples."""
    head = (table("TSMP", "L", ">u4", [total]), *more, table("SCAL", "s", ">i2", [scale]))
    return nested("STRM", *head, table(key, "s", ">i2", np.round(np.asarray(samples) * scale)))
