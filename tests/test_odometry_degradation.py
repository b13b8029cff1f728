"""Modes: what an estimate rests on, without flicker."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from air.odometry.degradation import Hysteresis, Monitor
from air.odometry.settings import DegradationSettings
from common.messages import Mode

SETTINGS = DegradationSettings()
STEP_NS = 100_000_000


def modes_of(points: list[int], satellites: int = 0) -> list[Mode]:
    monitor = Monitor(SETTINGS)
    return [monitor.update(k * STEP_NS, n, satellites) for k, n in enumerate(points)]


def test_a_few_bad_frames_change_nothing() -> None:
    assert set(modes_of([50, 0, 50, 0, 0, 50, 3, 50])) == {Mode.VISUAL_INERTIAL}


def test_the_camera_is_lost_after_a_while_and_comes_back_after_a_while() -> None:
    lost, back = round(SETTINGS.lost_s * 10), round(SETTINGS.back_s * 10)
    modes = modes_of([50] * 5 + [0] * (lost + 1) + [50] * (back + 1))
    assert modes.index(Mode.INERTIAL) == 5 + lost
    assert modes[-1] is Mode.VISUAL_INERTIAL
    assert modes[-2] is Mode.INERTIAL


def test_satellites_decide_over_the_gnss_modes() -> None:
    assert modes_of([50] * 20, satellites=12)[-1] is Mode.GNSS_VISUAL_INERTIAL
    assert modes_of([0] * 20, satellites=12)[-1] is Mode.GNSS_INERTIAL


@given(st.lists(st.integers(0, 40), min_size=1, max_size=200))
def test_no_mode_is_shorter_than_the_patience(points: list[int]) -> None:
    value = Hysteresis(True, 0.3, 0.3)
    states = [value.update(k * STEP_NS, n >= 20, n < 10) for k, n in enumerate(points)]
    changes = [k for k in range(1, len(states)) if states[k] != states[k - 1]]
    assert all(b - a >= 3 for a, b in pairwise(changes))
