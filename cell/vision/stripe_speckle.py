"""How strong and how coarse the laser's speckle is, measured in the picture itself.

Residuals of fitted lines are compared with what the fit leaves of photon noise and of speckle of contrast 1, grain by
grain: the fit swallows much of a coarse speckle, and that share is computed, not guessed. Without speckle in the
weights and correlation in the deviation, a stated σ is 1.4 to 2.2 times too small (theory sheet, part 3).
"""

from __future__ import annotations

from functools import lru_cache
from math import exp, log, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cell.vision.compiled import compiled
from cell.vision.stripe_fit import AMPLITUDE, FIT_CENTRE, LEVEL, SLOPE, WIDTH, WIDTH_PRIOR
from cell.vision.stripe_lanes import LAGS

# Correlation of two pixels at distance r is exp(−r²/4 grain²); a lens at f/4 to f/8 with pixels of 5 µm gives .3 to 1.
GRAINS = np.array([0.3, 0.45, 0.6, 0.75, 0.9, 1.1, 1.3])
CORE = 2.0
"""Residuals within this many stripe widths of the centre count: farther out there is no speckle to see."""
LEAST_LINES = 12
# Under a narrow stripe few residuals are left, and a finer grain cannot be told from a weaker speckle.
NARROW, NARROW_GRAIN = 1.8, 0.75
# Speckle below this share of the photon noise's variance at the peak, or not above its own uncertainty, is none.
NEGLIGIBLE, SIGNIFICANT = 0.05, 3.0


class _Seen(NamedTuple):
    """Of the lines that were kept: their number; means of e_i e_i, e_i e_{i+1}, e_i e_{i+2} summed over a line's core,
    e the whitened residual; the standard deviation of the first; medians of the fit, the level with the dark frame."""

    lines: int
    power: float
    next_one: float
    next_two: float
    scatter: float
    width: float
    amplitude: float
    level: float


@compiled
def _residuals(
    image: Any, dark: Any, which: Any, fitted: Any, noise2: float, gain: float, contrast2: float, table: Any
) -> int:
    """Three sums of `_Seen`, width, amplitude and level of each line whose core lies in the picture, into `table`."""
    n = image.shape[1]
    used = 0
    for r in which:
        centre, width, amplitude = fitted[FIT_CENTRE, r], fitted[WIDTH, r], fitted[AMPLITUDE, r]
        if not (centre > CORE * width + 1.0 and centre < n - 2.0 - CORE * width):
            continue
        origin = int(np.floor(centre + 0.5))
        level, slope = fitted[LEVEL, r], fitted[SLOPE, r]
        one, two, sum0, sum1, sum2 = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(int(np.ceil(centre - CORE * width)), int(np.floor(centre + CORE * width)) + 1):
            z = (i - centre) / width
            stripe = amplitude * np.exp(-0.5 * z * z)
            shade = float(dark[r, i]) if len(dark) > 1 else 0.0
            mean = stripe + level + slope * (i - origin)
            variance = noise2 + gain * max(mean + shade, 0.0) + contrast2 * stripe * stripe
            error = (image[r, i] - shade - mean) / np.sqrt(variance)
            sum0 += error * error
            sum1 += error * one
            sum2 += error * two
            one, two = error, one
        table[0, used], table[1, used], table[2, used] = sum0, sum1, sum2
        table[3, used], table[4, used] = width, amplitude
        table[5, used] = level + (float(dark[r, origin]) if len(dark) > 1 else 0.0)
        used += 1
    return used


@compiled
def _typical(table: Any) -> Any:
    """The numbers of `_Seen` from `table` (6, lines); lines that differ most are left out."""
    out = np.zeros(8)
    power = table[0]
    # A line with an edge of the scene or a second stripe in it says nothing on speckle.
    kept = power < 8 * max(float(np.median(power)), 0.1)
    out[0] = np.count_nonzero(kept)
    for k in range(3):
        out[1 + k] = np.mean(table[k][kept])
        out[5 + k] = np.median(table[3 + k][kept])
    out[4] = np.std(power[kept])
    return out


