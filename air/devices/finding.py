"""What is plugged into this computer: serial ports and cameras, and what they are as far as USB tells."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

STABLE = Path("/dev")
VIDEO = Path("/sys/class/video4linux")

_BY_PRODUCT = {
    (0x1546, 0x01A8): "GNSS receiver u-blox 8",
    (0x1546, 0x01A9): "GNSS receiver u-blox F9",
    (0x2639, 0x0300): "IMU Xsens MTi",
    **{(0x0403, product): "IMU Xsens on a converter cable" for product in range(0xD388, 0xD390)},
}
_BY_VENDOR = {
    0x0403: "serial adapter FTDI",
    0x067B: "serial adapter Prolific",
    0x10C4: "serial adapter CP210x",
    0x1546: "GNSS receiver u-blox",
    0x1A86: "serial adapter CH340",
    0x2639: "Xsens device",
    0x26AC: "autopilot",
    0x2DAE: "autopilot",
    0x3162: "autopilot",
}


@dataclass(frozen=True)
class Found:
    """Something plugged in: its path (our stable name where there is one), what it is, and its serial number."""

    path: str
    what: str
    serial: str = ""


def name_of(vendor: int | None, product: int | None, description: str = "") -> str:
    """What a device is by its USB ids, or by its own description."""
    if vendor is None:
        return description if description not in ("", "n/a") else "serial port"
    known = _BY_PRODUCT.get((vendor, product or 0)) or _BY_VENDOR.get(vendor)
    ids = f"{vendor:04x}:{product or 0:04x}"
    return f"{known} ({ids})" if known else f"{description or 'USB device'} ({ids})"


def serial_ports() -> list[Found]:
    """The serial ports that have something behind them, by path."""
    stable = {str(link.resolve()): str(link) for link in STABLE.glob("luojia-*")}
    ports = [port for port in list_ports.comports() if port.vid is not None or port.hwid != "n/a"]
    return sorted(
        (
            Found(stable.get(p.device, p.device), name_of(p.vid, p.pid, p.description), p.serial_number or "")
            for p in ports
        ),
        key=lambda found: found.path,
    )


def cameras(folder: Path = VIDEO) -> list[Found]:
    """The V4L2 cameras, one entry for each: a UVC camera's further nodes carry metadata."""
    found = []
    for node in sorted(folder.glob("video*"), key=lambda node: (len(node.name), node.name)):
        try:
            index, name = ((node / item).read_text(encoding="utf-8").strip() for item in ("index", "name"))
        except (OSError, UnicodeDecodeError):
            continue
        if index == "0":
            found.append(Found(f"/dev/{node.name}", f"camera {name}"))
    return found


def everything() -> list[Found]:
    """All that is plugged in."""
    return [*serial_ports(), *cameras()]
