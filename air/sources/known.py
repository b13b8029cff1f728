"""What is calibrated of an aircraft before it flies, as files beside a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from air.sensors.calibration import Calibration, read_calibration, to_toml
from common.arrays import F64
from common.config import load
from common.errors import SourceError

AIRCRAFT = "aircraft"
ENDING = ".calibration"
"""Of the folder beside a recording."""


@dataclass(frozen=True, eq=False)
class Known:
    """Nominal values, as well as they are known; None is unknown.

    `cameras` by name; `p_body_antenna` (3,) m from the IMU to the phase centre of the GNSS antenna; `delays_s` from
    sampling to arrival at least, by device; `p_base_ecef` (3,) m of the antenna of the base station.
    """

    cameras: Mapping[str, Calibration] = field(default_factory=dict)
    p_body_antenna: F64 | None = None
    p_base_ecef: F64 | None = None
    delays_s: Mapping[str, float] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Write `aircraft.toml`, and `NAME.toml` of each camera, into a folder, which is created. Raises OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        lines = []
        for name, comment in _PLACES.items():
            if (place := getattr(self, name)) is not None:
                lines += [f"# {comment}", f"{name} = {place.tolist()}"]
        lines += ["", "# Least time from sampling to arrival at the computer, s.", "[delay_s]"]
        lines += [f"{device} = {delay_s!r}" for device, delay_s in self.delays_s.items()]
        texts = {AIRCRAFT: "\n".join(lines) + "\n"} | {n: to_toml(camera) for n, camera in self.cameras.items()}
        for name, text in texts.items():
            (folder / f"{name}.toml").write_text(text, encoding="utf-8")


_PLACES = {
    "p_body_antenna": "From the IMU to the phase centre of the GNSS antenna, forward, left, up, m.",
    "p_base_ecef": "The antenna of the base station, ECEF, m.",
}


@dataclass(frozen=True)
class _Delays:
    gnss: float = 0.0
    imu: float = 0.0
    mavlink: float = 0.0
    down: float = 0.0


@dataclass(frozen=True)
class _Aircraft:
    p_body_antenna: tuple[float, ...] | None = None
    p_base_ecef: tuple[float, ...] | None = None
    delay_s: _Delays = field(default_factory=_Delays)


def read_known(folder: Path) -> Known:
    """What `Known.write` wrote into a folder. Raises SourceError and ConfigError naming file and key."""
    path = folder / f"{AIRCRAFT}.toml"
    told = load(path if path.exists() else None, _Aircraft)
    places: dict[str, F64 | None] = {}
    for name in _PLACES:
        place = getattr(told, name)
        if place is not None and len(place) != 3:
            raise SourceError(f"{path}: {name} is {list(place)}; allowed: three numbers, m")
        places[name] = None if place is None else np.array(place)
    cameras = {p.stem: read_calibration(p) for p in sorted(folder.glob("*.toml")) if p != path}
    return Known(cameras, places["p_body_antenna"], places["p_base_ecef"], vars(told.delay_s))


def known_of(source: object) -> Known:
    """What is known with a source: told by it or by the folder beside it, or the calibrations that its files hold."""
    known: Known | None = getattr(source, "known", None)
    return Known(getattr(source, "calibrations", {})) if known is None else known
