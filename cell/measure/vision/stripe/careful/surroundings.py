"""What surrounds the stripe and what it does to the centres: texture, print, the blocks of a JPEG.

Noise that neighbouring pixels share shifts a centre farther than white noise of the same size. It is measured beside
the stripe, where the fit swallows none of it, and carried to the centres. How far these scatter along the line has the
last word: a line that wanders farther than its noise explains is stated to.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.careful.shaped_fit import Fitted, Noise, Plane

Array = NDArray[np.float64]

LEAST_SEEN, SEEN = 48, 3.0
"""Pixels on a side of the stripe that show what is around it, at least; so many times its reach if that is more."""
SMOOTHED = 21
"""Lines over which the size of the texture is taken."""
LAGS_ALONG = (1, 2, 4, 8, 16)
LEAST_SAMPLES = 30
DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])


def around(plane: Plane, lines: NDArray[np.intp], centres: Array, reach: float) -> tuple[Array, Array, Array]:
    """Of what surrounds `centres` (m,) px of `lines`: the variance (m,) in DN² about a straight line, its correlation
    at lags 0, 1, …, and the mean value (m,) in DN."""
    n = plane.value.shape[1]
    size = min(max(LEAST_SEEN, int(SEEN * reach)), n // 3)
    lags = min(size // 2, int(2 * reach) + 1)
    begin = int(np.ceil(reach)) + 1
    products, seen, means = [], [], []
    x = np.arange(size) - (size - 1) / 2
    for side in (-1, 1):
        first = np.rint(centres).astype(np.intp) + (begin if side > 0 else -begin - size + 1)
        column = first[:, None] + np.arange(size)
        inside = (column >= 0) & (column < n)
        at = lines[:, None], np.clip(column, 0, n - 1)
        value = plane.value[at].astype(np.float64)
        whole = (inside & plane.usable[at]).all(axis=1)
        mean = value.mean(axis=1)
        off = value - mean[:, None]
        off -= np.outer(off @ x / (x @ x), x)
        # What all lines show at the same distance is the stripe's own far light.
        if whole.sum() > 8:
            off -= np.mean(off[whole], axis=0)
        # Two numbers of the line were taken off: the sum of squares misses their share.
        by_lag = [np.sum(off[:, k:] * off[:, : size - k], axis=1) / (size - k) for k in range(lags)]
        product = np.stack(by_lag, axis=1) * (size / (size - 2))
        products.append(np.where(whole[:, None], product, np.nan))
        means.append(np.where(whole, mean, np.nan))
        seen.append(whole)
    usable = seen[0] | seen[1]
    if usable.sum() < 3:
        return np.zeros(len(lines)), np.eye(1, lags)[0], np.zeros(len(lines))
    # The quieter side: an edge or another line on one side is no texture.
    quiet = np.nanmin(np.stack([products[0][usable, 0], products[1][usable, 0]]), axis=0)
    louder = np.nanmax(np.stack([products[0][usable, 0], products[1][usable, 0]]), axis=0)
    both = np.where(louder < 3 * quiet + 1, 0.5 * (quiet + louder), quiet)
    variance = np.interp(np.arange(len(lines)), np.flatnonzero(usable), _running_median(both))
    mean = np.nanmean(np.stack([means[0][usable], means[1][usable]]), axis=0)
    means_all = np.interp(np.arange(len(lines)), np.flatnonzero(usable), mean)
    stacked = np.concatenate([products[0][seen[0]], products[1][seen[1]]])
    calm = stacked[:, 0] <= np.quantile(stacked[:, 0], 0.8)
    covariance = stacked[calm].mean(axis=0)
    correlation = covariance / max(float(covariance[0]), 1e-12)
    # What is within the scatter of a correlation that is none, is none.
    noise = 2.5 / np.sqrt(max(1, calm.sum()) * size)
    small = np.abs(correlation) < noise + 0.02
    end = int(np.argmax(small)) if small.any() else lags
    correlation[end:] = 0.0
    return variance, correlation, means_all


def _running_median(values: Array) -> Array:
    """Median over SMOOTHED neighbours."""
    if len(values) < 3:
        return values
    size = min(SMOOTHED, len(values) - 1 + len(values) % 2)
    padded = np.pad(values, size // 2, mode="reflect" if len(values) > size // 2 else "edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, size), axis=1)[: len(values)])


def carried(fitted: Fitted, variance: Array, correlation: Array) -> Array:
    """Standard deviation (m,) of the centres in px, for noise of `variance` (m,) DN² that pixels share."""
    total = fitted.fisher**2
    influence = fitted.influence
    for lag in range(1, min(len(correlation), influence.shape[1])):
        if correlation[lag] != 0.0:
            total = total + 2 * variance * correlation[lag] * np.sum(influence[:, lag:] * influence[:, :-lag], axis=1)
    return np.asarray(np.sqrt(np.maximum(total, (0.3 * fitted.fisher) ** 2)))


def wander(centres: Array, sigma: Array) -> float:
    """By which factor the centres (lines,) scatter about a smooth line beyond their `sigma`; NaN where there is none.

    Fourth differences of lines 1, 2, 4, 8 and 16 apart: what neighbours share shows at the wider ones.
    """
    largest = 1.0
    for lag in LAGS_ALONG:
        span = 4 * lag
        if len(centres) <= span:
            break
        parts = [slice(k * lag, len(centres) - span + k * lag) for k in range(5)]
        off = sum(d * centres[p] for d, p in zip(DIFFERENCE, parts, strict=True))
        expected = np.sqrt(sum((d * sigma[p]) ** 2 for d, p in zip(DIFFERENCE, parts, strict=True)))
        ratio = np.abs(off / expected)
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio) < LEAST_SAMPLES:
            continue
        seen = float(np.median(ratio)) / 0.6745
        # An estimate from few lines is large by chance.
        if seen > 1.1 + 2.0 / np.sqrt(len(ratio)):
            largest = max(largest, seen)
    return largest


def surrounded(plane: Plane, rows: NDArray[np.intp], at: Array, reach: float, noise: Noise) -> Noise:
    """The noise with the floor that the surroundings of the lines show, no less than it has."""
    variance, _, level = around(plane, rows, at, reach)
    return Noise(max(noise.floor, float(np.median(variance - noise.gain * level))), noise.gain)
