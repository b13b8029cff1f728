"""What a u-blox receiver may send, for tests."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st

from air.gnss.gnss_time import from_week
from air.sensors import ubx
from air.sensors.ubx_messages import NAV_PVT, RXM_RAWX
from air.sensors.ubx_pvt import pack_pvt
from air.sensors.ubx_rawx import pack_rawx
from air.sensors.ubx_signals import SATELLITE_NAMES, SIGNAL_NAMES, signal_id
from common import rtcm
from common.measurements import FixKind, GnssEpoch, ReceiverSolution

EPOCH = GnssEpoch(
    t_ns=from_week(2370, 200_010.0),
    receiver="gnss",
    satellites=("G05", "R12", "E31"),
    signals=("1C", "2C", "7Q"),
    pseudorange=np.array([2.1e7, 2.2e7, 2.4e7]),
    carrier_phase=np.array([1.1e8, np.nan, 0.9e8]),
    doppler=np.array([1000.0, -2000.5, 0.25]),
    cn0=np.array([45.0, 20.0, 38.0]),
    lock_s=np.array([64.5, 0.0, 3.2]),
    half_cycle=np.array([False, True, False]),
    sigma_pseudorange=np.array([0.08, 10.24, 0.16]),
    sigma_carrier_phase=np.array([0.004, np.nan, 0.012]),
    sigma_doppler=np.array([0.128, 8.192, 0.256]),
    channel=np.array([0, -3, 0], np.int32),
    leap_s=18,
)
SOLUTION = ReceiverSolution(
    *(EPOCH.t_ns + 4_749_636, "gnss", FixKind.FIX_3D, 51.75, -1.25, 109.0, 0.3, 0.5, np.array([1.0, 2.0, -0.5])),
    *(0.2, 2e-8, 21),
)
FRAMES = [
    ubx.frame(RXM_RAWX, pack_rawx(EPOCH)),
    b"$GNTXT,01,01,02,ANTSTATUS=OK*25\r\n",
    ubx.frame(NAV_PVT, pack_pvt(SOLUTION, 18)),
    rtcm.frame(bytes((1077 >> 4, (1077 & 15) << 4)) + b"corrections"),
    ubx.frame(0x0A04, b"\xb5\x62 a frame within a frame"),
]
STREAM = b"".join(FRAMES)
"""A frame of each protocol, one of a message that nobody reads."""

PAIRS = [
    (SATELLITE_NAMES[gnss, sv], SIGNAL_NAMES[gnss, signal])
    for gnss, sv in SATELLITE_NAMES
    for other, signal in SIGNAL_NAMES
    if other == gnss and signal_id(SATELLITE_NAMES[gnss, sv], SIGNAL_NAMES[gnss, signal]) == signal
]


def epochs(count: int = 8) -> st.SearchStrategy[GnssEpoch]:
    """Epochs whose values the message holds exactly."""

    @st.composite
    def draw_epoch(draw: st.DrawFn) -> GnssEpoch:
        names = draw(st.lists(st.sampled_from(PAIRS), max_size=count))
        n = len(names)

        def column(of: st.SearchStrategy[Any]) -> Any:
            return np.array(draw(st.lists(of, min_size=n, max_size=n)))

        unknown = st.just(math.nan)
        return GnssEpoch(
            t_ns=from_week(draw(st.integers(1024, 8191)), draw(st.integers(0, 604_799_999)) * 1e-3),
            receiver="gnss",
            satellites=tuple(satellite for satellite, _ in names),
            signals=tuple(signal for _, signal in names),
            pseudorange=column(st.floats(1e7, 5e7) | unknown).astype(float),
            carrier_phase=column(st.floats(-1e9, 1e9) | unknown).astype(float),
            doppler=column(st.floats(-6000, 6000, width=32)).astype(float),
            cn0=column(st.integers(0, 60)).astype(float),
            lock_s=column(st.integers(0, 64_500)) * 1e-3,
            half_cycle=column(st.booleans()).astype(bool),
            sigma_pseudorange=0.01 * 2.0 ** column(st.integers(0, 15)),
            sigma_carrier_phase=column(st.integers(0, 14).map(lambda k: 0.004 * k) | unknown).astype(float),
            sigma_doppler=0.002 * 2.0 ** column(st.integers(0, 15)),
            channel=np.array([draw(st.integers(-7, 6)) if s[0] == "R" else 0 for s, _ in names], np.int32),
            leap_s=draw(st.none() | st.integers(0, 40)),
            clock_reset=draw(st.booleans()),
        )

    return draw_epoch()


solutions = st.builds(
    ReceiverSolution,
    t_ns=st.integers(from_week(1100, 0.0), from_week(6000, 0.0)),
    receiver=st.just("gnss"),
    kind=st.sampled_from(FixKind),
    latitude_deg=st.integers(-900_000_000, 900_000_000).map(lambda n: n * 1e-7),
    longitude_deg=st.integers(-1_800_000_000, 1_800_000_000).map(lambda n: n * 1e-7),
    height=st.integers(-1000_000, 20_000_000).map(lambda n: n * 1e-3),
    sigma_horizontal=st.integers(0, 10**6).map(lambda n: n * 1e-3),
    sigma_vertical=st.integers(0, 10**6).map(lambda n: n * 1e-3),
    v_enu=st.tuples(*[st.integers(-100_000, 100_000)] * 3).map(lambda v: np.array(v) * 1e-3),
    sigma_velocity=st.integers(0, 10**5).map(lambda n: n * 1e-3),
    sigma_time=st.integers(0, 10**6).map(lambda n: n * 1e-9),
    satellites=st.integers(0, 99),
)
