"""A source slowed down to the pace of its time stamps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import length_hint

from air.jump import Jump
from air.sources.source import PhotoSource, Problem, Truth
from common.messages import Photo


@dataclass(frozen=True)
class Paced:
    """Gives the photos of a source no earlier than their time stamps say, `pace` times as fast as they were taken.

    Instants are counted from the first photo, so neither a slow reader nor a slow consumer accumulates delay.
    """

    source: PhotoSource
    pace: float
    clock: Callable[[], float]
    sleep: Callable[[float], None]

    @property
    def url(self) -> str:
        """The URL of the source."""
        return self.source.url

    @property
    def truth(self) -> Truth | None:
        """The truth of the source."""
        return self.source.truth

    @property
    def problems(self) -> Sequence[Problem]:
        """The problems of the source."""
        return self.source.problems

    def __length_hint__(self) -> int:
        return length_hint(self.source)

    def __iter__(self) -> Iterator[Photo | Jump]:
        first_t_ns: int | None = None
        start_s = 0.0
        for photo in self.source:
            if first_t_ns is None:
                first_t_ns, start_s = photo.t_ns, self.clock()
            due_s = start_s + (photo.t_ns - first_t_ns) * 1e-9 / self.pace
            while (wait_s := due_s - self.clock()) > 0:
                self.sleep(wait_s)
            yield photo
