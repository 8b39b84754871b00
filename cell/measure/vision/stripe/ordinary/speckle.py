"""How strong and how coarse the laser's speckle is, measured in the picture itself.

Residuals of fitted lines are compared with what the fit leaves of photon noise and of speckle of contrast 1: the fit
swallows much of a coarse speckle, and that share is computed, not guessed. The grain is seen across the lines, where
nothing is swallowed: round grains correlate a line with the next as they correlate a pixel with the next. Without
speckle in the weights a stated σ is 3 to 4 times too small (docs/explanation/theory.md, section 5).
"""

from functools import lru_cache
from math import exp, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled
from cell.measure.vision.stripe.ordinary.find import CORE, ENERGY, Array, Floats, Image, Shade, Whole
from cell.measure.vision.stripe.ordinary.fit import AMPLITUDE, FIT_CENTRE, LAGS, LEVEL, SLOPE, WIDTH, WIDTH_PRIOR

# Correlation of two pixels at distance r is exp(−r²/4 grain²); a lens at f/4 to f/8 with pixels of 5 µm gives .3 to 1.
GRAINS = np.array([0.3, 0.45, 0.6, 0.75, 0.9, 1.1, 1.3])
LEAST_CORRELATED, MOST_CORRELATED = (exp(-0.25 / grain**2) for grain in (0.3, 1.3))
WITHIN = 2.0
"""Residuals within this many stripe widths of the centre count: farther out there is no speckle to see."""
LEAST_PAIRS = 8
MOST_WIDENING = 2.0
PHASES = 8
ASSUMED_GRAIN = 0.7
"""Grain in px where none shows: no speckle, or lines that have no column in common."""
# Speckle below this share of the photon noise's variance at the peak, or not above its own uncertainty, is none.
NEGLIGIBLE, SIGNIFICANT = 0.05, 3.0


class Speckle(NamedTuple):
    """What a picture shows of the speckle: its contrast, its grain in px, and the width of the fitted stripes over that
    of their peaks, which are chosen for being bright, so that speckle makes them look too narrow."""

    contrast: float
    grain: float
    widening: float


class _Seen(NamedTuple):
    """Of the pairs of neighbouring lines that were kept: their number; means of the power, a line's sum of e e over its
    core, e the whitened residuals, of e e' with the other line's over the columns that both cores share, and of the
    power there; the standard deviation of the first; medians of the fit, the level with the dark frame."""

    pairs: int
    power: float
    product: float
    shared: float
    scatter: float
    width: float
    amplitude: float
    level: float


