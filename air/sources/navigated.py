"""The photos in a flight with a camera: frames far enough apart, where the odometry or the receiver says they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from air.jump import Jump
from air.navigation import Navigator
from air.odometry.odometry import Output, Stage, unwatched
from air.odometry.settings import OdometrySettings
from air.sources.known import known_of
from air.sources.source import Problem, Source, Truth
from common.messages import Photo


@dataclass(eq=False)
class Navigated:
    """A source of photos. `tell` is given what the odometry says, `stage` watches the parts of its work.

    `navigator` is that of the latest iteration.
    """

    source: Source
    settings: OdometrySettings
    flight: str = "offline"
    tell: Callable[[Output], None] = lambda _: None
    stage: Stage = unwatched
    navigator: Navigator | None = field(default=None, init=False)

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

    def __iter__(self) -> Iterator[Photo | Jump]:
        self.navigator = navigator = Navigator(known_of(self.source), self.flight, self.settings, self.stage)
        for measurement in self.source:
            for told in navigator.feed(measurement):
                if not isinstance(told, Photo):
                    self.tell(told)
                if isinstance(told, Photo | Jump):
                    yield told
