"""What surrounds the stripe and what it does to the centres: texture, print, the blocks of a JPEG.

Noise that neighbouring pixels share shifts a centre farther than white noise of the same size. It is measured beside
the stripe, where the fit swallows none of it, and carried to the centres. How far these scatter along the line has the
last word: a line that wanders farther than its noise explains is stated to.

Centres that depart from the line that their neighbours make: light near the stripe that the fit has absorbed.

A spot within two pixels of the stripe looks like a stripe that is a little wider, and its own line fits well. Only the
lines beside it, which the spot does not reach, tell. What departs keeps its centre and is stated to be off by as much.
"""

import numpy as np
from numpy.typing import NDArray

from cell.base.compiled import compiled
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
    Fourth differences of lines 1, 2, 4, 8 and 16 apart: what neighbours share shows at the wider ones."""
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


BLOCK, BESIDE = 16, 24
"""Lines that are judged by one curve; lines on either side that shape it: more than a spot covers."""
LEAST, LAG = 12, 4
"""Centres that make a curve, at least; by so many centres apart the slope is begun with."""
DEPARTS, LESS, SUSPECT = 4.0, 2.0, 3.0
"""Departure over the larger of the stated deviation and the neighbours' scatter: beyond chance (6e-5 of lines), beyond
it beside a line that departs, and worth a look."""
BREAK_PX = 1.0
"""From one line to the next, beyond the line's slope."""
ROUNDS, SCALED, TUKEY = 5, 3, 4.685
"""Of the robust fit; those in which the scatter is taken anew; its cut in deviations: 95 % efficient on clean lines."""


@compiled
def widen_what_departs(centres: Array, sigma: Array) -> None:
    """Widen `sigma` (lines,) px, in place, of those `centres` (lines,) px that depart from their neighbours' curve.

    Where an edge breaks the line a centre may go on from either side: the nearest of three curves counts. NaN where
    there is no stripe.
    """
    lines = len(centres)
    blocks = (lines + BLOCK - 1) // BLOCK
    plain, curves, known = np.zeros(5), np.zeros((blocks, 5)), np.zeros(blocks, np.bool_)
    off, usual = np.zeros(lines), np.ones(lines)
    for block in range(blocks):
        own = range(block * BLOCK, min(lines, (block + 1) * BLOCK))
        _curve(centres, sigma, block * BLOCK, 1, plain)
        suspect = False
        for r in own:
            suspect = suspect or abs(centres[r] - _at(plain, r)) > SUSPECT * sigma[r]
        if not suspect or plain[3] == 0.0:
            continue
        for r in own:
            off[r] = np.inf
        beside = 0
        for r in range(max(1, block * BLOCK - 1), min(lines, (block + 1) * BLOCK + 1)):
            # A spot bends the line, an edge breaks it.
            beside = max(beside, int(abs(centres[r] - centres[r - 1] - plain[1] / BESIDE) > BREAK_PX))
        for k in range(max(0, block - beside), min(blocks, block + beside + 1)):
            if not known[k]:
                _curve(centres, sigma, k * BLOCK, ROUNDS, curves[k])
                known[k] = True
            for r in own:
                away = abs(centres[r] - _at(curves[k], r))
                if curves[k, 3] > 0.0 and away < off[r]:
                    off[r], usual[r] = away, max(sigma[r], curves[k, 4])
    departs = np.zeros(lines, np.bool_)
    for r in range(lines):
        departs[r] = DEPARTS * usual[r] < off[r] < np.inf
    # A spot covers several lines: beside one that departs less tells.
    for r in range(1, lines):
        departs[r] |= departs[r - 1] and LESS * usual[r] < off[r] < np.inf
    for r in range(lines - 2, -1, -1):
        departs[r] |= departs[r + 1] and LESS * usual[r] < off[r] < np.inf
    for r in range(lines):
        if departs[r]:
            sigma[r] = np.hypot(sigma[r], off[r])


@compiled
def _at(curve: Array, line: int) -> float:
    """The curve's place, px, in a line."""
    t = (line - curve[3]) / BESIDE
    return float(curve[0] + t * (curve[1] + t * curve[2]))


@compiled
def _curve(centres: Array, sigma: Array, begin: int, rounds: int, made: Array) -> None:
    """Parabola through the lines from `begin` to `begin + BLOCK` and those beside, into `made` (5,): coefficients, its
    origin (0 where too few lines have a centre), the lines' scatter about it in px. One round alone is not robust."""
    made[:] = 0.0
    low, high = max(0, begin - BESIDE), min(len(centres), begin + BLOCK + BESIDE)
    t, y, weight = np.empty(high - low), np.empty(high - low), np.empty(high - low)
    n, origin = 0, begin + 0.5 * BLOCK
    for r in range(low, high):
        if np.isfinite(centres[r]):
            t[n], y[n], weight[n] = (r - origin) / BESIDE, centres[r], 1.0 / max(sigma[r] * sigma[r], 1e-12)
            n += 1
    if n < LEAST:
        return
    t, y, weight = t[:n], y[:n], weight[:n]
    usual = np.median(weight) ** -0.5
    made[3] = origin
    told = np.empty(n)
    if rounds > 1:
        # A step or a spot changes few of the slopes.
        for i in range(n - LAG):
            told[i] = (y[i + LAG] - y[i]) / (t[i + LAG] - t[i])
        made[1] = np.median(told[: n - LAG])
        for i in range(n):
            told[i] = y[i] - made[1] * t[i]
        made[0] = np.median(told)
    for turn in range(rounds):
        s0, s1, s2, s3, s4, r0, r1, r2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if rounds > 1 and turn < SCALED:
            for i in range(n):
                told[i] = abs(y[i] - (made[0] + t[i] * (made[1] + t[i] * made[2])))
            made[4] = 1.4826 * np.median(told)
        cut = TUKEY * max(made[4], usual)
        for i in range(n):
            x, w = t[i], weight[i]
            if rounds > 1:
                z = (y[i] - made[0] - x * (made[1] + x * made[2])) / cut
                w *= max(0.0, 1.0 - z * z) ** 2
            s0, s1, s2, s3, s4 = s0 + w, s1 + w * x, s2 + w * x * x, s3 + w * x**3, s4 + w * x**4
            r0, r1, r2 = r0 + w * y[i], r1 + w * y[i] * x, r2 + w * y[i] * x * x
        # Cramer's rule.
        a, b, c = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
        d, e, f = s0 * s4 - s2 * s2, s1 * s2 - s0 * s3, s0 * s2 - s1 * s1
        whole = s0 * a + s1 * b + s2 * c
        if whole <= 1e-9 * s0 * s2 * s4:
            made[3] = 0.0
            return
        made[0], made[1], made[2] = a * r0 + b * r1 + c * r2, b * r0 + d * r1 + e * r2, c * r0 + e * r1 + f * r2
        made[0], made[1], made[2] = made[0] / whole, made[1] / whole, made[2] / whole