class _Expected(NamedTuple):
    """Power (a line's sum of e_i e_i) of photon noise, sums to its neighbours at lags 1 and 2; of speckle of contrast 1
    the power at each of `GRAINS`; the ratio of neighbours to power, in rising order, and its grains."""

    power: float
    neighbours: float
    of_speckle: NDArray[np.float64]
    ratios: NDArray[np.float64]
    grains: NDArray[np.float64]


@lru_cache(maxsize=4096)
def _expected(width: float, amplitude: float, level: float, noise2: float, gain: float, contrast2: float) -> _Expected:
    """What `_typical` gives on average."""
    half = int(4.0 * width + 3.0)
    out = np.zeros((1 + len(GRAINS), 3))
    # Of a narrow stripe it matters how many pixels the core holds.
    phases = 5 if width < 2.0 else 2
    for phase in range(phases):
        x = np.arange(-half, half + 1) - phase / phases
        z = x / width
        stripe = amplitude * np.exp(-0.5 * z * z)
        photon = noise2 + gain * (stripe + max(level, 0.0))
        root = 1.0 / np.sqrt(photon + contrast2 * stripe * stripe)
        basis = (stripe * z / width, stripe / amplitude, stripe * z * z, np.ones_like(x), x / 8.0)
        jacobian = root[:, None] * np.stack(basis, axis=1)
        normal = jacobian.T @ jacobian
        normal[2, 2] += WIDTH_PRIOR**-2
        left = np.eye(len(x)) - jacobian @ np.linalg.solve(normal, jacobian.T)
        rows = left[np.abs(z) <= CORE] * root
        pulled = rows * stripe
        distance2 = (x[:, None] - x) ** 2
        covariances = [(rows * photon) @ rows.T]
        covariances += [pulled @ np.exp(-distance2 / (4 * grain**2)) @ pulled.T for grain in GRAINS]
        out += np.array([[np.trace(c, offset=lag) for lag in range(3)] for c in covariances]) / phases
    ratios = (out[1:, 1] + out[1:, 2]) / out[1:, 0]
    order = np.argsort(ratios)
    return _Expected(out[0, 0], out[0, 1] + out[0, 2], out[1:, 0], ratios[order], GRAINS[order])


def _rounded(value: float, step: float) -> float:
    """To a geometric grid, so that a stream of like pictures asks for the same moments."""
    return exp(step * round(log(max(value, 0.1)) / step))


def measure_speckle(
    image: Any, dark: Any, which: Any, fitted: Any, noise2: float, gain: float, contrast: float
) -> tuple[float, float, float] | None:
    """Contrast and grain (px) of the speckle in the lines `which`, fitted with `contrast`, and their width in px.

    None when they are too few. Anything else that the model does not explain, such as the texture of the surface,
    counts as speckle.
    """
    table = np.empty((6, len(which)))
    used = _residuals(image, dark, which, fitted, noise2, gain, contrast**2, table)
    if used < LEAST_LINES:
        return None
    numbers = _typical(table[:, :used]).tolist()
    seen = _Seen(*numbers)
    if seen.lines < LEAST_LINES:
        return None
    typical = _rounded(seen.width, 0.03), _rounded(seen.amplitude, 0.04), _rounded(seen.level, 0.1)
    expected = _expected(*typical, _rounded(noise2, 0.1), gain, contrast**2)
    excess = seen.power - expected.power
    ratio = (seen.next_one + seen.next_two - expected.neighbours) / max(excess, 1e-9)
    grain = float(np.interp(ratio, expected.ratios, expected.grains))
    if seen.width < NARROW:
        grain = max(grain, NARROW_GRAIN)
    contrast2 = excess / float(np.interp(grain, GRAINS, expected.of_speckle))
    doubt = SIGNIFICANT * seen.scatter / sqrt(seen.lines)
    peak_noise = noise2 + gain * (seen.amplitude + max(seen.level, 0.0))
    if contrast2 * seen.amplitude**2 < NEGLIGIBLE * peak_noise or excess < doubt:
        return 0.0, grain, seen.width
    # Developed speckle has contrast 1; more is a misfit.
    return sqrt(min(contrast2, 1.0)), grain, seen.width


@lru_cache(maxsize=256)
def correlation(grain: float) -> Any:
    """Correlations (LAGS,) of speckle at lags 1, 2, … px."""
    return np.exp(-(np.arange(1, LAGS + 1) ** 2) / (4 * grain**2)).astype(np.float32)
