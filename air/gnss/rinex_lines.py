"""Lines of a RINEX file and the numbers in their columns, however damaged."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator


class Lines:
    """Iterator of lines that counts them and those that were damaged, and can take the last line back."""

    def __init__(self, lines: Iterable[str]):
        self._lines = iter(lines)
        self._returned: str | None = None
        self.read = 0
        self.damaged = 0
        self.first_damage = ""

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        if self._returned is not None:
            line, self._returned = self._returned, None
            return line
        line = next(self._lines)
        self.read += 1
        return line.rstrip("\r\n")

    def give_back(self, line: str) -> None:
        """Let the next reader have this line again."""
        self._returned = line

    def damage(self, line: str) -> None:
        """Count a line, or the record that it begins, as damaged."""
        self.damaged += 1
        self.first_damage = self.first_damage or f"line {self.read}: {line[:40].strip()!r}"


def number(text: str) -> float:
    """The finite number that a column holds, NaN for a blank or senseless one. Exponents may be written with D."""
    try:
        value = float(text.replace("D", "E").replace("d", "E"))
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def numbers(line: str, start: int, width: int, count: int) -> tuple[float, ...]:
    """`count` numbers in columns of `width` from `start` on."""
    return tuple(number(line[i : i + width]) for i in range(start, start + count * width, width))
