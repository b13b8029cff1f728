"""Settings of the single-point position, with defaults that work."""

from __future__ import annotations

from dataclasses import dataclass

from common.errors import ConfigError

SYSTEMS = "GREJC"


@dataclass(frozen=True)
class PositioningSettings:
    """What a position may be made of, and when it is refused.

    `systems` are the letters of RINEX; `ionosphere_free` combines two bands instead of using the broadcast
    ionosphere. A position needs `min_redundancy` ranges more than it has unknowns, and one more for each range that
    was excluded; its residuals must be such as good ranges exceed once in a thousand times.
    """

    systems: str = SYSTEMS
    elevation_mask_deg: float = 10.0
    min_cn0: float = 25.0
    ionosphere_free: bool = False
    exclude_outliers: bool = True
    min_redundancy: int = 1
    max_pdop: float = 15.0
    min_height: float = -1000.0
    max_height: float = 20_000.0
    max_speed: float = 300.0
    sigma_doppler: float = 0.2
    """One sigma of a range rate, m/s, where the receiver does not know it to be worse."""

    def __post_init__(self) -> None:
        if not self.systems or not set(self.systems) <= set(SYSTEMS):
            raise ConfigError(f"systems is {self.systems!r}; allowed are letters of {SYSTEMS}")
        if not 0.0 <= self.elevation_mask_deg < 90.0:
            raise ConfigError(f"elevation_mask_deg is {self.elevation_mask_deg}; allowed is 0 to 90")
