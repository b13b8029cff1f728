"""What every source looks like, and how one is opened by its URL."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence, Sized
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from air.jump import Jump
from common.errors import SourceError
from common.measurements import Measurement
from common.messages import Photo


@dataclass(frozen=True)
class Problem:
    """Something wrong that the source could work around: where (a photo's file name, a device) and what."""

    name: str
    text: str


class Truth(Protocol):
    """What a simulated flight knows and an estimator does not."""

    def write(self, folder: Path) -> None:
        """Write trajectory, datum, camera and surface as files into a folder, creating it."""
        ...


Sensed = Measurement | Photo
"""What a source can give."""


class Described(Protocol):
    """What every source says of itself. `truth` is None for real flights."""

    @property
    def url(self) -> str:
        """The URL that opened the source."""
        ...

    @property
    def truth(self) -> Truth | None:
        """The truth of a simulated flight."""
        ...

    @property
    def problems(self) -> Sequence[Problem]:
        """What was wrong on the way, as far as known: complete once the iteration has ended."""
        ...


class Source(Described, Protocol):
    """Measurements and photos in the order in which they came."""

    def __iter__(self) -> Iterator[Sensed]: ...


class PhotoSource(Described, Protocol):
    """Photos, and the jumps of the world in which the odometry placed them. One that knows how many has a length."""

    def __iter__(self) -> Iterator[Photo | Jump]: ...


def open_source(url: str) -> Source:
    """The source that a URL names, e.g. `photos:flights/monday`, `ubx:rover.ubx` or `monday.mcap`.

    Raises SourceError, in one line, for an unknown scheme, something that cannot be read, or an option that is
    unknown or impossible.
    """
    scheme, colon, rest = url.partition(":")
    if not colon and url.endswith(".mcap"):
        scheme, rest = "mcap", url
    if scheme not in _OPENERS:
        schemes = ", ".join(sorted(_OPENERS))
        raise SourceError(f"source {url!r} has no known scheme; use one of {schemes}, for example photos:DIR")
    return _OPENERS[scheme](url, rest)


def _navigated(source: Source) -> PhotoSource:
    # Imported when needed, as are the readers of formats below.
    from air.odometry.settings import OdometrySettings
    from air.sources.navigated import Navigated

    return Navigated(source, OdometrySettings())


def open_photos(
    url: str,
    pace: float | None = None,
    *,
    photos_of: Callable[[Source], PhotoSource] = _navigated,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> PhotoSource:
    """The photos that a URL names, e.g. `photos:flights/monday` or `sim:survey?seed=1&photos=60`.

    Of a source of camera frames `photos_of` makes them: by default frames far enough apart, at the positions that
    the odometry or the receiver tells. `pace` None gives photos as fast as
    they can be read, 1.0 at the pace of their time stamps, 2.0 twice as fast.
    `clock` (monotonic, s) and `sleep` (s) serve the pace. Raises SourceError, in one line, like `open_source`.
    """
    if pace is not None and not 0.0 < pace < float("inf"):
        raise SourceError(f"source {url!r}: pace is {pace}, must be a positive number (1 = as flown)")
    source = open_source(url)
    photos = cast(PhotoSource, source) if isinstance(source, Sized) else photos_of(source)
    if pace is None:
        return photos
    from air.sources.pace import Paced

    return Paced(photos, pace, clock, sleep)


def _open_photos(url: str, rest: str) -> Source:
    # Imported when needed: a folder of photos needs no compiler, the simulator no image reader.
    from air.sources.photos import PhotoFolder

    return PhotoFolder(url, rest)


def _open_simulated(url: str, rest: str) -> Source:
    if rest.partition("?")[0] == "survey":
        from air.sources.simulated.survey import open_survey

        return open_survey(url, rest)
    from air.sources.simulated.flown import open_flight

    return open_flight(url, rest)


def _importer(module: str, function: str) -> Callable[[str, str], Source]:
    """An opener in a module that is loaded when it is first used, with the libraries that read its format."""

    def open_lazily(url: str, rest: str) -> Source:
        source: Source = getattr(import_module(f"air.sources.{module}"), function)(url, rest)
        return source

    return open_lazily


def _device(module: str, driver: str) -> Callable[[str, str], Source]:
    """An opener of files of the bytes that a device sent, played through its driver."""

    def open_lazily(url: str, rest: str) -> Source:
        from air.sources.device_file import DeviceFile

        return DeviceFile(url, rest, getattr(import_module(f"air.sensors.{module}"), driver))

    return open_lazily


_OPENERS: dict[str, Callable[[str, str], Source]] = {
    "photos": _open_photos,
    "sim": _open_simulated,
    "ubx": _device("gnss_ublox", "UbloxReceiver"),
    "xbus": _device("imu_xsens", "XsensImu"),
    "mavlink": _importer("mavlink_file", "open_mavlink"),
    "bag": _importer("bag", "open_bag"),
    "euroc": _importer("euroc", "open_euroc"),
    "gopro": _importer("gopro", "open_gopro"),
    "ulog": _importer("ulog", "open_ulog"),
    "ardupilot": _importer("ardupilot", "open_ardupilot"),
    "cuav": _importer("cuav", "open_cuav"),
    "rinex": _importer("rinex", "open_rinex"),
    "mcap": _importer("recorded", "RecordedSource"),
    "comma2k19": _importer("comma2k19", "open_comma2k19"),
    "live": _importer("live", "open_live"),
    "video": _importer("video", "open_video"),
}
