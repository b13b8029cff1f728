"""Fixtures that the tests share."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# In a fresh checkout the first text that is drawn takes a second, and a busy machine takes its time over all of them.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def real_data() -> Callable[[str], Path]:
    """Folder of a real recording by name; skips the test where the recordings are not installed."""

    def find(name: str) -> Path:
        folder = DATA / name
        if not folder.exists():
            pytest.skip(f"the recording {name!r} is not beside this checkout")
        return folder

    return find
