"""Laser speckle: a random factor on the stripe's light, correlated over neighbouring pixels, new in every frame.

The factor is log-normal with mean 1 and standard deviation C, the contrast. It moves a stripe's centre by about
0.6 C √(grain × stripe width) pixels, the error that no extractor can remove.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backends.optics.compiled import compiled
from sim_backends.optics.sensor import gaussian, scramble

Image = NDArray[np.float32]
Vector = NDArray[np.float64]


def add_speckled(
    image: Image,
    stripe: Image,
    touched: NDArray[np.int64],
    contrast: float,
    grain_px: float,
    rng: np.random.Generator,
) -> None:
    """Add `stripe` times the speckle to `image`, row v in the columns touched[v, 0] … touched[v, 1] (excluded).

    `grain_px` is the standard deviation of the kernel that correlates white noise; the correlation of two pixels at
    distance r is then exp(−r²/4 grain²).
    """
    if contrast < 0 or grain_px <= 0:
        raise ValueError(f"speckle contrast {contrast}, grain {grain_px} px: contrast 0 or more, grain above 0 px")
    radius = max(1, int(np.ceil(3 * grain_px)))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / grain_px) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    spread = float(np.sqrt(np.log1p(contrast**2)))
    apply(image, stripe, touched, spread=spread, kernel=kernel, seed=rng.integers(0, 2**63, dtype=np.uint64))


@compiled
def apply(
    image: Image, stripe: Image, touched: NDArray[np.int64], spread: float, kernel: Vector, seed: np.uint64
) -> None:
    """Compiled core of `add_speckled`; white noise is a hash of the pixel, so that no field has to be stored."""
    height, width = stripe.shape
    size = kernel.shape[0]
    column = np.empty(width + size)
    for v in range(height):
        u0, u1 = touched[v, 0], touched[v, 1]
        if u1 <= u0:
            continue
        for u in range(u0, u1 + size - 1):
            mixed = 0.0
            for k in range(size):
                mixed += kernel[k] * gaussian(scramble(seed + np.uint64((v + k) * (width + size) + u)))
            column[u] = mixed
        for u in range(u0, u1):
            field = 0.0
            for k in range(size):
                field += kernel[k] * column[u + k]
            image[v, u] += stripe[v, u] * np.exp(spread * field - 0.5 * spread * spread)
