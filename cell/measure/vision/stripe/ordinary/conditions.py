"""Whether a picture is an ordinary one, for which the quick search and the fit of a Gaussian say all there is to say.

Asked once for each picture, or for the first of a stream's block, of a few of its lines. Where the answer is no, the
stripe is read carefully (`careful.py`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cell.base.compiled import compiled
from cell.measure.vision.stripe.ordinary.find import CORE, ENERGY
from cell.measure.vision.stripe.ordinary.fit import AMPLITUDE, FIT_CENTRE, LEVEL, SLOPE, WIDTH

BINS, WITHIN = 28, 3.5
"""Of the mean residual across the stripe, and how far out it goes, in widths."""
ASKED = 200
LEAST_ASKED = 30
PATTERN, SIGNIFICANT = 0.08, 3.0
"""A mean residual of this share of the noise's power, and so many times what chance makes, is another profile."""
WIDEST = 4.5
"""σ in px of the widest stripe that the quick search sees whole."""
HARDLY_ANY = 0.05
"""Share of the lines."""
BROKEN, REFUSED = 0.03, 0.06
"""Shares of the lines that jump away from both neighbours, and that show a peak which is no stripe."""
UNEVEN, BRIGHT_DN = 0.25, 25.0
"""Difference of the albedo on both sides of the stripe, and the light from which it can be seen."""
FAR_LAG, SAMPLED_LINES = 4, 8
TEXTURE_DN2, TEXTURE_RATIO = 1.0, 2.0
"""Variance of the background about straight lines, and that of distant pixels over that of near ones: texture."""


