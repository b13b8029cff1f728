"""Pacing: no more bytes than the link carries, because priorities alone do not help once its buffers are full."""

from __future__ import annotations

from collections.abc import Callable


class TokenBucket:
    """Lets `bytes_per_s` through in the long run and `burst` bytes at once after a pause (token bucket, RFC 2697)."""

    def __init__(self, bytes_per_s: float, burst: float, clock: Callable[[], float]) -> None:
        """`clock` tells monotonic seconds."""
        self._bytes_per_s = bytes_per_s
        self._burst = burst
        self._clock = clock
        self._tokens = burst
        self._filled_s = clock()

    def take(self, size: int) -> float:
        """Seconds to wait before `size` bytes may be sent; they count as sent, so the next one waits behind them."""
        now_s = self._clock()
        self._tokens = min(self._burst, self._tokens + (now_s - self._filled_s) * self._bytes_per_s)
        self._filled_s = now_s
        self._tokens -= size
        return max(0.0, -self._tokens / self._bytes_per_s)
