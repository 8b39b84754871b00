"""Gaussian blur of a window of an image, in place: point spread and defocus."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.compiled import compiled_fast

Image = NDArray[np.float32]


def blur_window(image: Image, window: tuple[int, int, int, int], sigma: float) -> None:
    """Blur `image` inside the window (u0, v0, u1, v1, ends excluded) by `sigma` pixels; edges are repeated."""
    u0, v0, u1, v1 = window
    radius = 3 * max(1, int(np.ceil(3.5 * sigma / 3)))
    if u1 <= u0 or v1 <= v0 or sigma < 0.05:
        return
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    # The compiler makes fast code for contiguous arrays only.
    part = np.ascontiguousarray(image[v0:v1, u0:u1])
    separable_blur(part, (kernel / kernel.sum()).astype(np.float32))
    image[v0:v1, u0:u1] = part


@compiled_fast
def separable_blur(image: Image, kernel: Image) -> None:
    """Convolve with the symmetric `kernel` along both axes, repeating edge pixels; its radius is a multiple of 3."""
    rows, cols = image.shape
    radius = kernel.shape[0] // 2
    across = np.empty((rows, cols), dtype=np.float32)
    line = np.empty(cols + 2 * radius, dtype=np.float32)
    for v in range(rows):
        for u in range(line.shape[0]):
            line[u] = image[v, min(max(u - radius, 0), cols - 1)]
        out = across[v]
        scale(out, line[radius : radius + cols], kernel[radius])
        for k in range(0, radius, 3):
            far = 2 * radius - k
            add_pairs(
                out,
                kernel[k : k + 3],
                line[k : k + cols],
                b=line[far : far + cols],
                c=line[k + 1 : k + 1 + cols],
                d=line[far - 1 : far - 1 + cols],
                e=line[k + 2 : k + 2 + cols],
                f=line[far - 2 : far - 2 + cols],
            )
    for v in range(rows):
        out = image[v]
        scale(out, across[v], kernel[radius])
        for k in range(0, radius, 3):
            reach = radius - k
            add_pairs(
                out,
                kernel[k : k + 3],
                across[max(0, v - reach)],
                b=across[min(rows - 1, v + reach)],
                c=across[max(0, v - reach + 1)],
                d=across[min(rows - 1, v + reach - 1)],
                e=across[max(0, v - reach + 2)],
                f=across[min(rows - 1, v + reach - 2)],
            )


@compiled_fast
def scale(out: Image, line: Image, weight: np.float32) -> None:
    """Set `out` to `weight` times `line`."""
    for u in range(out.shape[0]):
        out[u] = weight * line[u]


@compiled_fast
def add_pairs(out: Image, weights: Image, a: Image, b: Image, c: Image, d: Image, e: Image, f: Image) -> None:
    """Add the weighted pairs (a, b), (c, d), (e, f) to `out`."""
    p, q, r = weights[0], weights[1], weights[2]
    for u in range(out.shape[0]):
        out[u] += p * (a[u] + b[u]) + q * (c[u] + d[u]) + r * (e[u] + f[u])
