"""Messages of the ROS package gnss_comm, which the public GVINS bags hold, as our measurements.

Source: the definitions in HKUST-Aerial-Robotics/gnss_comm; its numbers of satellites and codes follow RTKLIB's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from air.gnss.gnss_time import from_week
from common.measurements import (
    FixKind,
    GlonassEphemeris,
    GnssEpoch,
    Ionosphere,
    KeplerEphemeris,
    Measurement,
    ReceiverSolution,
)


def _fields(kind: str, names: str) -> str:
    """Lines of a ROS message definition: fields of one type."""
    return "".join(f"{kind} {name}\n" for name in names.split())


_TIME = "gnss_comm/GnssTimeMsg"
_ORBIT = "ura A e i0 omg OMG0 M0 delta_n OMG_dot i_dot cuc cus crc crs cic cis af0 af1 af2 tgd0 tgd1 A_dot n_dot"
_STATE = "ura pos_x pos_y pos_z vel_x vel_y vel_z acc_x acc_y acc_z tau_n gamma delta_tau_n"
_PVT = "latitude longitude altitude height_msl h_acc v_acc p_dop vel_n vel_e vel_d vel_acc"
DEFINITIONS = {
    "GnssTimeMsg": _fields("uint32", "week") + _fields("float64", "tow"),
    "GnssObsMsg": _fields(_TIME, "time")
    + _fields("uint32", "sat")
    + _fields("float64[]", "freqs CN0")
    + _fields("uint8[]", "LLI code")
    + _fields("float64[]", "psr psr_std cp cp_std dopp dopp_std")
    + _fields("uint8[]", "status"),
    "GnssMeasMsg": _fields("gnss_comm/GnssObsMsg[]", "meas"),
    "GnssEphemMsg": _fields("uint32", "sat")
    + _fields(_TIME, "ttr toe toc")
    + _fields("float64", "toe_tow")
    + _fields("uint32", "week iode iodc health code")
    + _fields("float64", _ORBIT),
    "GnssGloEphemMsg": _fields("uint32", "sat")
    + _fields(_TIME, "ttr toe")
    + _fields("int32", "freqo")
    + _fields("uint32", "iode health age")
    + _fields("float64", _STATE),
    "GnssPVTSolnMsg": _fields(_TIME, "time")
    + _fields("uint8", "fix_type")
    + _fields("bool", "valid_fix diff_soln")
    + _fields("uint8", "carr_soln num_sv")
    + _fields("float64", _PVT),
    "GnssTimePulseInfoMsg": _fields(_TIME, "time") + _fields("bool", "utc_based") + _fields("uint32", "time_sys"),
    "StampedFloat64Array": _fields("std_msgs/Header", "header") + _fields("float64[]", "data"),
}
"""Text of each message of the package, for bags that do not carry their own."""

_SYSTEMS = (("G", 32), ("R", 27), ("E", 38), ("C", 63))
"""Satellites are numbered through the systems, so many of each."""
_CODES = "1C1P1W1Y1M1N1S1L1E1A1B1X1Z2C2D2S2L2X2P2W2Y2M2N5I5Q5X7I7Q7X6A6B6C6X6Z6S6L8I8Q8X2I2Q6I6Q3I3Q3X1I1Q"
"""Two letters for each code from 1 on."""
_BEIDOU_B1 = {"1I": "2I", "1Q": "2Q"}
"""B1 is band 2 in RINEX since 3.03."""
_GLONASS_G1_HZ, _GLONASS_STEP_HZ = 1.602e9, 562_500.0
_GLONASS_G2_HZ, _GLONASS_G2_STEP_HZ = 1.246e9, 437_500.0
_CODE_VALID, _PHASE_VALID, _HALF_CYCLE_VALID = 1, 2, 4
_FNAV = 0x2
_GEOSTATIONARY = (*range(1, 6), *range(59, 64))


def epoch(message: Any, receiver: str, _t_ns: int) -> GnssEpoch | None:
    """The raw measurements of a GnssMeasMsg; None when it holds none."""
    rows = [
        (name, obs, i)
        for obs in message.meas
        for i in range(len(obs.code))
        if (name := satellite_name(obs.sat)) and 1 <= obs.code[i] <= len(_CODES) // 2
    ]
    if not rows:
        return None

    def column(field: str, needed: int = 0) -> Any:
        return np.array(
            [getattr(o, field)[i] if o.status[i] & needed == needed else np.nan for _, o, i in rows], np.float64
        )

    return GnssEpoch(
        t_ns=_time(rows[0][1].time),
        receiver=receiver,
        satellites=tuple(name for name, _, _ in rows),
        signals=tuple(_signal(name, int(obs.code[i])) for name, obs, i in rows),
        pseudorange=column("psr", _CODE_VALID),
        carrier_phase=column("cp", _PHASE_VALID),
        doppler=column("dopp"),
        cn0=column("CN0"),
        lock_s=np.full(len(rows), np.nan),
        half_cycle=np.array([not obs.status[i] & _HALF_CYCLE_VALID for _, obs, i in rows]),
        sigma_pseudorange=column("psr_std", _CODE_VALID),
        sigma_carrier_phase=column("cp_std", _PHASE_VALID),
        sigma_doppler=column("dopp_std"),
        channel=np.array([_channel(name, float(obs.freqs[i])) for name, obs, i in rows], np.int32),
    )


def kepler(m: Any, _device: str, _t_ns: int) -> KeplerEphemeris | None:
    """The ephemeris of a GnssEphemMsg; None for a satellite that has no such one, or no orbit."""
    satellite = satellite_name(m.sat)
    if satellite is None or satellite[0] == "R" or not m.A > 0:
        return None
    return KeplerEphemeris(
        t_ns=_time(m.ttr),
        satellite=satellite,
        source=_source(satellite, m.code),
        toe_ns=_time(m.toe),
        toc_ns=_time(m.toc),
        iode=m.iode,
        iodc=m.iodc,
        af0=m.af0,
        af1=m.af1,
        af2=m.af2,
        sqrt_a=math.sqrt(m.A),
        e=m.e,
        i0=m.i0,
        omega0=m.OMG0,
        omega=m.omg,
        m0=m.M0,
        delta_n=m.delta_n,
        idot=m.i_dot,
        omega_dot=m.OMG_dot,
        cuc=m.cuc,
        cus=m.cus,
        crc=m.crc,
        crs=m.crs,
        cic=m.cic,
        cis=m.cis,
        group_delay=(m.tgd0, m.tgd1),
        accuracy=m.ura,
        health=m.health,
    )


def glonass(m: Any, _device: str, _t_ns: int) -> GlonassEphemeris | None:
    """The ephemeris of a GnssGloEphemMsg; None for another system's satellite."""
    satellite = satellite_name(m.sat)
    if satellite is None or satellite[0] != "R":
        return None
    return GlonassEphemeris(
        t_ns=_time(m.ttr),
        satellite=satellite,
        toe_ns=_time(m.toe),
        position=(m.pos_x, m.pos_y, m.pos_z),
        velocity=(m.vel_x, m.vel_y, m.vel_z),
        acceleration=(m.acc_x, m.acc_y, m.acc_z),
        tau=-m.tau_n,
        gamma=m.gamma,
        channel=m.freqo,
        age_days=m.age,
        health=m.health,
    )


