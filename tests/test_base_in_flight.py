"""A base station that begins to speak in flight, and falls silent again: where the odometry says that it is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from gnss_flight import BASE_ECEF, errors, estimates, flight

from air.gnss.msm_writer import MsmWriter
from air.odometry.estimator import Estimator
from air.odometry.gnss_settings import GnssSettings
from air.odometry.settings import OdometrySettings
from air.sensors.gnss_rtcm import RtcmReceiver
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.motion.mission import FlightOptions
from common import rtcm
from common.measurements import GnssEpoch
from common.messages import Mode

BEGINS_S, PLACED_S, ENDS_S, SECONDS = 34.0, 36.0, 44.0, 66.0
"""It speaks, says where it stands, falls silent."""
FOUND_S = 4.0
"""Whole cycles are found within."""


@pytest.mark.slow
def test_a_base_station_that_begins_in_flight_places_the_aircraft_to_centimetres() -> None:
    """Not aligned. Beforehand metres; afterwards, when differences have grown too old, carriers keep the place."""
    flown = flight(1, SECONDS, FlightOptions(start="air"), base=GnssOptions.base())

    driver, writer = RtcmReceiver(near_ns=flown.start_ns), MsmWriter()

    def heard(message: object) -> Sequence[object]:
        if not isinstance(message, GnssEpoch) or message.receiver != "base":
            return [message]
        t_s = (message.t_ns - flown.start_ns) * 1e-9
        if not BEGINS_S <= t_s < ENDS_S:
            return []
        told = writer.messages(message) + [rtcm.pack_place(1, BASE_ECEF)] * (t_s > PLACED_S)
        return driver.feed(b"".join(map(rtcm.frame, told)), 0)

    messages = [one for message in flown.messages for one in heard(message)]
    estimator = Estimator(settings=OdometrySettings(gnss=GnssSettings(p_body_antenna=flown.p_body_antenna)))
    told = estimates(estimator, messages)
    assert estimator.gnss.datum is not None
    off = np.linalg.norm(errors(flown, told, estimator.gnss.datum)[0], axis=1)
    t_s = np.array([(estimate.state.t_ns - flown.start_ns) * 1e-9 for estimate in told])
    before, after = t_s < PLACED_S, t_s > PLACED_S + FOUND_S
    assert before.sum() > 5
    assert off[before].min() > 0.3
    assert off[after].max() < 0.10
    # The world has jumped, once, and that was told.
    revisions = np.array([estimate.revision for estimate in told])
    assert len(set(revisions[before])) == len(set(revisions[after])) == 1
    assert revisions[-1] == revisions[before][-1] + 1
    assert {estimate.mode for estimate, late in zip(told, after, strict=True) if late} == {Mode.GNSS_INERTIAL}
