"""The rotors' vibration, as a sensor that averages over its samples leaves it.

Four rotors of two blades turn at their own, wandering rates; each shakes the body with its unbalance (once a turn),
its blades (twice), and a little of the next harmonic. What is quicker than half the sample rate folds back.
"""

from __future__ import annotations

import numpy as np

from common.arrays import F64

ROTORS = 4
_HARMONICS = np.array([1.0, 2.0, 3.0])
_SIZES = np.array([1.0, 0.6, 0.3])
_SPREAD, _WANDER, _WANDER_S = 0.03, 0.01, 1.0


class Vibration:
    """Vibration with root mean squares `accel` m/s² and `gyro` rad/s in hover, when the rotors turn at `rotor_hz`."""

    def __init__(self, rng: np.random.Generator, accel: float, gyro: float, rotor_hz: float):
        self._rng = rng
        self._hz = rotor_hz * (1 + _SPREAD * rng.uniform(-1, 1, ROTORS))
        shape = (ROTORS, len(_HARMONICS), 3)
        self._accel = accel * _normalised(rng.standard_normal(shape) * _SIZES[:, None])
        self._gyro = gyro * _normalised(rng.standard_normal(shape) * _SIZES[:, None])
        self._offset = rng.uniform(0, 2 * np.pi, shape)
        self._turned = rng.uniform(0, 1, ROTORS)
        self._wander = np.zeros(ROTORS)

    def shake(self, thrust: F64, period_s: float) -> tuple[F64, F64]:
        """Mean acceleration m/s² and rate of turn rad/s (N, 3) over the next N samples; `thrust` (N,) is 1 in hover."""
        hz = self._hz * (1 + self._wandering(len(thrust), period_s)) * np.sqrt(np.maximum(thrust, 0))[:, None]
        turns = self._turned + np.cumsum(hz * period_s, axis=0)
        self._turned = turns[-1] % 1.0
        phase = 2 * np.pi * turns[:, :, None] * _HARMONICS
        size = thrust[:, None, None] * np.sinc(hz[:, :, None] * _HARMONICS * period_s)
        wave = size[..., None] * np.sin(phase[..., None] + self._offset)
        return np.einsum("nrhc,rhc->nc", wave, self._accel), np.einsum("nrhc,rhc->nc", wave, self._gyro)

    def _wandering(self, count: int, period_s: float) -> F64:
        """Relative errors (N, ROTORS) of the rates."""
        kept, out = np.exp(-period_s / _WANDER_S), np.empty((count, ROTORS))
        drive = _WANDER * np.sqrt(1 - kept**2) * self._rng.standard_normal((count, ROTORS))
        for k in range(count):
            self._wander = out[k] = kept * self._wander + drive[k]
        return out


def _normalised(amplitude: F64) -> F64:
    """Amplitudes of sines whose sum has a root mean square of 1."""
    return np.asarray(amplitude / np.sqrt(np.sum(amplitude**2) / 2))
