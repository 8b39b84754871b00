"""The compiled inner loops of the stripe extraction: where the stripe is in a row, then its likeliest centre.

Theory sheet, part 3. Nothing here allocates per pixel or holds the interpreter's lock; `stripe.py` is the way in.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

# Columns of the result of `fit_rows`.
CENTRE, SIGMA, AMPLITUDE, WIDTH, BACKGROUND, CHI2, SATURATED, DOUBLE = range(8)
COLUMNS = 8
START_COLUMNS = 7

SEARCH = 12
PARAMETERS = 5


@njit(cache=True, nogil=True)
def _start(row: Any, place: int, peak: int, saturation: int) -> tuple[float, float, float, float, int]:
    """Energy, box-sum centre, width (σ), background and length of the saturated core of the peak near `place`."""
    n = len(row)
    # A wide saturated core pushes the search window out, so that its ends still see the background.
    core_low, core_high = place, place
    while core_low > 0 and row[core_low - 1] >= saturation:
        core_low -= 1
    while core_high < n - 1 and row[core_high + 1] >= saturation:
        core_high += 1
    low, high = max(0, core_low - SEARCH), min(n - 1, core_high + SEARCH)
    ends = 0.0
    for i in range(4):
        ends += row[low + i] + row[high - i]
    background = ends / 8.0
    half = background + 0.5 * (peak - background)
    floor = background + 0.2 * (peak - background)
    above, energy, moment, energy_all = 0, 0.0, 0.0, 0.0
    for i in range(low, high + 1):
        value = float(row[i])
        energy_all += value - background
        if value > floor:
            energy += value - floor
            moment += i * (value - floor)
        if value > half:
            above += 1
    centre = moment / energy if energy > 0 else float(place)
    core = core_high - core_low + 1 if row[place] >= saturation else 0
    if core > 1:
        # Gaussian flanks: the core is the width at saturation, `above` the width at half of the clipped height.
        width = np.sqrt(max(above * above - core * core, 2.0) / (8.0 * np.log(2.0)))
    else:
        width = max(above, 1) / 2.355
    return energy_all, centre, width, background, core


@njit(cache=True, nogil=True)
def find_rows(work: Any, places: Any, saturation: int, least_peak: float, out: Any) -> None:
    """Take the peaks at `places` (h,) of `work` (h, w) into the start values `out` (h, START_COLUMNS), then erase them.

    To be called with the largest value of each row, two or three times: of several peaks the one with the most energy
    stays. Columns of `out`: centre, width, peak, background, energy, energy of the second, length of the saturated
    core; an energy of 0 says that no peak was found yet. `work` is altered.
    """
    height, width = work.shape
    for r in range(height):
        row = work[r]
        place = places[r]
        peak = int(row[place])
        if peak < least_peak:
            continue
        energy, centre, sigma, background, core = _start(row, place, peak, saturation)
        if peak - background >= least_peak:
            if energy > out[r, 4]:
                out[r, 5] = out[r, 4]
                out[r, 0], out[r, 1], out[r, 2], out[r, 3] = centre, sigma, peak - background, background
                out[r, 4], out[r, 6] = energy, core
            elif energy > out[r, 5]:
                out[r, 5] = energy
        reach = int(max(4.0, 4.0 * sigma)) + 1 + core
        for i in range(max(0, place - reach), min(width, place + reach + 1)):
            row[i] = int(background)


@njit(cache=True, nogil=True)
def _factor(matrix: Any) -> bool:
    """Cholesky factor in the lower triangle, in place. False when the matrix is not positive definite."""
    for j in range(len(matrix)):
        for i in range(j, len(matrix)):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = total / matrix[j, j]
            elif total > 0.0:
                matrix[j, j] = np.sqrt(total)
            else:
                return False
    return True


@njit(cache=True, nogil=True)
def _substitute(factor: Any, right: Any) -> None:
    """Solve with the factor of `_factor`, in place."""
    n = len(right)
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]


@njit(cache=True, nogil=True, fastmath=True)
def _accumulate(
    row: Any,
    dark: Any,
    low: int,
    high: int,
    saturation: int,
    centre: float,
    amplitude: float,
    sigma: float,
    background: float,
    slope: float,
    origin: float,
    noise: float,
    gain: float,
    contrast: float,
    normal: Any,
    right: Any,
) -> tuple[float, int]:
    """Fisher information and score of one row into `normal` and `right`; χ² and the number of pixels used."""
    with_dark = len(dark) == len(row)
    n00 = n10 = n11 = n20 = n21 = n22 = n30 = n31 = n32 = n33 = n40 = n41 = n42 = n43 = n44 = 0.0
    r0 = r1 = r2 = r3 = r4 = chi2 = 0.0
    used = 0
    # The Gaussian on the pixel grid by recurrence: two products a pixel instead of an exponential.
    z = (low - centre) / sigma
    g = np.exp(-0.5 * z * z)
    step = 1.0 / sigma
    ratio = np.exp(-step * (z + 0.5 * step))
    shrink = np.exp(-step * step)
    for i in range(low, high + 1):
        if row[i] < saturation:
            value = float(row[i])
            if with_dark:
                value -= dark[i]
            x = i - origin
            stripe = amplitude * g
            mean = stripe + background + slope * x
            weight = 1.0 / (noise * noise + gain * max(mean, 0.0) + contrast * contrast * stripe * stripe)
            residual = value - mean
            j0 = stripe * z * step
            j2 = stripe * z * z
            w0, w1, w2, w4 = weight * j0, weight * g, weight * j2, weight * x
            n00 += w0 * j0
            n10 += w1 * j0
            n11 += w1 * g
            n20 += w2 * j0
            n21 += w2 * g
            n22 += w2 * j2
            n30 += w0
            n31 += w1
            n32 += w2
            n33 += weight
            n40 += w4 * j0
            n41 += w4 * g
            n42 += w4 * j2
            n43 += w4
            n44 += w4 * x
            r0 += w0 * residual
            r1 += w1 * residual
            r2 += w2 * residual
            r3 += weight * residual
            r4 += w4 * residual
            chi2 += weight * residual * residual
            used += 1
        z += step
        g *= ratio
        ratio *= shrink
    normal[0, 0], normal[1, 0], normal[1, 1] = n00, n10, n11
    normal[2, 0], normal[2, 1], normal[2, 2] = n20, n21, n22
    normal[3, 0], normal[3, 1], normal[3, 2], normal[3, 3] = n30, n31, n32, n33
    normal[4, 0], normal[4, 1], normal[4, 2], normal[4, 3], normal[4, 4] = n40, n41, n42, n43, n44
    right[0], right[1], right[2], right[3], right[4] = r0, r1, r2, r3, r4
    return chi2, used


@njit(cache=True, nogil=True)
def fit_rows(
    image: Any,
    dark: Any,
    start: Any,
    widths: Any,
    saturation: int,
    noise: float,
    gain: float,
    contrast: float,
    steps: int,
    out: Any,
) -> None:
    """Weighted maximum likelihood per row: Fisher scoring on centre, amplitude, log width and linear background.

    `start` is from `find_rows`, `widths` (h,) the expected σ in px. Variance of a pixel: noise² + gain · value +
    (contrast · stripe)², in DN². `out` (h, COLUMNS); NaN in rows without a stripe. The width carries a prior, looser
    for saturated rows, where the clipped start value says little.
    """
    height, columns = image.shape
    with_dark = dark.shape[0] == height
    no_dark = np.empty(0, np.float32)
    normal = np.empty((PARAMETERS, PARAMETERS))
    right = np.empty(PARAMETERS)
    score = np.empty(PARAMETERS)
    for r in range(height):
        out[r, :] = np.nan
        out[r, SATURATED] = out[r, DOUBLE] = 0.0
        if start[r, 4] == 0.0:
            continue
        centre, amplitude, background, slope = start[r, 0], start[r, 2], start[r, 3], 0.0
        expected = np.log(widths[r])
        shape = expected
        origin = centre
        core = int(start[r, 6])
        if core > 1:
            amplitude *= np.exp(min(4.0, 0.5 * (0.5 * core / widths[r]) ** 2))
        reach = min(60.0, 0.5 * core + 3.0 * widths[r] + 2.0)
        low, high = max(0, int(np.ceil(origin - reach))), min(columns - 1, int(origin + reach))
        prior = 1.0 / (0.7 * 0.7) if core > 1 else 1.0 / (0.25 * 0.25)
        chi2, used, good = 0.0, 0, True
        for _ in range(steps):
            sigma = np.exp(shape)
            chi2, used = _accumulate(
                image[r],
                dark[r] if with_dark else no_dark,
                low,
                high,
                saturation,
                centre,
                amplitude,
                sigma,
                background,
                slope,
                origin,
                noise,
                gain,
                contrast,
                normal,
                right,
            )
            normal[2, 2] += prior
            right[2] += prior * (expected - shape)
            good = used > PARAMETERS and _factor(normal)
            if not good:
                break
            score[:] = right
            _substitute(normal, right)
            # The misfit that this step leaves, to second order.
            chi2 -= np.dot(score, right)
            centre += min(1.5, max(-1.5, right[0]))
            amplitude = max(0.3 * amplitude, min(3.0 * amplitude, amplitude + right[1]))
            shape += min(0.3, max(-0.3, right[2]))
            background += right[3]
            slope += right[4]
            if abs(right[0]) < 0.03 and abs(right[2]) < 0.1:
                break
        if not good:
            continue
        right[:] = 0.0
        right[0] = 1.0
        _substitute(normal, right)
        out[r, CENTRE] = centre
        out[r, SIGMA] = np.sqrt(right[0])
        out[r, AMPLITUDE] = amplitude
        out[r, WIDTH] = np.exp(shape)
        out[r, BACKGROUND] = background
        out[r, CHI2] = chi2 / max(1, used - PARAMETERS)
        out[r, SATURATED] = 1.0 if core > 0 else 0.0
        out[r, DOUBLE] = 1.0 if start[r, 5] > 0.5 * start[r, 4] else 0.0
