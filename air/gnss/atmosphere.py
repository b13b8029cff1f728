"""Delays of the signals in the ionosphere and the troposphere, with their standard deviations.

Sources: IS-GPS-200, section 20.3.3.5.2.5 (Klobuchar); BeiDou B1I ICD 3.0, section 5.2.4.7; Saastamoinen (1972) with
the standard atmosphere and 70 % humidity, mapped by the zenith angle's cosine, and the standard deviations, as in
RTKLIB 2.4.3's manual, E.5 and E.6.
"""

from __future__ import annotations

import numpy as np

from air.gnss.gnss_time import BDT_MINUS_GPST_NS, to_week
from air.gnss.signals import LIGHT
from common.arrays import F64
from common.measurements import Ionosphere

TYPICAL = Ionosphere(
    0,
    "G",
    (0.1118e-7, -0.7451e-8, -0.5961e-7, 0.1192e-6),
    (0.1167e6, -0.2294e6, -0.1311e6, 0.1049e7),
)
"""GPS's broadcast of 2004-01-01, for receivers that have not heard a newer one yet."""
HUMIDITY = 0.7
L1_HZ, B1I_HZ = 1575.42e6, 1561.098e6
_SHELL = 6378.0 / (6378.0 + 375.0)
"""Radius of the earth over that of the shell of BeiDou's ionosphere."""
_NIGHT_S, _NOON_S, _DAY_S = 5e-9, 50_400.0, 86_400.0


def klobuchar(model: Ionosphere, t_ns: int, position: F64, azimuth: F64, elevation: F64) -> tuple[F64, F64]:
    """Delay of the code at L1 and its standard deviation, both (N,) m, at GPST `t_ns`.

    `position` (3,) latitude and longitude in rad and height in m; angles (N,) rad. The delay scales with f⁻².
    BeiDou's parameters belong to a model of its own, by geographic latitude, with a thin shell, at B1I.
    """
    if model.system == "C":
        delay = _beidou(model, t_ns, position, azimuth, elevation)
        return delay, 0.5 * delay
    latitude, longitude, _ = position / np.pi
    psi = 0.0137 / (elevation / np.pi + 0.11) - 0.022
    phi = np.clip(latitude + psi * np.cos(azimuth), -0.416, 0.416)
    lam = longitude + psi * np.sin(azimuth) / np.cos(phi * np.pi)
    geomagnetic = phi + 0.064 * np.cos((lam - 1.617) * np.pi)
    local_s = (43_200.0 * lam + to_week(t_ns)[1]) % _DAY_S
    slant = 1.0 + 16.0 * (0.53 - elevation / np.pi) ** 3
    amplitude = np.maximum(np.polynomial.polynomial.polyval(geomagnetic, model.alpha), 0.0)
    period = np.maximum(np.polynomial.polynomial.polyval(geomagnetic, model.beta), 72_000.0)
    x = 2 * np.pi * (local_s - _NOON_S) / period
    day = np.where(np.abs(x) < 1.57, amplitude * (1 - x**2 / 2 + x**4 / 24), 0.0)
    delay = LIGHT * slant * (_NIGHT_S + day)
    return delay, 0.5 * delay


def _beidou(model: Ionosphere, t_ns: int, position: F64, azimuth: F64, elevation: F64) -> F64:
    """The delay (N,) m at L1 by BeiDou's model."""
    latitude, longitude, _ = position
    across = _SHELL * np.cos(elevation)
    psi = np.pi / 2 - elevation - np.arcsin(across)
    phi = np.arcsin(np.sin(latitude) * np.cos(psi) + np.cos(latitude) * np.sin(psi) * np.cos(azimuth))
    lam = longitude + np.arcsin(np.clip(np.sin(psi) * np.sin(azimuth) / np.cos(phi), -1.0, 1.0))
    local_s = (43_200.0 * lam / np.pi + to_week(t_ns + BDT_MINUS_GPST_NS)[1]) % _DAY_S
    far = np.abs(phi / np.pi)
    amplitude = np.maximum(np.polynomial.polynomial.polyval(far, model.alpha), 0.0)
    period = np.clip(np.polynomial.polynomial.polyval(far, model.beta), 72_000.0, 172_800.0)
    hours = local_s - _NOON_S
    day = np.where(np.abs(hours) < period / 4, amplitude * np.cos(2 * np.pi * hours / period), 0.0)
    return np.asarray((B1I_HZ / L1_HZ) ** 2 * LIGHT * (_NIGHT_S + day) / np.sqrt(1 - across**2))


def saastamoinen(position: F64, elevation: F64) -> tuple[F64, F64]:
    """Delay in the troposphere and its standard deviation, both (N,) m.

    `position` (3,) latitude and longitude in rad and ellipsoidal height in m, which must be below 10 km (0 delay
    above); `elevation` (N,) rad.
    """
    latitude, _, height = position
    sigma = 0.3 / (np.sin(elevation) + 0.1)
    if not -100.0 <= height <= 10_000.0:
        return np.zeros_like(elevation), sigma
    height = max(height, 0.0)
    pressure = 1013.25 * (1 - 2.2557e-5 * height) ** 5.2568
    temperature = 15.0 - 6.5e-3 * height + 273.16
    vapour = 6.108 * HUMIDITY * np.exp((17.15 * temperature - 4684.0) / (temperature - 38.45))
    dry = 0.0022768 * pressure / (1 - 0.00266 * np.cos(2 * latitude) - 0.00028 * height / 1e3)
    wet = 0.002277 * (1255.0 / temperature + 0.05) * vapour
    return (dry + wet) / np.sin(elevation), sigma
