"""Who stands beside the sliding window: one who knows more about its frames, and one who remembers what left it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from air.odometry.quadratic import Conditional, Quadratic

if TYPE_CHECKING:
    from air.odometry.window import Window


class Companion(Protocol):
    """Somebody who knows more about the frames in the window, such as GNSS.

    It keeps values of its own keys in `window.values`.
    """

    def terms(self, window: Window) -> list[Quadratic]:
        """What it knows about the frames that the window holds now."""
        ...

    def leaving(self, k: int) -> tuple[list[int], list[Quadratic]]:
        """Own keys that leave with frame k, and all that it knows about them and that frame."""
        ...


class History(Protocol):
    """Somebody who remembers what left the window, to know it better afterwards."""

    def left(self, window: Window, conditional: Conditional) -> None:
        """The oldest frame is about to leave, with others that nobody needs any more."""
        ...

    def moving(self, window: Window) -> None:
        """Another world is about to begin for all that the window holds."""
        ...

    def ended(self, window: Window) -> None:
        """What the window holds stays as it is: it begins anew, or not at all."""
        ...
