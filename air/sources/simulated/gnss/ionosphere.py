"""What the broadcast model of the ionosphere does not tell: an error that neighbours in the sky share."""

from __future__ import annotations

import numpy as np

from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.gnss.swing import Swing
from common.arrays import F64

_EARTH, _SHELL = 6371.0, 350.0
"""Radius of the earth and height of the layer that stands for the ionosphere, km."""


class IonosphereError:
    """Over a flight: the same above all, rising to the north and east, and some of each satellite's own.

    Sources: Misra and Enge, Global Positioning System, 5.3 (thin shell, pierce points and obliquity); the sizes are
    told in `GnssOptions`.
    """

    def __init__(self, options: GnssOptions, satellites: int, rng: np.random.Generator):
        self._zenith = Swing(rng, (1,), options.ionosphere_residual, 10_800.0, 32_400.0)
        self._gradient = Swing(rng, (2,), options.ionosphere_gradient / 1000.0, 10_800.0, 32_400.0)
        self._ripples = Swing(rng, (satellites,), options.ionosphere_ripples, 900.0, 2700.0)

    def at(self, t_s: float, apart: F64, azimuth: F64, elevation: F64) -> F64:
        """Delay (S,) m of codes at L1 if they came from the zenith of their pierce points.

        `apart` (2,) is how far north and east of the flight's start the receiver stands, km; angles (S,) rad.
        """
        across = _EARTH / (_EARTH + _SHELL) * np.cos(elevation)
        away = (_EARTH * (np.pi / 2 - elevation - np.arcsin(across)))[:, None]
        pierced = apart + away * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        time = np.array(t_s)
        return np.asarray(self._zenith.at(time) + pierced @ self._gradient.at(time) + self._ripples.at(time))
