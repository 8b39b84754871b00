"""Ambient light: how bright a surface of known albedo and slope appears, and how that varies over the picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.compiled import compiled, compiled_fast
from sim_backends.optics.scene import Light

Vector = NDArray[np.float64]
Image = NDArray[np.float32]

AMBIENT_RATE = 25_000.0
"""DN per second of a facing surface of albedo 1 in light of level 1, without a filter, in the image's centre."""


def ambient_dn(optics: CameraOptics, light: Light, exposure: float) -> float:
    """DN in the image's centre of a surface of albedo 1 that faces the light, after `exposure` seconds."""
    return AMBIENT_RATE * light.level * optics.transmission * exposure


def lambert(light: Light, normal: Vector) -> float:
    """Relative light on a surface of unit `normal` (camera frame, towards the camera)."""
    lamp = (0.0, 0.0, -1.0) if light.direction is None else light.direction
    return light.diffuse + (1 - light.diffuse) * max(0.0, float(np.dot(normal, lamp)))


def gain_parameters(optics: CameraOptics, light: Light) -> Vector:
    """(6,) centre, inverse corner radius², vignetting and gradients per pixel: what `pixel_gain` takes."""
    centre_u, centre_v = (optics.width - 1) / 2, (optics.height - 1) / 2
    return np.array(
        [
            centre_u,
            centre_v,
            1 / (centre_u**2 + centre_v**2),
            optics.vignetting,
            light.gradient[0] / optics.width,
            light.gradient[1] / optics.height,
        ]
    )


@compiled
def pixel_gain(u: float, v: float, gain: Vector) -> float:
    """Vignetting times ambient gradient at a pixel."""
    a = u - gain[0]
    b = v - gain[1]
    return float((1.0 - gain[3] * (a * a + b * b) * gain[2]) * (1.0 + gain[4] * a + gain[5] * b))


@compiled_fast
def gain_line(line: Image, u0: int, v: int, level: float, gain: Vector) -> None:
    """Set `line`, the pixels of row v from column u0 on, to `level` DN times the gain."""
    centre_u, vignetting, slope = np.float32(gain[0] - u0), np.float32(gain[3] * gain[2]), np.float32(gain[4])
    b = np.float32(v - gain[1])
    middle = np.float32(1.0) - vignetting * b * b
    tilt = np.float32(1.0 + gain[5] * b)
    scale = np.float32(level)
    for u in range(line.shape[0]):
        a = np.float32(u) - centre_u
        line[u] = scale * (middle - vignetting * a * a) * (tilt + slope * a)


@compiled
def fill_background(image: Image, level: float, gain: Vector) -> None:
    """Set the whole image to `level` DN times the gain."""
    for v in range(image.shape[0]):
        gain_line(image[v], 0, v, level, gain)
