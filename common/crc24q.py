"""The cyclic redundancy check of Galileo, SBAS and RTCM 3."""

from __future__ import annotations

_POLYNOMIAL = 0x1864CFB


def _of_byte(byte: int) -> int:
    crc = byte << 16
    for _ in range(8):
        crc = crc << 1 ^ (_POLYNOMIAL if crc & 0x800000 else 0)
    return crc & 0xFFFFFF


_TABLE = tuple(_of_byte(byte) for byte in range(256))


def crc24q(data: bytes) -> int:
    """The 24 bits of CRC-24Q over some bytes. Source: Galileo OS SIS ICD 5.1.9.4; RTCM 10403.3, section 4."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFFFF) ^ _TABLE[crc >> 16 ^ byte]
    return crc
