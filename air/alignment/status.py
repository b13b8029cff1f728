"""What became of each photo."""

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """What became of a photo."""

    PLACED = "placed"
    WAITING = "waiting"
    REJECTED = "rejected"


@dataclass(frozen=True)
class PhotoStatus:
    """What became of a photo, with the reason where it is not simply placed."""

    name: str
    state: State
    reason: str
