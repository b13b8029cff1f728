"""How the pose is known at the moment, as a mode that neither flickers nor lags."""

from __future__ import annotations

from air.odometry.settings import DegradationSettings
from common.messages import Mode

_MODES = {
    (True, True): Mode.GNSS_VISUAL_INERTIAL,
    (False, True): Mode.VISUAL_INERTIAL,
    (True, False): Mode.GNSS_INERTIAL,
    (False, False): Mode.INERTIAL,
}


class Hysteresis:
    """A yes or no that changes only after it has been contradicted for a while."""

    def __init__(self, value: bool, lost_s: float, back_s: float) -> None:
        self.value = value
        self._patience_ns = {True: round(lost_s * 1e9), False: round(back_s * 1e9)}
        self._since_ns: int | None = None

    def update(self, t_ns: int, holds: bool, fails: bool) -> bool:
        """The value now; between `holds` and `fails` it stays."""
        if not (fails if self.value else holds):
            self._since_ns = None
            return self.value
        self._since_ns = t_ns if self._since_ns is None else self._since_ns
        if t_ns - self._since_ns >= self._patience_ns[self.value]:
            self.value, self._since_ns = not self.value, None
        return self.value


class Monitor:
    """Watches what the estimate rests on."""

    def __init__(self, settings: DegradationSettings, visual: bool = True, gnss: bool = False) -> None:
        """`visual` and `gnss` are what it begins with."""
        s = self._settings = settings
        self._visual = Hysteresis(visual, s.lost_s, s.back_s)
        self._gnss = Hysteresis(gnss, s.lost_s, s.back_s)

    def found_gnss(self) -> None:
        """GNSS counts from now on: it has just been found to agree."""
        self._gnss.value = True

    def update(self, t_ns: int, points: int, satellites: int = 0) -> Mode:
        """The mode after a frame in which so many points with a known place, and satellites, were used."""
        s = self._settings
        visual = self._visual.update(t_ns, points >= s.enough_points, points < s.few_points)
        gnss = self._gnss.update(t_ns, satellites >= s.enough_satellites, satellites < s.few_satellites)
        return _MODES[gnss, visual]