def ionosphere(message: Any, _device: str, t_ns: int) -> Ionosphere | None:
    """Klobuchar's parameters of GPS in a StampedFloat64Array of eight; None for another array."""
    if len(message.data) != 8:
        return None
    a0, a1, a2, a3, b0, b1, b2, b3 = (float(x) for x in message.data)
    return Ionosphere(t_ns, "G", (a0, a1, a2, a3), (b0, b1, b2, b3))


def solution(m: Any, receiver: str, _t_ns: int) -> ReceiverSolution:
    """The receiver's own solution in a GnssPVTSolnMsg."""
    return ReceiverSolution(
        t_ns=_time(m.time),
        receiver=receiver,
        kind=_fix_kind(m),
        latitude_deg=m.latitude,
        longitude_deg=m.longitude,
        height=m.altitude,
        sigma_horizontal=m.h_acc,
        sigma_vertical=m.v_acc,
        v_enu=np.array([m.vel_e, m.vel_n, -m.vel_d]),
        sigma_velocity=m.vel_acc,
        sigma_time=math.nan,
        satellites=m.num_sv,
    )


CONVERTERS: Mapping[str, Callable[[Any, str, int], Measurement | None]] = {
    "GnssMeasMsg": epoch,
    "GnssEphemMsg": kepler,
    "GnssGloEphemMsg": glonass,
    "GnssPVTSolnMsg": solution,
    "StampedFloat64Array": ionosphere,
}
"""By the last part of the type's name. A converter takes the message, the device's name and the stamp, GPST ns."""


def satellite_name(number: int) -> str | None:
    """RINEX name of gnss_comm's number of a satellite, None for a number outside all systems."""
    for system, count in _SYSTEMS:
        if 1 <= number <= count:
            return f"{system}{number:02d}"
        number -= count
    return None


def _signal(satellite: str, code: int) -> str:
    signal = _CODES[2 * code - 2 : 2 * code]
    return _BEIDOU_B1.get(signal, signal) if satellite[0] == "C" else signal


def _channel(satellite: str, frequency_hz: float) -> int:
    """GLONASS frequency number of a carrier, 0 for other systems and frequencies outside G1 and G2."""
    if satellite[0] != "R" or not math.isfinite(frequency_hz):
        return 0
    for base_hz, step_hz in ((_GLONASS_G1_HZ, _GLONASS_STEP_HZ), (_GLONASS_G2_HZ, _GLONASS_G2_STEP_HZ)):
        channel = round((frequency_hz - base_hz) / step_hz)
        if -7 <= channel <= 13:
            return channel
    return 0


def _source(satellite: str, code: int) -> str:
    """The navigation message that an ephemeris came in; `code` tells for Galileo alone."""
    if satellite[0] == "E":
        return "FNAV" if code & _FNAV else "INAV"
    if satellite[0] == "C":
        return "D2" if int(satellite[1:]) in _GEOSTATIONARY else "D1"
    return "LNAV"


def _fix_kind(m: Any) -> FixKind:
    if not m.valid_fix:
        return FixKind.NONE
    if m.fix_type in (3, 4) and m.carr_soln in (1, 2):
        return FixKind.RTK_FLOAT if m.carr_soln == 1 else FixKind.RTK_FIXED
    if m.fix_type in (3, 4):
        return FixKind.DIFFERENTIAL if m.diff_soln else FixKind.FIX_3D
    return {1: FixKind.DEAD_RECKONING, 2: FixKind.FIX_2D, 5: FixKind.TIME_ONLY}.get(m.fix_type, FixKind.NONE)


def _time(time: Any) -> int:
    return from_week(int(time.week), float(time.tow))
