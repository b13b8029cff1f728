"""Planes of a map tile as standard images: PNG (one channel, 1, 8 or 16 bit) and baseline JPEG.

Every decoder reads the size from the header before it unpacks anything, so a small file cannot ask for a large
image. Raises ValueError for bytes that are not such an image.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import cv2
import numpy as np

from common.arrays import F32, U8, U16, Bool

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_START_OF_FRAME = {0xC0, 0xC1}  # baseline and extended sequential; progressive files can be made to decode for ages
_OTHER_FRAMES = set(range(0xC2, 0xD0)) - {0xC4, 0xC8, 0xCC}
_START_OF_SCAN = 0xDA


def encode_png(plane: U8 | U16 | Bool) -> bytes:
    """PNG of a plane (rows, columns): 8 or 16 bit grey, or 1 bit for bool.

    Run-length matching only: as small as full deflate on such planes and several times faster.
    """
    options = [cv2.IMWRITE_PNG_COMPRESSION, 6, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    if plane.dtype == bool:
        return _encode(".png", plane.astype(np.uint8), [*options, cv2.IMWRITE_PNG_BILEVEL, 1])
    return _encode(".png", plane, options)


def decode_png(data: bytes, size: int, bit_depth: int) -> U8 | U16 | Bool:
    """Plane (size, size) uint8, uint16 or bool of a grey PNG that has exactly this size and bit depth.

    Raises ValueError for any other bytes, damaged ones included.
    """
    width, height, depth, colour_type, interlace = _png_header(data)
    if (width, height) != (size, size):
        raise ValueError(f"is {width} x {height} px, not {size} x {size}")
    if (depth, colour_type, interlace) != (bit_depth, 0, 0):
        raise ValueError(f"has bit depth {depth} and colour type {colour_type}, not {bit_depth} bit grey")
    plane: U8 | U16 = _decode(data, cv2.IMREAD_UNCHANGED)
    if plane.shape != (size, size):
        raise ValueError(f"decodes to shape {plane.shape}")
    return plane > 0 if bit_depth == 1 else plane


def encode_jpeg(colour: U8, quality: int) -> bytes:
    """Baseline JPEG of an RGB image (rows, columns, 3).

    Chroma is halved (4:2:0): on aerial photos 0.7 to 0.9 times the error of 4:4:4 at the same size.
    """
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1, *sampling]
    return _encode(".jpg", np.ascontiguousarray(colour[..., ::-1]), options)


def decode_jpeg(data: bytes, size: int) -> U8:
    """RGB image (size, size, 3) of a baseline JPEG of exactly this size. Raises ValueError for any other bytes."""
    if jpeg_size(data) != (size, size):
        raise ValueError("is {} x {} px, not {} x {}".format(*jpeg_size(data), size, size))
    bgr = _decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if bgr.shape != (size, size, 3):
        raise ValueError(f"decodes to shape {bgr.shape}")
    return np.ascontiguousarray(bgr[..., ::-1])


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height px in the header of a baseline JPEG. Raises ValueError for any other bytes (ITU-T T.81, B.2)."""
    if data[:2] != b"\xff\xd8" or data[-2:] != b"\xff\xd9":
        raise ValueError("is not a whole JPEG")
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4])
        if marker in _START_OF_FRAME and at + 10 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        if marker in _OTHER_FRAMES:
            raise ValueError("is not a baseline JPEG")
        if marker == _START_OF_SCAN:
            break
        at += 2 + length
    raise ValueError("has no JPEG frame header")


def fill_smoothly(colour: U8, known: Bool) -> U8:
    """The image (rows, columns, 3) with unknown pixels filled from the known ones around, so that JPEG does not ring.

    Push–pull over a pyramid (Gortler et al., The Lumigraph, 1996, section 3.4); black when nothing is known.
    """
    if known.all():
        return colour
    filled = _push_pull(colour.astype(np.float32), known.astype(np.float32))
    return np.where(known[..., None], colour, np.rint(filled).clip(0, 255).astype(np.uint8))


def _push_pull(colour: F32, weight: F32) -> F32:
    """Colours (rows, columns, 3) where those of weight 0 come from the next coarser level of the pyramid."""
    rows, columns = weight.shape
    if weight.all() or (rows == 1 and columns == 1):
        return colour
    half = ((columns + 1) // 2, (rows + 1) // 2)
    small_weight = cv2.resize(weight, half, interpolation=cv2.INTER_AREA)
    small_sum = cv2.resize(colour * weight[..., None], half, interpolation=cv2.INTER_AREA)
    small = small_sum / np.maximum(small_weight, 1e-6)[..., None]
    coarse = _push_pull(small, (small_weight > 0).astype(np.float32))
    pulled = cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.where(weight[..., None] > 0, colour, pulled)


def _png_header(data: bytes) -> tuple[int, int, int, int, int]:
    """Width, height, bit depth, colour type, interlace of a PNG whose every chunk has a right checksum (RFC 2083)."""
    if data[:8] != _PNG_SIGNATURE:
        raise ValueError("is not a PNG")
    kinds: list[bytes] = []
    at = 8
    while at + 12 <= len(data) and (not kinds or kinds[-1] != b"IEND"):
        length = int.from_bytes(data[at : at + 4])
        body_end = at + 8 + length
        if zlib.crc32(data[at + 4 : body_end]) != int.from_bytes(data[body_end : body_end + 4]):
            raise ValueError("is a damaged PNG")
        kinds.append(data[at + 4 : at + 8])
        at = body_end + 4
    if at != len(data) or len(kinds) < 3 or {*kinds[1:-1]} != {b"IDAT"} or (kinds[0], kinds[-1]) != (b"IHDR", b"IEND"):
        raise ValueError("is not a whole PNG of header and data alone")
    if int.from_bytes(data[8:12]) != 13:
        raise ValueError("has no PNG header")
    width, height, depth, colour_type, _, _, interlace = struct.unpack_from(">IIBBBBB", data, 16)
    return width, height, depth, colour_type, interlace


def _encode(suffix: str, image: Any, options: list[int]) -> bytes:
    _, buffer = cv2.imencode(suffix, image, options)
    return bytes(buffer)


def _decode(data: bytes, flags: int) -> Any:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise ValueError("cannot be decoded") from error
    if image is None:
        raise ValueError("cannot be decoded")
    return image
