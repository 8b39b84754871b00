"""The noise of one pixel, seen in the picture: what a line's neighbours differ by, above the declared photon noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.base.compiled import compiled

SAMPLED_LINES = 5
# The declared noise is believed up to an excess of this share: the stripe's own flanks look like noise.
DOUBT = 0.3


@compiled
def pixel_noise(image: Any, gain_dn: float, declared_dn2: float) -> tuple[float, float]:
    """(variance without photons, whole variance) of a pixel of an 8-bit image's background, DN².

    The first is at least `declared_dn2`, more where the picture is noisier than its photons explain.
    """
    lines, n = image.shape
    # Neighbours two by two, counted by how far they differ.
    counts: Any = np.zeros(256, np.int64)
    total, pairs = 0, 0
    for r in range(0, lines, max(1, lines // SAMPLED_LINES)):
        for i in range(0, n - 1, 2):
            one, other = np.int64(image[r, i]), np.int64(image[r, i + 1])
            counts[abs(one - other)] += 1
            total += int(one + other)
        pairs += n // 2
    # Structure makes large steps and is trimmed away.
    median, below = 0, int(counts[0])
    while 2 * below < pairs:
        median += 1
        below += int(counts[median])
    kept, squares = 0, 0
    for size in range(min(256, 4 * (median + 1) + 1)):
        kept += counts[size]
        squares += counts[size] * size * size
    whole = squares / kept / 2
    excess = whole - gain_dn * (total / (2 * pairs)) - declared_dn2
    return declared_dn2 + (excess if excess > DOUBT * whole else 0.0), max(declared_dn2, whole)
