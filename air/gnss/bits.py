"""Fields of navigation messages: where their bits lie, read from and written into whole numbers.

A message has parts of equal length (subframes, pages, words, strings), joined to one number, the first bit of the
first part its most significant. Bits are counted from 1, as the interface documents do.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, auto

SEMICIRCLE = 3.1415926535898
"""π as the interface documents define it: orbits are computed with this value."""


class Sign(Enum):
    """How a field says that it is negative."""

    NONE = auto()
    TWOS_COMPLEMENT = auto()
    MAGNITUDE = auto()


@dataclass(frozen=True)
class Field:
    """A number of a message: the unit of its last bit, and its bits as spans (part, first bit, length)."""

    name: str
    sign: Sign
    scale: float
    spans: tuple[tuple[int, int, int], ...]

    @property
    def length(self) -> int:
        """How many bits the field has."""
        return sum(length for _, _, length in self.spans)


def unsigned(name: str, scale: float, *spans: tuple[int, int, int]) -> Field:
    """A field that is never negative."""
    return Field(name, Sign.NONE, float(scale), spans)


def signed(name: str, scale: float, *spans: tuple[int, int, int]) -> Field:
    """A field in two's complement."""
    return Field(name, Sign.TWOS_COMPLEMENT, float(scale), spans)


def magnitude(name: str, scale: float, *spans: tuple[int, int, int]) -> Field:
    """A field whose first bit is the sign of the rest, as GLONASS writes them."""
    return Field(name, Sign.MAGNITUDE, float(scale), spans)


@dataclass(frozen=True)
class Layout:
    """All fields of a message of `parts` parts, `part_bits` bits each."""

    parts: int
    part_bits: int
    fields: tuple[Field, ...]

    def read(self, parts: Iterable[int]) -> dict[str, float]:
        """The values of all fields by name; flags and counts are whole numbers."""
        bits = self._joined(parts)
        return {field.name: self._raw(bits, field) * field.scale for field in self.fields}

    def write(self, values: Mapping[str, float], parts: Iterable[int] | None = None) -> list[int]:
        """The parts with these values, rounded to the last bit of each field; bits of no field as in `parts`, or 0.

        Raises ValueError naming a field whose value does not fit.
        """
        bits = self._joined(parts) if parts is not None else 0
        for field in self.fields:
            rest = _unsigned(field, round(values[field.name] / field.scale))
            for span in reversed(field.spans):
                mask = (1 << span[2]) - 1
                shift = self._shift(span)
                bits = bits & ~(mask << shift) | (rest & mask) << shift
                rest >>= span[2]
        size, mask = self.part_bits, (1 << self.part_bits) - 1
        return [bits >> size * (self.parts - 1 - i) & mask for i in range(self.parts)]

    def _joined(self, parts: Iterable[int]) -> int:
        bits = 0
        for part in parts:
            bits = bits << self.part_bits | part
        return bits

    def _shift(self, span: tuple[int, int, int]) -> int:
        part, first, length = span
        return self.part_bits * (self.parts - part + 1) - first - length + 1

    def _raw(self, bits: int, field: Field) -> int:
        raw = 0
        for span in field.spans:
            raw = raw << span[2] | bits >> self._shift(span) & (1 << span[2]) - 1
        half = 1 << field.length - 1
        if field.sign is Sign.NONE or raw < half:
            return raw
        return raw - 2 * half if field.sign is Sign.TWOS_COMPLEMENT else half - raw


def _unsigned(field: Field, raw: int) -> int:
    """The bits of a signed number as a number that is not negative."""
    half = 1 << field.length - 1
    low, high = {
        Sign.NONE: (0, 2 * half - 1),
        Sign.TWOS_COMPLEMENT: (-half, half - 1),
        Sign.MAGNITUDE: (1 - half, half - 1),
    }[field.sign]
    if not low <= raw <= high:
        raise ValueError(
            f"{field.name} is {raw * field.scale:g}; allowed: {low * field.scale:g} to {high * field.scale:g}"
        )
    if raw >= 0:
        return raw
    return raw + 2 * half if field.sign is Sign.TWOS_COMPLEMENT else half - raw


def bits_of(number: int, width: int, first: int, length: int) -> int:
    """The bits `first` (from 1) and following of a number of `width` bits, as a number."""
    return number >> width - first - length + 1 & (1 << length) - 1


def joined(words: Iterable[int], width: int) -> int:
    """Words of `width` bits as one number, the first its most significant."""
    number = 0
    for word in words:
        number = number << width | word & (1 << width) - 1
    return number


def split(number: int, count: int, width: int) -> tuple[int, ...]:
    """A number as `count` words of `width` bits, the most significant first."""
    return tuple(number >> width * (count - 1 - i) & (1 << width) - 1 for i in range(count))


def ura_m(index: float) -> float:
    """Accuracy, m, of a GPS or BeiDou user range accuracy index; NaN for 15, "do not use".

    Source: IS-GPS-200, 20.3.3.3.1.3: 2^(1 + N/2) m, with 2.8, 5.7 and 11.3 as rounded there, then 2^(N − 2) m.
    """
    n = int(index)
    if n >= 15:
        return math.nan
    return round(2.0 ** (1 + n / 2), 1) if n <= 6 else 2.0 ** (n - 2)


def ura_index(accuracy: float) -> int:
    """The smallest user range accuracy index that is at least as large as an accuracy, m; 15 for NaN."""
    return next((n for n in range(15) if ura_m(n) >= accuracy - 1e-9), 15)
