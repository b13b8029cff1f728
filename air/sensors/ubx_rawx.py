"""The payload of RXM-RAWX, the raw measurements of one instant, both ways.

Source: u-blox F9 HPG 1.32, Interface Description (UBX-22008968), section 3.17.
"""

from __future__ import annotations

import struct

import numpy as np

from air.gnss.gnss_time import from_week, to_week
from air.sensors.ubx_signals import GLONASS, SATELLITE_IDS, SATELLITE_NAMES, SIGNAL_NAMES, signal_id
from common.arrays import F64, I64, Bool
from common.measurements import GnssEpoch

_HEADER = struct.Struct("<dHbBBBxx")
_WEEKS = range(1024, 8192)
"""Years 1999 to 2137: other weeks come from a receiver that does not know the time yet."""
_SIGNAL = np.dtype(
    [
        *(("pseudorange", "<f8"), ("carrier_phase", "<f8"), ("doppler", "<f4"), ("gnss", "u1"), ("sv", "u1")),
        *(("signal", "u1"), ("frequency", "u1"), ("lock_ms", "<u2"), ("cn0", "u1"), ("sigma_pseudorange", "u1")),
        *(("sigma_carrier_phase", "u1"), ("sigma_doppler", "u1"), ("tracking", "u1"), ("reserved", "u1")),
    ]
)
_LEAP_KNOWN, _CLOCK_RESET = 0x01, 0x02
_PSEUDORANGE_VALID, _PHASE_VALID, _HALF_CYCLE_KNOWN = 0x01, 0x02, 0x04
_POWERS = 2.0 ** np.arange(16)
_PHASE_UNIT, _PHASE_UNKNOWN = 0.004, 15
_LOCK_LONGEST_MS = 64_500


def parse_rawx(payload: bytes, receiver: str) -> GnssEpoch | None:
    """The epoch in RXM-RAWX; None when damaged, or while the receiver does not know the week.

    Signals that RINEX has no name for and GLONASS satellites without number are left out.
    """
    if len(payload) < _HEADER.size:
        return None
    tow_s, week, leap_s, count, status, _ = _HEADER.unpack_from(payload)
    if len(payload) != _HEADER.size + count * _SIGNAL.itemsize or not 0.0 <= tow_s < 604_801.0 or week not in _WEEKS:
        return None
    rows = np.frombuffer(payload, _SIGNAL, count, _HEADER.size)
    names = [
        (SATELLITE_NAMES.get((gnss, sv)), SIGNAL_NAMES.get((gnss, signal)))
        for gnss, sv, signal in zip(rows["gnss"].tolist(), rows["sv"].tolist(), rows["signal"].tolist(), strict=True)
    ]
    known = [(i, sat, signal) for i, (sat, signal) in enumerate(names) if sat is not None and signal is not None]
    if len(known) < count:
        rows = rows[[i for i, _, _ in known]]
    tracking = rows["tracking"]
    phase_valid = tracking & _PHASE_VALID != 0
    phase_sigma = rows["sigma_carrier_phase"] & 15
    return GnssEpoch(
        t_ns=from_week(week, tow_s),
        receiver=receiver,
        satellites=tuple(satellite for _, satellite, _ in known),
        signals=tuple(signal for _, _, signal in known),
        pseudorange=_where(tracking & _PSEUDORANGE_VALID != 0, rows["pseudorange"]),
        carrier_phase=_where(phase_valid, rows["carrier_phase"]),
        doppler=_where(np.isfinite(rows["doppler"]), rows["doppler"].astype(float)),
        cn0=rows["cn0"].astype(float),
        lock_s=rows["lock_ms"] * 1e-3,
        half_cycle=tracking & _HALF_CYCLE_KNOWN == 0,
        sigma_pseudorange=0.01 * _POWERS[rows["sigma_pseudorange"] & 15],
        sigma_carrier_phase=_where(phase_sigma != _PHASE_UNKNOWN, _PHASE_UNIT * phase_sigma.astype(float)),
        sigma_doppler=0.002 * _POWERS[rows["sigma_doppler"] & 15],
        channel=np.where(rows["gnss"] == GLONASS, rows["frequency"].astype(np.int32) - 7, 0).astype(np.int32),
        leap_s=leap_s if status & _LEAP_KNOWN else None,
        clock_reset=bool(status & _CLOCK_RESET),
    )


def _where(valid: Bool, values: F64) -> F64:
    """The values, NaN where they are not valid or not finite."""
    out: F64 = np.where(valid & np.isfinite(values), values, np.nan)
    return out


def pack_rawx(epoch: GnssEpoch) -> bytes:
    """The payload of RXM-RAWX with an epoch of at most 255 rows; NaN becomes 0, marked as not valid.

    Raises KeyError for a satellite or signal that u-blox has no number for.
    """
    rows = np.zeros(len(epoch.satellites), _SIGNAL)
    ids = [SATELLITE_IDS[satellite] for satellite in epoch.satellites]
    rows["gnss"], rows["sv"] = np.array(ids, int).reshape(-1, 2).T
    rows["signal"] = [signal_id(*names) for names in zip(epoch.satellites, epoch.signals, strict=True)]
    rows["frequency"] = np.where(rows["gnss"] == GLONASS, epoch.channel + 7, 0)
    for name in ("pseudorange", "carrier_phase", "doppler"):
        rows[name] = np.nan_to_num(getattr(epoch, name))
    rows["lock_ms"] = np.clip(np.round(1e3 * epoch.lock_s), 0, _LOCK_LONGEST_MS)
    rows["cn0"] = np.clip(np.round(epoch.cn0), 0, 255)
    rows["sigma_pseudorange"] = _power(epoch.sigma_pseudorange / 0.01)
    rows["sigma_doppler"] = _power(epoch.sigma_doppler / 0.002)
    rows["sigma_carrier_phase"] = np.clip(
        np.nan_to_num(np.round(epoch.sigma_carrier_phase / _PHASE_UNIT), nan=15), 0, 15
    )
    rows["tracking"] = (
        np.where(np.isnan(epoch.pseudorange), 0, _PSEUDORANGE_VALID)
        | np.where(np.isnan(epoch.carrier_phase), 0, _PHASE_VALID)
        | np.where(epoch.half_cycle, 0, _HALF_CYCLE_KNOWN)
    )
    week, tow_s = to_week(epoch.t_ns)
    status = (epoch.leap_s is not None) * _LEAP_KNOWN | epoch.clock_reset * _CLOCK_RESET
    return _HEADER.pack(tow_s, week, epoch.leap_s or 0, len(rows), status, 1) + rows.tobytes()


def _power(ratio: F64) -> I64:
    return np.clip(np.round(np.log2(ratio)), 0, 15).astype(int)
