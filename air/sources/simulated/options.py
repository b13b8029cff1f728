"""What a simulated flight may be told in its URL: `sim:SITE?seed=1&duration=300&gnss.multipath=0&imu=perfect`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Annotated, Any, get_type_hints
from urllib.parse import parse_qsl

from air.sources.simulated.camera.video import CameraOptions
from air.sources.simulated.clocks import ClockOptions
from air.sources.simulated.extrinsics import ExtrinsicsOptions
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.imu import ImuOptions
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.simulated.sites.geotiff import GeotiffOptions
from air.sources.simulated.sites.sites import WorldOptions
from air.sources.simulated.telemetry import MavlinkOptions
from common.config import Range, parse
from common.errors import ConfigError, SourceError

PLAIN = "plain"
"""The site with nothing on it to see, whose camera stays at home."""
GEOTIFF = "geotiff"
"""The site of files that the options name: `sim:geotiff?ortho=FILE&dsm=FILE`."""
_FILES = "ortho", "dsm"
PERFECT, OFF = "perfect", "off"
DEVICES = ("imu", "gnss", "base", "mavlink", "camera")
"""What can be left at home: `base=off`."""


@dataclass(frozen=True)
class SimulationOptions:
    """A flight of `duration` s, drawn from `seed`, and the options of each of its parts; those of `off` are missing."""

    seed: Annotated[int, Range(0, 2**31 - 1)] = 1
    duration: Annotated[float, Range(1.0, 7200.0)] = 300.0
    world: WorldOptions = field(default_factory=WorldOptions)
    geotiff: GeotiffOptions = field(default_factory=GeotiffOptions)
    flight: FlightOptions = field(default_factory=FlightOptions)
    imu: ImuOptions = field(default_factory=ImuOptions)
    gnss: GnssOptions = field(default_factory=GnssOptions)
    base: GnssOptions = field(default_factory=GnssOptions.base)
    mavlink: MavlinkOptions = field(default_factory=MavlinkOptions)
    camera: CameraOptions = field(default_factory=CameraOptions)
    clock: ClockOptions = field(default_factory=ClockOptions)
    extrinsics: ExtrinsicsOptions = field(default_factory=ExtrinsicsOptions)
    off: tuple[str, ...] = ()


_HINTS = get_type_hints(SimulationOptions)
_PARTS = {name: hint for name, hint in _HINTS.items() if isinstance(hint, type) and is_dataclass(hint)}


def parse_options(url: str, site: str, query: str) -> SimulationOptions:
    """The options of a flight at a site, of a query `key=value&part.key=value&part=perfect&device=off`.

    Raises SourceError, in one line, for an option that is unknown, impossible or given twice.
    """
    given: dict[str, str] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key in given:
            raise SourceError(f"source {url!r}: option {key!r} is given twice; give it once")
        given[key] = text
    if site == PLAIN:
        given.setdefault("camera", OFF)
    elif site == GEOTIFF:
        given |= {f"{GEOTIFF}.{name}": given.pop(name) for name in _FILES if name in given}
    else:
        given["world.site"] = site
    try:
        return parse(_table(given), SimulationOptions)
    except ConfigError as error:
        raise SourceError(f"source {url!r}: {error}") from error


def _table(given: dict[str, str]) -> dict[str, Any]:
    """The options as a table of values; those of a part come on top of what the part is by itself."""
    table: dict[str, Any] = {"base": asdict(GnssOptions.base()), "off": []}
    for key in sorted(given, key=lambda key: "." in key):  # a part as a whole comes before what is different in it
        text, (name, dot, inner) = given[key], key.partition(".")
        if not dot and name in _PARTS:
            table |= _whole(name, text, table["off"])
        elif dot and name in _PARTS:
            table.setdefault(name, {})[inner] = _value(text, get_type_hints(_PARTS[name]), inner)
        elif key == "off":
            raise ConfigError(f"off is {text!r}; allowed: {', '.join(f'{device}=off' for device in DEVICES)}")
        else:
            table[key] = _value(text, _HINTS, key)
    return table


def _whole(name: str, text: str, off: list[str]) -> dict[str, Any]:
    """What `part=perfect` or `device=off` sets."""
    perfect = getattr(_PARTS[name], PERFECT, None)
    if text == PERFECT and perfect is not None:
        return {name: asdict(perfect())}
    if text == OFF and name in DEVICES:
        return {"off": [*off, name]}
    known = [*([PERFECT] if perfect else []), *([OFF] if name in DEVICES else [])]
    keys = ", ".join(f"{name}.{f.name}" for f in fields(_PARTS[name]))
    raise ConfigError(f"{name} is {text!r}; allowed: {' or '.join([*known, 'one of its options'])}: {keys}")


def _value(text: str, hints: dict[str, Any], name: str) -> int | float | str:
    """Text as the number that a field wants, or as it is where it wants none or the text is none."""
    if hints.get(name) in (int, float):
        for kind in (int, float):
            with suppress(ValueError):
                return kind(text)
    return text
