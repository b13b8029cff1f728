"""Who stands beside the sliding window: one who knows more about its frames, and one who remembers what left it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from air.odometry.quadratic import Conditional, Quadratic
from common.se3 import SE3

if TYPE_CHECKING:
    from air.odometry.window import Window


class Companion(Protocol):
    """Somebody who knows more about the frames in the window, such as GNSS.

    It keeps values of its own keys in `window.values`.
    """

    def terms(self, window: Window) -> list[Quadratic]:
        """What it knows about the frames that the window holds now."""
        ...

    def leaving(self, window: Window, k: int) -> tuple[list[int], list[Quadratic]]:
        """Own keys that leave with frame k, and all that it knows about them and that frame."""
        ...


class History(Protocol):
    """Somebody who remembers what left the window, to know it better afterwards."""

    def begun(self, k: int) -> None:
        """The window begins anew with frame k."""
        ...

    def left(self, k: int, t_ns: int, conditional: Conditional) -> None:
        """Frame k has left, with others that nobody needs any more."""
        ...

    def moved(self, newest: int, T_new_world: SE3) -> None:
        """All that was in the window, frame `newest` last, is in another world from now on."""
        ...
