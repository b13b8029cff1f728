"""What goes to the journal is one line a record; time stands still for who asks it to."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from common.clock import Clock, ManualClock, SystemClock

PROGRAM = """
import logging
from common import log
log.setup("info")
logging.getLogger("air.uplink").debug("not shown")
logging.getLogger("air.uplink").warning("link lost")
try:
    1 / 0
except ZeroDivisionError:
    logging.getLogger("air").exception("it broke")
"""


def output(journal: bool) -> list[str]:
    environment = {name: value for name, value in os.environ.items() if name != "JOURNAL_STREAM"}
    if journal:
        environment["JOURNAL_STREAM"] = "8:12345"
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_the_journal_gets_one_line_a_record_with_its_priority() -> None:
    warning, error = output(journal=True)
    assert warning == "<4>air.uplink: link lost"
    assert error.startswith("<3>air: it broke | Traceback")
    assert error.endswith("ZeroDivisionError: division by zero")


def test_a_terminal_gets_the_time_of_day_and_the_level() -> None:
    first, *rest = output(journal=False)
    assert first[2] == first[5] == ":"
    assert first.endswith(" WARNING air.uplink: link lost")
    assert rest[-1] == "ZeroDivisionError: division by zero"


def test_an_unknown_level_is_refused() -> None:
    from common import log

    with pytest.raises(ValueError, match="LOUD"):
        log.setup("loud")


def test_a_manual_clock_moves_only_when_somebody_sleeps() -> None:
    clock: Clock = ManualClock(5)
    assert clock.now_ns() == clock.now_ns() == 5
    clock.sleep(0.25)
    clock.sleep(-1.0)
    assert clock.now_ns() == 250_000_005


def test_the_system_clock_is_gnss_time() -> None:
    """GPST runs 18 s ahead of UTC."""
    clock: Clock = SystemClock()
    assert clock.now_ns() - time.time_ns() == pytest.approx(18e9, abs=1e8)
    clock.sleep(-1.0)
