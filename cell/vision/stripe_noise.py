"""The noise of one pixel, seen in the picture: what a line's neighbours differ by, above the declared photon noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.vision.compiled import compiled

SAMPLED_LINES = 5
# The declared noise is believed up to an excess of this share: the stripe's own flanks look like noise.
DOUBT = 0.3


@compiled
def step_counts(image: Any, counts: Any) -> float:
    """Counts (256,) of how far neighbours along some lines of an 8-bit image differ; the mean value of those lines."""
    lines, n = image.shape
    total, pixels = 0.0, 0
    for r in range(0, lines, max(1, lines // SAMPLED_LINES)):
        row = image[r]
        before = np.int64(row[0])
        for i in range(1, n):
            value = np.int64(row[i])
            counts[abs(value - before)] += 1
            total += value
            before = value
        pixels += n - 1
    return total / max(1, pixels)


def pixel_noise(image: Any, gain_dn: float, declared_dn2: float) -> tuple[float, float]:
    """(variance without photons, whole variance) of a pixel of the background, DN².

    The first is at least `declared_dn2`, more where the picture is noisier than its photons explain.
    """
    counts = np.zeros(256, dtype=np.int64)
    level = step_counts(image, counts)
    sizes = np.arange(256)
    # Structure makes large steps and is trimmed away.
    median = int(np.searchsorted(np.cumsum(counts), 0.5 * counts.sum()))
    kept = sizes <= 4 * (median + 1)
    whole = float(np.sum(counts[kept] * sizes[kept] ** 2) / max(1, counts[kept].sum()) / 2)
    excess = whole - gain_dn * level - declared_dn2
    return declared_dn2 + (excess if excess > DOUBT * whole else 0.0), max(declared_dn2, whole)
