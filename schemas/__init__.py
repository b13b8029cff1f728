"""The wire format as JSON Schema, one file per message and version: `load("pose", 1)` reads `pose.v1.json`."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

Schema = dict[str, Any]


def load(name: str, version: int) -> Schema:
    """The parsed schema of one message and version. Raises FileNotFoundError when there is none."""
    file = resources.files(__name__) / f"{name}.v{version}.json"
    schema: Schema = json.loads(file.read_text(encoding="utf-8"))
    return schema


def names() -> list[str]:
    """Names of all schema files without their suffix, sorted: `datum.v1`, `health.v1`, …"""
    files = (entry.name for entry in resources.files(__name__).iterdir())
    return sorted(name.removesuffix(".json") for name in files if name.endswith(".json"))
