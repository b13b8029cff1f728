"""A setting is what the file says, or the default, or an error that names it and says what is allowed."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.bus import BusConfig
from common.config import Range, load, parse
from common.errors import ConfigError


class Colour(StrEnum):
    RGB = "rgb"
    HEIGHT = "height"


@dataclass(frozen=True)
class Camera:
    name: str
    rate_hz: Annotated[float, Range(0.1, 100.0)] = 20.0


@dataclass(frozen=True)
class Viewer:
    host: str = "127.0.0.1"
    port: Annotated[int, Range(1, 65535)] = 8080
    enabled: bool = True
    colour: Colour = Colour.RGB
    background: tuple[Annotated[int, Range(0, 255)], ...] = (255, 255, 255)


@dataclass(frozen=True)
class Settings:
    viewer: Viewer = field(default_factory=Viewer)
    bus: BusConfig = field(default_factory=BusConfig)
    store: Path | None = None
    quality: Literal["fast", "best"] = "fast"
    cameras: tuple[Camera, ...] = ()


def write(folder: Path, text: str) -> Path:
    path = folder / "luojia.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_work_without_a_file(tmp_path: Path) -> None:
    assert load(None, Settings) == Settings()
    assert load(write(tmp_path, ""), Settings) == Settings()


def test_every_kind_of_setting_is_read(tmp_path: Path) -> None:
    text = """
    store = "maps/a.sqlite"
    quality = "best"
    [viewer]
    port = 9000
    enabled = false
    colour = "height"
    background = [0, 128, 255]
    [bus]
    mode = "router"
    listen = ["tcp/127.0.0.1:7447"]
    [[cameras]]
    name = "left"
    [[cameras]]
    name = "right"
    rate_hz = 5
    """
    assert load(write(tmp_path, text), Settings) == Settings(
        viewer=Viewer(port=9000, enabled=False, colour=Colour.HEIGHT, background=(0, 128, 255)),
        bus=BusConfig("router", listen=("tcp/127.0.0.1:7447",)),
        store=Path("maps/a.sqlite"),
        quality="best",
        cameras=(Camera("left"), Camera("right", 5.0)),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[viewer]\nprot = 1", r"viewer.prot is not a setting; did you mean port\? Allowed: host, port, enabled"),
        ("zzz = 1", r"zzz is not a setting. Allowed: viewer, bus"),
        ("[viewer]\nport = 0", r"viewer.port is 0; allowed: 1 to 65535"),
        ("[viewer]\nport = '80'", r"viewer.port is '80'; allowed: a whole number"),
        ("[viewer]\nport = 80.0", r"viewer.port is 80.0; allowed: a whole number"),
        ("[viewer]\nport = true", r"viewer.port is True; allowed: a whole number"),
        ("[viewer]\nenabled = 1", r"viewer.enabled is 1; allowed: true or false"),
        ("[viewer]\ncolour = 'red'", r"viewer.colour is 'red'; allowed: 'rgb', 'height'"),
        ("[viewer]\nbackground = [0, 256]", r"viewer.background\[1\] is 256; allowed: 0 to 255"),
        ("[viewer]\nbackground = 3", r"viewer.background is 3; allowed: a list"),
        ("quality = 'worst'", r"quality is 'worst'; allowed: 'fast', 'best'"),
        ("viewer = 3", r"viewer is 3; allowed: a table"),
        ("store = 3", r"store is 3; allowed: text"),
        ("[[cameras]]\nrate_hz = 5", r"cameras\[0\].name is missing"),
        ("[[cameras]]\nname = 'a'\nrate_hz = nan", r"cameras\[0\].rate_hz is nan; allowed: a number"),
        ("[[cameras]]\nname = 'a'\nrate_hz = inf", r"cameras\[0\].rate_hz is inf; allowed: 0.1 to 100.0"),
        ("[bus]\nmode = 'server'", r"bus.mode is 'server'; allowed: 'peer', 'client', 'router'"),
        ("[bus]\nconnect = 'tcp/a:1'", r"bus.connect is 'tcp/a:1'; allowed: a list"),
        ("port =", r"is no TOML"),
    ],
)
def test_an_impossible_setting_is_refused_by_file_key_and_value(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ConfigError, match=message) as caught:
        load(path, Settings)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none.toml: cannot be read"):
        load(tmp_path / "none.toml", Settings)
    with pytest.raises(ConfigError, match="cannot be read"):
        load(tmp_path, Settings)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="is no TOML"):
        load(binary, Settings)


TOML = st.recursive(
    st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=5,
)
KEYS = st.sampled_from(["viewer", "bus", "store", "quality", "cameras", "port", "background", "name", "x"])


@given(st.dictionaries(KEYS, TOML | st.dictionaries(KEYS, TOML, max_size=3), max_size=4))
def test_any_table_is_settings_or_a_config_error(table: dict[str, Any]) -> None:
    try:
        assert isinstance(parse(table, Settings), Settings)
    except ConfigError:
        return
