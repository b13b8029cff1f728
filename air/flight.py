"""What names a flight."""

from datetime import UTC, datetime


def flight_now() -> str:
    """Name of a flight that starts now: its start time in UTC as text, so names sort by time."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
