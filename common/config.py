"""TOML → nested frozen dataclasses with defaults.

A field is a bool, int, float, str, Path, StrEnum or Literal, a dataclass, a tuple of those (`tuple[T, ...]`), or one
of them or None. `Annotated[float, Range(0, 1)]` bounds a number. Any unknown key and any impossible value is refused.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from common.errors import ConfigError

T = TypeVar("T")


@dataclass(frozen=True)
class Range:
    """What a number may be, both ends included."""

    low: float = -math.inf
    high: float = math.inf

    def __str__(self) -> str:
        return f"{self.low} to {self.high}"


def load(path: Path | None, settings: type[T]) -> T:
    """Settings of a TOML file, or the defaults when `path` is None.

    Raises ConfigError naming the file, the key, the value and what is allowed.
    """
    if path is None:
        return parse({}, settings)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is no TOML: {error}") from error
    try:
        return parse(table, settings)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def parse(table: dict[str, Any], settings: type[T]) -> T:
    """Settings of a parsed TOML table. Raises ConfigError naming the key, the value and what is allowed."""
    result: T = _dataclass(table, settings, "")
    return result


def _dataclass(table: Any, settings: type[Any], at: str) -> Any:
    if not isinstance(table, dict):
        raise _refusal(at, table, "a table")
    hints = get_type_hints(settings, include_extras=True)
    known = {f.name: f for f in fields(settings) if f.init}
    for key in table:
        if key not in known:
            raise ConfigError(_unknown(key, list(known), at))
    for name, f in known.items():
        if name not in table and f.default is MISSING and f.default_factory is MISSING:
            raise ConfigError(f"{_join(at, name)} is missing")
    return settings(**{key: _value(value, hints[key], _join(at, key)) for key, value in table.items()})


def _value(value: Any, hint: Any, at: str) -> Any:
    """The value as the type that the hint names."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _ranged(_value(value, args[0], at), args[1:], at)
    if origin in (Union, UnionType):
        (inner,) = (arg for arg in args if arg is not NoneType)
        return _value(value, inner, at)
    if origin is Literal:
        return _choice(value, list(args), at)
    if origin is tuple:
        if not isinstance(value, list):
            raise _refusal(at, value, "a list")
        return tuple(_value(item, args[0], f"{at}[{i}]") for i, item in enumerate(value))
    if is_dataclass(hint) and isinstance(hint, type):
        return _dataclass(value, hint, at)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(_choice(value, [member.value for member in hint], at))
    return _scalar(value, hint, at)


def _scalar(value: Any, hint: Any, at: str) -> Any:
    if hint is float and type(value) is int:
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value).expanduser()
    if type(value) is hint and not (hint is float and math.isnan(value)):
        return value
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "text"}
    raise _refusal(at, value, names[hint])


def _ranged(value: Any, bounds: tuple[Any, ...], at: str) -> Any:
    for bound in bounds:
        if isinstance(bound, Range) and value is not None:
            for item in value if isinstance(value, tuple) else (value,):
                if not bound.low <= item <= bound.high:
                    raise _refusal(at, value, str(bound))
    return value


def _choice(value: Any, allowed: list[Any], at: str) -> Any:
    for choice in allowed:
        if type(value) is type(choice) and value == choice:
            return choice
    raise _refusal(at, value, ", ".join(map(repr, allowed)))


def _unknown(key: str, known: list[str], at: str) -> str:
    near = difflib.get_close_matches(key, known, 1)
    hint = f"; did you mean {near[0]}?" if near else "."
    return f"{_join(at, key)} is not a setting{hint} Allowed: {', '.join(known)}"


def _refusal(at: str, value: Any, allowed: str) -> ConfigError:
    return ConfigError(f"{at} is {value!r}; allowed: {allowed}")


def _join(at: str, name: str) -> str:
    return f"{at}.{name}" if at else name
