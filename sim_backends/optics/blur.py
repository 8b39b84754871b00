"""Gaussian blur of a window of an image, in place: point spread and defocus."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.compiled import compiled_fast

Image = NDArray[np.float32]


def blur_window(image: Image, window: tuple[int, int, int, int], sigma: float) -> None:
    """Blur `image` inside the window (u0, v0, u1, v1, ends excluded) by `sigma` pixels; edges are repeated."""
    u0, v0, u1, v1 = window
    radius = max(1, int(np.ceil(3.5 * sigma)))
    if u1 <= u0 or v1 <= v0 or sigma < 0.05:
        return
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    separable_blur(image[v0:v1, u0:u1], (kernel / kernel.sum()).astype(np.float32))


@compiled_fast
def separable_blur(image: Image, kernel: Image) -> None:
    """Convolve with the symmetric `kernel` along both axes, repeating edge pixels."""
    rows, cols = image.shape
    radius = kernel.shape[0] // 2
    across = np.empty((rows, cols), dtype=np.float32)
    line = np.empty(cols + 2 * radius, dtype=np.float32)
    for v in range(rows):
        line[:radius] = image[v, 0]
        line[radius : radius + cols] = image[v]
        line[radius + cols :] = image[v, cols - 1]
        out = across[v]
        for u in range(cols):
            out[u] = kernel[radius] * line[u + radius]
        for k in range(radius):
            for u in range(cols):
                out[u] += kernel[k] * (line[u + k] + line[u + 2 * radius - k])
    for v in range(rows):
        out = image[v]
        for u in range(cols):
            out[u] = kernel[radius] * across[v, u]
        for k in range(radius):
            above = across[max(0, v - radius + k)]
            below = across[min(rows - 1, v + radius - k)]
            for u in range(cols):
                out[u] += kernel[k] * (above[u] + below[u])
