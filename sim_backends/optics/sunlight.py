"""Sunlight through a window: a strip on the ground that is brighter than the rest, whatever lies there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.camera import CameraOptics
from sim_backends.optics.compiled import compiled
from sim_backends.optics.scene import Sun

Vector = NDArray[np.float64]
Image = NDArray[np.float32]

EDGE = 0.004
"""Width of the strip's edges, m: the sun is half a degree wide and the window some metres away."""


def add_sun(image: Image, optics: CameraOptics, sun: Sun) -> None:
    """Brighten `image` (height, width), DN, where the pixels' rays meet the strip; lens distortion is left out."""
    pose = sun.camera_from_ground
    to_ground = np.linalg.inv(np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    to_rays = np.linalg.inv(np.array([[optics.fx, 0.0, optics.cx], [0.0, optics.fy, optics.cy], [0.0, 0.0, 1.0]]))
    brighten(image, to_ground @ to_rays, sun.low, sun.high, sun.strength)


@compiled
def brighten(image: Image, to_ground: Vector, low: float, high: float, strength: float) -> None:
    """Core of `add_sun`; `to_ground` (3, 3) takes pixels to homogeneous places on the ground."""
    h = to_ground
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            weight = h[2, 0] * u + h[2, 1] * v + h[2, 2]
            if weight <= 0.0:
                continue
            x = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / weight
            inside = min((x - low) / EDGE, (high - x) / EDGE)
            if inside > 0.0:
                image[v, u] *= 1.0 + strength * min(1.0, inside)
