"""A folder of drone photos in the order in which they were taken."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from air.sources.exif import ATTITUDE_SIGMA, PhotoFacts, read_facts
from air.sources.source import Problem, Truth
from common.arrays import F64
from common.errors import SourceError
from common.messages import Photo

MAX_CLOCK_ERROR_S = 86_400.0
"""A photo further than this from the median time of the folder has a wrong clock."""
DEFAULT_INTERVAL_S = 1.0


class PhotoFolder:
    """The JPEGs of a folder (not of its sub-folders), opened as `photos:DIR`.

    Headers are read at once, to order the photos; pixels one photo at a time. Raises SourceError for a folder that
    is missing or holds no JPEG.
    """

    def __init__(self, url: str, folder: str):
        self._url = url
        files = _jpegs(url, folder)
        facts = [_facts(file) for file in files]
        self._problems = [
            Problem(file.name, text) for file, fact in zip(files, facts, strict=True) for text in fact.trouble
        ]
        order, stamps_ns = self._in_time_order(files, [fact.t_ns for fact in facts])
        self._photos = [(stamps_ns[k], files[i], facts[i]) for k, i in enumerate(order)]

    @property
    def url(self) -> str:
        """The URL that opened the folder."""
        return self._url

    @property
    def truth(self) -> Truth | None:
        """None: nobody knows the truth of a real flight."""
        return None

    @property
    def problems(self) -> Sequence[Problem]:
        """Photos without readable header, believable position or believable clock, and files that vanished."""
        return self._problems

    def __len__(self) -> int:
        return len(self._photos)

    def __iter__(self) -> Iterator[Photo]:
        for t_ns, file, facts in self._photos:
            try:
                jpeg = file.read_bytes()
            except OSError as error:
                self._problems.append(Problem(file.name, f"cannot be read: {error.strerror}"))
                continue
            sigma = 0.0 if facts.R_enu_cam is None else ATTITUDE_SIGMA
            yield Photo(t_ns, file.name, jpeg, facts.camera, facts.fix, facts.R_enu_cam, sigma)

    def _in_time_order(self, files: list[Path], clocks_ns: list[int | None]) -> tuple[list[int], list[int]]:
        """The order of the files and their strictly increasing stamps; photos with a bad clock are noted."""
        clock_s = np.array([np.nan if t is None else t * 1e-9 for t in clocks_ns])
        median_s = np.nanmedian(clock_s) if np.isfinite(clock_s).any() else np.nan
        believed = np.abs(clock_s - median_s) <= MAX_CLOCK_ERROR_S
        for file, t_s, good in zip(files, clock_s, believed, strict=True):
            if not good:
                text = "has no clock time" if np.isnan(t_s) else "has a clock time more than a day from the others'"
                self._problems.append(Problem(file.name, text + "; ordered by its file name"))
        order = _time_order(clock_s, believed)
        return order, _stamps([clocks_ns[i] if believed[i] else None for i in order])


def _facts(file: Path) -> PhotoFacts:
    try:
        return read_facts(file.read_bytes())
    except OSError:  # reported when its turn comes
        return PhotoFacts()


def _jpegs(url: str, folder: str) -> list[Path]:
    """JPEG files of a folder by name, numbers compared as numbers."""
    path = Path(folder).expanduser()
    if not path.is_dir():
        if "?" in folder and Path(folder.partition("?")[0]).expanduser().is_dir():
            raise SourceError(f"source {url!r} has options after '?', but photos:DIR takes none")
        what = "is a file, not a folder" if path.exists() else "does not exist"
        raise SourceError(f"source {url!r}: the folder {str(path)!r} {what}")
    files = [file for file in path.iterdir() if file.suffix.lower() in (".jpg", ".jpeg") and file.is_file()]
    if not files:
        raise SourceError(f"source {url!r}: the folder {str(path)!r} holds no *.jpg or *.jpeg")
    return sorted(files, key=lambda file: _natural(file.name))


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts IMG_9 before IMG_10."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(0, int(part), part) if part[0].isdigit() else (1, 0, part) for part in parts]


def _time_order(clock_s: F64, believed: np.typing.NDArray[np.bool_]) -> list[int]:
    """Indices by time; a photo without a believed clock follows the photo before it in name order."""
    anchor: tuple[float, int] = (-np.inf, -1)
    keys = []
    for i, (t_s, good) in enumerate(zip(clock_s, believed, strict=True)):
        if good:
            anchor = (t_s, i)
        keys.append((*anchor, i))
    return sorted(range(len(keys)), key=keys.__getitem__)


def _stamps(clocks_ns: list[int | None]) -> list[int]:
    """Strictly increasing stamps; missing ones are interpolated, or continue at the usual interval at the ends."""
    known = [i for i, t_ns in enumerate(clocks_ns) if t_ns is not None]
    if not known:
        return [round(i * DEFAULT_INTERVAL_S * 1e9) for i in range(len(clocks_ns))]
    first_ns = min(t_ns for t_ns in clocks_ns if t_ns is not None)
    relative_ns = np.array([(clocks_ns[i] or 0) - first_ns for i in known], float)
    gaps = np.diff(relative_ns)
    interval_ns = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else DEFAULT_INTERVAL_S * 1e9
    i = np.arange(len(clocks_ns))
    stamps = np.interp(i, known, relative_ns)
    stamps += interval_ns * (np.minimum(i - known[0], 0) + np.maximum(i - known[-1], 0))
    whole = np.round(stamps).astype(np.int64)
    increasing = np.maximum.accumulate(whole - i) + i
    return [first_ns + int(t_ns) for t_ns in increasing]