@compiled
def is_profile_gaussian(image: Any, dark: Any, fitted: Any, start: Any) -> bool:
    """True when the mean residual of some fitted lines, registered at their centres, is no more than their noise."""
    lines, n = image.shape
    sums, squares, counts = np.zeros(BINS), np.zeros(BINS), np.zeros(BINS)
    known = 0
    for r in range(lines):
        known += np.isfinite(fitted[FIT_CENTRE, r]) and start[r, 0, CORE] == 0
    if known < LEAST_ASKED:
        return True
    every = max(1, known // ASKED)
    seen = 0
    for r in range(lines):
        centre = fitted[FIT_CENTRE, r]
        if not np.isfinite(centre) or start[r, 0, CORE] > 0:
            continue
        seen += 1
        if seen % every:
            continue
        width, amplitude = fitted[WIDTH, r], fitted[AMPLITUDE, r]
        origin = np.floor(centre + 0.5)
        first, last = int(np.ceil(centre - WITHIN * width)), int(np.floor(centre + WITHIN * width))
        for i in range(max(0, first), min(n - 1, last) + 1):
            z = (i - centre) / width
            shade = float(dark[r, i]) if len(dark) > 1 else 0.0
            mean = amplitude * np.exp(-0.5 * z * z) + fitted[LEVEL, r] + fitted[SLOPE, r] * (i - origin)
            off = image[r, i] - shade - mean
            k = min(BINS - 1, int((z + WITHIN) * BINS / (2 * WITHIN)))
            sums[k] += off
            squares[k] += off * off
            counts[k] += 1
    pattern, power, chance, used = 0.0, 0.0, 0.0, 0
    for k in range(BINS):
        if counts[k] < 8:
            continue
        mean = sums[k] / counts[k]
        variance = max(squares[k] / counts[k] - mean * mean, 1e-3)
        pattern += mean * mean / variance
        chance += counts[k] * mean * mean / variance
        power += 1.0
        used += 1
    if used < BINS // 4:
        return True
    return not (pattern / used > PATTERN and chance / used > SIGNIFICANT * SIGNIFICANT)


@compiled
def is_line_whole(fitted: Any, start: Any) -> bool:
    """True when few lines with a peak are no stripe, and few stripes stand where neither neighbour has its."""
    lines = fitted.shape[1]
    peaks, found, broken = 0, 0, 0
    before, joined = -1, False
    for r in range(lines):
        peaks += start[r, 0, ENERGY] > 0
        if not np.isfinite(fitted[FIT_CENTRE, r]):
            continue
        found += 1
        # A stripe that goes on at one side at least is no stray.
        near = before >= 0 and r - before <= 3
        near = near and abs(fitted[FIT_CENTRE, r] - fitted[FIT_CENTRE, before]) <= 4.0 * (r - before) + fitted[WIDTH, r]
        if before >= 0 and not near and not joined:
            broken += 1
        joined = near
        before = r
    if before >= 0 and not joined:
        broken += 1
    return peaks - found <= REFUSED * lines and broken <= BROKEN * found + 2


@compiled
def is_too_wide(fitted: Any, start: Any) -> bool:
    """True when the stripes that were found are wider than the search's window takes, or hardly any was."""
    found, wide = 0, 0
    for r in range(fitted.shape[1]):
        if np.isfinite(fitted[FIT_CENTRE, r]):
            found += 1
            wide += fitted[WIDTH, r] > WIDEST
    return 2 * wide >= found or found < HARDLY_ANY * fitted.shape[1]


@compiled
def is_saturated(fitted: Any, start: Any) -> bool:
    """True when the cores of most stripes are saturated: what flanks look like is seldom a Gaussian."""
    found, hidden = 0, 0
    for r in range(fitted.shape[1]):
        if np.isfinite(fitted[FIT_CENTRE, r]):
            found += 1
            hidden += start[r, 0, CORE] > 1
    return 2 * hidden > found


@compiled
def is_surface_even(dark: Any, fitted: Any) -> bool:
    """True when the picture without the laser shows no edges of the surface's albedo under the stripe, or is dark."""
    found, uneven, total = 0, 0, 0.0
    n = dark.shape[1]
    if len(dark) < fitted.shape[1]:
        return True
    for r in range(fitted.shape[1]):
        centre, width = fitted[FIT_CENTRE, r], fitted[WIDTH, r]
        if not np.isfinite(centre):
            continue
        left, right = int(centre - 1.5 * width), int(centre + 1.5 * width + 1)
        if left < 0 or right >= n:
            continue
        one, other = float(dark[r, left]), float(dark[r, right])
        found += 1
        total += 0.5 * (one + other)
        uneven += abs(one - other) > UNEVEN * 0.5 * (one + other)
    return total < BRIGHT_DN * found or uneven <= BROKEN * found


@compiled
def has_rivals(fitted: Any, start: Any) -> bool:
    """True when centres jump and many lines have a second peak: the wrong one may have been taken."""
    rivals, found, jumps, before = 0, 0, 0, -1
    for r in range(fitted.shape[1]):
        rivals += start[r, 1, ENERGY] > 0
        if not np.isfinite(fitted[FIT_CENTRE, r]):
            continue
        found += 1
        aside = abs(fitted[FIT_CENTRE, r] - fitted[FIT_CENTRE, before]) if before >= 0 else 0.0
        jumps += before == r - 1 and aside > 6.0 + 2 * fitted[WIDTH, r]
        before = r
    return jumps > 0 and rivals > REFUSED * found


@compiled
def is_textured(image: Any) -> bool:
    """True when pixels of the background differ more from those some px away than from the next ones."""
    lines, n = image.shape
    near: Any = np.zeros(1024, np.int64)
    far: Any = np.zeros(1024, np.int64)
    total = 0
    for r in range(lines // (2 * SAMPLED_LINES), lines, max(1, lines // SAMPLED_LINES)):
        for i in range(FAR_LAG, n - FAR_LAG, 3):
            here = 2 * np.int64(image[r, i])
            near[abs(np.int64(image[r, i - 1]) + np.int64(image[r, i + 1]) - here)] += 1
            far[abs(np.int64(image[r, i - FAR_LAG]) + np.int64(image[r, i + FAR_LAG]) - here)] += 1
            total += 1
    distant, next_ = _trimmed(far, total), _trimmed(near, total)
    return bool(distant > 6 * TEXTURE_DN2 and distant > TEXTURE_RATIO * next_)


@compiled
def _trimmed(counts: Any, total: int) -> float:
    """Mean square of what was counted, without what is far beyond its median."""
    median, below = 0, int(counts[0])
    while 2 * below < total:
        median += 1
        below += int(counts[median])
    kept, squares = 0, 0.0
    for size in range(min(len(counts), 4 * (median + 1) + 1)):
        kept += counts[size]
        squares += float(counts[size]) * size * size
    return squares / max(kept, 1)