@compiled
def neighbours(start: Array, double: NDArray[np.bool_], most: int) -> Whole:
    """Lines (m,) of some `most` pairs of a line and the next, all over the picture, that show one peak, unsaturated."""
    lines = len(start)
    clear = np.zeros(lines, np.bool_)
    pairs = 0
    for r in range(lines):
        clear[r] = start[r, 0, ENERGY] > 0 and start[r, 0, CORE] == 0 and not double[r]
        pairs += r > 0 and clear[r] and clear[r - 1]
    every = max(1, pairs // most)
    chosen = np.empty(pairs // every + 1, np.int64)
    seen, count = 0, 0
    for r in range(1, lines):
        if clear[r] and clear[r - 1]:
            if seen % every == 0:
                chosen[count] = r - 1
                count += 1
            seen += 1
    return chosen[:count]


@compiled
def _whitened(
    image: Image, dark: Shade, r: int, fitted: Array, noise2: float, gain: float, contrast2: float, errors: Array
) -> tuple[int, int]:
    """Residuals of line r into `errors` (n,) where its core is; first and last column + 1 of it, 0, 0 if it leaves."""
    n = image.shape[1]
    centre, width, amplitude = fitted[FIT_CENTRE, r], fitted[WIDTH, r], fitted[AMPLITUDE, r]
    if not (centre > WITHIN * width + 1.0 and centre < n - 2.0 - WITHIN * width):
        return 0, 0
    origin = int(np.floor(centre + 0.5))
    level, slope = fitted[LEVEL, r], fitted[SLOPE, r]
    low, high = int(np.ceil(centre - WITHIN * width)), int(np.floor(centre + WITHIN * width)) + 1
    for i in range(low, high):
        z = (i - centre) / width
        stripe = amplitude * np.exp(-0.5 * z * z)
        shade = float(dark[r, i]) if len(dark) > 1 else 0.0
        mean = stripe + level + slope * (i - origin)
        variance = noise2 + gain * max(mean + shade, 0.0) + contrast2 * stripe * stripe
        errors[i] = (image[r, i] - shade - mean) / np.sqrt(variance)
    return low, high


@compiled
def _residuals(
    image: Image, dark: Shade, pairs: Whole, fitted: Array, noise2: float, gain: float, contrast2: float,
    table: Array,
) -> int:  # fmt: skip
    """Power, product, shared power, width, amplitude and level of each pair r, r + 1 in the picture, into `table`."""
    errors = np.zeros((2, image.shape[1]))
    used = 0
    for r in pairs:
        low, high = _whitened(image, dark, r, fitted, noise2=noise2, gain=gain, contrast2=contrast2, errors=errors[0])
        low1, high1 = _whitened(image, dark, r + 1, fitted, noise2, gain=gain, contrast2=contrast2, errors=errors[1])
        if high == 0 or high1 == 0:
            continue
        power, product, shared = 0.0, 0.0, 0.0
        for i in range(low, high):
            power += 0.5 * errors[0, i] ** 2
        for i in range(low1, high1):
            power += 0.5 * errors[1, i] ** 2
        for i in range(max(low, low1), min(high, high1)):
            product += errors[0, i] * errors[1, i]
            shared += 0.5 * (errors[0, i] ** 2 + errors[1, i] ** 2)
        table[0, used], table[1, used], table[2, used] = power, product, shared
        table[3, used] = 0.5 * (fitted[WIDTH, r] + fitted[WIDTH, r + 1])
        table[4, used] = 0.5 * (fitted[AMPLITUDE, r] + fitted[AMPLITUDE, r + 1])
        table[5, used] = fitted[LEVEL, r]
        if len(dark) > 1:
            table[5, used] += float(dark[r, int(np.floor(fitted[FIT_CENTRE, r] + 0.5))])
        used += 1
    return used


def _typical(table: NDArray[np.float64]) -> _Seen:
    """What `table` (6, pairs) holds of all pairs but those that differ most."""
    power = table[0]
    # A line with an edge of the scene or a second stripe in it says nothing on speckle.
    kept = power < 8 * max(_medians(power[None])[0], 0.1)
    mean_power, product, shared = table[:3, kept].mean(axis=1).tolist()
    width, amplitude, level = _medians(table[3:, kept])
    pairs, scatter = int(np.count_nonzero(kept)), float(power[kept].std())
    return _Seen(pairs, mean_power, product, shared, scatter=scatter, width=width, amplitude=amplitude, level=level)


def _medians(rows: NDArray[np.float64]) -> list[float]:
    """Of each row of (n, m); `numpy.median` takes several times as long for a few numbers."""
    ordered = np.sort(rows, axis=1)
    last = rows.shape[1] - 1
    medians: list[float] = (0.5 * (ordered[:, last // 2] + ordered[:, (last + 1) // 2])).tolist()
    return medians


@lru_cache(maxsize=4096)
def _expected(
    width: float, amplitude: float, level: float, noise2: float, gain: float, contrast2: float
) -> NDArray[np.float64]:
    """Power of a line on average, (1 + grains,): of photon noise, then of speckle of contrast 1 of each of `GRAINS`."""
    half = int(4.0 * width + 3.0)
    out = np.zeros(1 + len(GRAINS))
    # Much of what is left lies at the core's ends: how many pixels it holds depends on where in a pixel the centre is.
    for phase in (np.arange(PHASES) + 0.5) / PHASES:
        x = np.arange(-half, half + 1) - phase
        z = x / width
        stripe = amplitude * np.exp(-0.5 * z * z)
        photon = noise2 + gain * (stripe + max(level, 0.0))
        root = 1.0 / np.sqrt(photon + contrast2 * stripe * stripe)
        basis = (stripe * z / width, stripe / amplitude, stripe * z * z, np.ones_like(x), x / 8.0)
        jacobian = root[:, None] * np.stack(basis, axis=1)
        normal = jacobian.T @ jacobian
        normal[2, 2] += WIDTH_PRIOR**-2
        left = np.eye(len(x)) - jacobian @ np.linalg.solve(normal, jacobian.T)
        rows = left[np.abs(z) <= WITHIN] * root
        pulled = rows * stripe
        distance2 = (x[:, None] - x) ** 2
        covariances = [(rows * photon) @ rows.T]
        covariances += [pulled @ np.exp(-distance2 / (4 * grain**2)) @ pulled.T for grain in GRAINS]
        out += np.array([np.trace(c) for c in covariances]) / PHASES
    return out


def _rounded(value: float, step: float) -> float:
    """To a geometric grid, so that a stream of like pictures asks for the same powers."""
    return exp(step * round(log(max(value, 0.1)) / step))


def measure_speckle(
    image: Image, dark: Shade, pairs: Whole, widths: Array, fitted: Array, noise2: float, gain: float,
    contrast: float,
) -> Speckle | None:  # fmt: skip
    """The speckle in the lines `pairs` and the ones after them, whose peaks have `widths` (lines,) in px.

    All of them are `fitted` with `contrast`. None when they are too few. Anything else that the model does not explain,
    such as the texture of the surface, counts as speckle.
    """
    table = np.empty((6, len(pairs)))
    used = _residuals(image, dark, pairs, fitted=fitted, noise2=noise2, gain=gain, contrast2=contrast**2, table=table)
    if used < LEAST_PAIRS:
        return None
    seen = _typical(table[:, :used])
    if seen.pairs < LEAST_PAIRS:
        return None
    widening = min(max(seen.width / float(np.mean(widths[pairs])), 1 / MOST_WIDENING), MOST_WIDENING)
    typical = _rounded(seen.width, 0.03), _rounded(seen.amplitude, 0.04), _rounded(seen.level, 0.1)
    expected = _expected(*typical, _rounded(noise2, 0.1), gain, contrast**2)
    excess = seen.power - float(expected[0])
    if excess < SIGNIFICANT * seen.scatter / sqrt(seen.pairs):
        return Speckle(0.0, ASSUMED_GRAIN, widening)
    grain = ASSUMED_GRAIN
    if seen.shared > 0:
        # Of the power in the columns that both lines share, speckle has the share that it has of all.
        correlated = seen.product * seen.power / (seen.shared * excess)
        grain = sqrt(-0.25 / log(min(max(correlated, LEAST_CORRELATED), MOST_CORRELATED)))
    contrast2 = excess / float(np.interp(grain, GRAINS, expected[1:]))
    peak_noise = noise2 + gain * (seen.amplitude + max(seen.level, 0.0))
    if contrast2 * seen.amplitude**2 < NEGLIGIBLE * peak_noise:
        return Speckle(0.0, grain, widening)
    # Developed speckle has contrast 1; more is a misfit.
    return Speckle(sqrt(min(contrast2, 1.0)), grain, widening)


@lru_cache(maxsize=256)
def correlation(grain: float) -> Floats:
    """Correlations (LAGS,) of speckle at lags 1, 2, … px."""
    return np.exp(-(np.arange(1, LAGS + 1) ** 2) / (4 * grain**2)).astype(np.float32)
