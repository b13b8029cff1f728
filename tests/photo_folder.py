"""Photos of a simulated survey as files that a drone's camera would write: EXIF with time, place and lens."""

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

from PIL import Image, TiffImagePlugin

from air.sources.exif import EPOCH
from common.messages import GnssFix, Photo

FOCAL_MM = 4.5


def write_photo(folder: Path, photo: Photo, name: str = "", clock: datetime | None = None) -> Path:
    """Write a photo, without position if it has no fix, under another name or with another clock if asked."""
    path = folder / (name or photo.name)
    path.write_bytes(with_exif(photo, clock or EPOCH + timedelta(microseconds=photo.t_ns // 1000)))
    return path


def with_exif(photo: Photo, clock: datetime) -> bytes:
    """The photo's JPEG, pixels untouched, with an EXIF segment behind its first marker."""
    exif = Image.Exif()
    ifd = exif.get_ifd(0x8769)
    ifd[0x9003] = clock.strftime("%Y:%m:%d %H:%M:%S")
    ifd[0x9291] = f"{clock.microsecond:06d}"
    if photo.camera is not None:
        ifd.update({0x920A: rational(FOCAL_MM), 0xA20E: rational(photo.camera.fx / FOCAL_MM), 0xA210: 4})
        ifd.update({0xA002: photo.camera.width, 0xA003: photo.camera.height})
    if photo.fix is not None:
        exif.get_ifd(0x8825).update(_gps(photo.fix))
    body = exif.tobytes()
    return photo.jpeg[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2) + body + photo.jpeg[2:]


def moved(photo: Photo, latitude_deg: float, longitude_deg: float) -> Photo:
    """The photo with its position shifted by degrees."""
    assert photo.fix is not None
    fix = photo.fix
    there = replace(fix, latitude_deg=fix.latitude_deg + latitude_deg, longitude_deg=fix.longitude_deg + longitude_deg)
    return replace(photo, fix=there)


def rational(value: float) -> TiffImagePlugin.IFDRational:
    """A number as EXIF stores it, to 1e-6."""
    return TiffImagePlugin.IFDRational(round(value * 1_000_000), 1_000_000)


def _gps(fix: GnssFix) -> dict[int, object]:
    north, east = fix.latitude_deg >= 0, fix.longitude_deg >= 0
    place = {1: "N" if north else "S", 2: _dms(fix.latitude_deg), 3: "E" if east else "W", 4: _dms(fix.longitude_deg)}
    height = {5: b"\x00" if fix.height >= 0 else b"\x01", 6: rational(abs(fix.height))}
    return place | height | {31: rational(fix.sigma_horizontal)}


def _dms(degrees: float) -> tuple[TiffImagePlugin.IFDRational, ...]:
    minutes = abs(degrees) % 1 * 60
    return rational(int(abs(degrees))), rational(int(minutes)), rational(minutes % 1 * 60)
