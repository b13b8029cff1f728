"""From the light on the sensor to eight bits: motion blur, exposure and noise, compiled."""

from __future__ import annotations

import math

import numpy as np

from air.sources.simulated.sites.raytrace import compiled
from common.arrays import F32, F64, I64, U8

GROUP = 16
"""Pixels of a row that are smeared alike."""
_TAPS = 32
_STILL_PX = 0.2
_SPACING_PX = 0.8


@compiled
def smear(
    light: F32, depth: F32, rays: F32, v_cam: F64, omega_cam: F64, focal: float, exposure_s: float, out: F32
) -> None:
    """Fill `out` (H, W, 3) with the mean of `light` (H, W, 3) along what each pixel passes in an exposure.

    `v_cam`, `omega_cam` (H, 3) m/s, rad/s of the camera in its own axes, row by row; `focal` px. Pixels outside the
    image are taken from its border.
    """
    height, width, _ = light.shape
    for i in range(height):
        vx, vy, vz = v_cam[i]
        wx, wy, wz = omega_cam[i]
        for begin in range(0, width, GROUP):
            end = min(begin + GROUP, width)
            j = (begin + end) // 2
            x, y, near = rays[i, j, 0], rays[i, j, 1], 1.0 / depth[i, j]
            # A fixed point at depth z moves by −v/z − ω × (x, y, 1) in units of its depth.
            ahead = -vz * near - (wx * y - wy * x)
            du = focal * exposure_s * (-vx * near - (wy - wz * y) - x * ahead)
            dv = focal * exposure_s * (-vy * near - (wz * x - wx) - y * ahead)
            length = math.sqrt(du * du + dv * dv)
            if length < _STILL_PX:
                for j in range(begin, end):
                    for c in range(3):
                        out[i, j, c] = light[i, j, c]
                continue
            taps = min(1 + math.ceil(length / _SPACING_PX), _TAPS)
            reach = 1.0 + 0.5 * abs(du)
            inside = begin - reach >= 0.0 and end + reach < width
            for n in range(taps):
                along = (n + 0.5) / taps - 0.5
                shift = along * du
                v = min(max(i + along * dv, 0.0), height - 1.001)
                i0, dj = int(v), math.floor(shift)
                fu, fv = shift - dj, v - i0
                share = 1.0 / taps
                w00, w01 = np.float32((1.0 - fu) * (1.0 - fv) * share), np.float32(fu * (1.0 - fv) * share)
                w10, w11 = np.float32((1.0 - fu) * fv * share), np.float32(fu * fv * share)
                if n == 0:
                    for j in range(begin, end):
                        for c in range(3):
                            out[i, j, c] = np.float32(0.0)
                if inside:
                    up, down = light[i0, begin + dj : end + dj + 1], light[i0 + 1, begin + dj : end + dj + 1]
                    here = out[i, begin:end]
                    for j in range(end - begin):
                        for c in range(3):
                            here[j, c] += w00 * up[j, c] + w01 * up[j + 1, c] + w10 * down[j, c] + w11 * down[j + 1, c]
                else:
                    for j in range(begin, end):
                        j0, j1 = min(max(j + dj, 0), width - 1), min(max(j + dj + 1, 0), width - 1)
                        for c in range(3):
                            out[i, j, c] += (
                                w00 * light[i0, j0, c] + w01 * light[i0, j1, c]
                                + w10 * light[i0 + 1, j0, c] + w11 * light[i0 + 1, j1, c]
                            )  # fmt: skip


@compiled
def develop(
    light: F32, transmission: F32, white: float, electrons: float, shot: float, read: float, normal: F32, begins: I64,
    out: U8,
) -> None:  # fmt: skip
    """Fill `out` (H, W·3) with light (H, W·3) times the lens's `transmission` (H, W·3) times `white`, by gamma 2.

    1 is white, and that is `electrons` electrons; `shot` scales their Poisson noise, `read` is the noise of reading,
    electrons. `normal` (N,) are standard normal numbers, read from `begins` (H,) on.
    """
    height, width = light.shape
    gain, full = np.float32(white), np.float32(255.0)
    floor, share = np.float32((read / electrons) ** 2), np.float32(shot * shot / electrons)
    none, most, half = np.float32(0.0), np.float32(1.1), np.float32(0.5)
    for i in range(height):
        row, lens, noise, to = light[i], transmission[i], normal[begins[i] : begins[i] + width], out[i]
        for k in range(width):
            x = min(row[k] * lens[k] * gain, most)
            x += noise[k] * np.sqrt(share * x + floor)
            to[k] = np.uint8(min(full * np.sqrt(max(x, none)) + half, full))
