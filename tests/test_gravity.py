"""Normal gravity and the earth's rotation against published values."""

from __future__ import annotations

import numpy as np
import pytest

from common.gravity import EARTH_RATE, earth_rate_enu, normal_gravity


@pytest.mark.parametrize(
    ("latitude_deg", "published"), [(0, 9.7803253359), (45, 9.8061977695), (-45, 9.8061977695), (90, 9.8321849379)]
)
def test_gravity_on_the_ellipsoid_is_the_standards(latitude_deg: float, published: float) -> None:
    assert normal_gravity(latitude_deg, 0.0) == pytest.approx(published, abs=2e-9)


def test_gravity_falls_with_height_as_free_air() -> None:
    """0.3086 mGal a metre, to the digits that the figure has."""
    assert (normal_gravity(45.0, 0.0) - normal_gravity(45.0, 1000.0)) / 1000.0 == pytest.approx(3.086e-6, rel=5e-4)


def test_the_earth_turns_about_its_axis() -> None:
    np.testing.assert_allclose(earth_rate_enu(90.0), [0, 0, EARTH_RATE], atol=1e-19)
    np.testing.assert_allclose(earth_rate_enu(0.0), [0, EARTH_RATE, 0], atol=1e-19)
    assert earth_rate_enu(-30.0)[2] < 0
